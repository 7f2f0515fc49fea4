// Whether a camera that was moved after its calibration is named, and no other: each camera of a recording is moved by
// 5 mm along, or turned by 0.3° about, each of its axes. Recordings as in avatar_quality_test.cpp; some of the motions
// are tried, or all of them for every camera when BOOTH_EVERY_CAMERA is set.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <numbers>

#include "pipeline/hull/visual_hull.h"
#include "pipeline/segmentation/segmentation.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

constexpr double turned_rad = 0.3 * std::numbers::pi / 180;
constexpr double moved_m = 0.005;

/// What the health check made of motions.
struct Tally {
  int tried = 0, named = 0, false_alarms = 0;
};
std::ostream& operator<<(std::ostream& out, const Tally& tally) {
  return out << tally.named << " of " << tally.tried << " named, " << tally.false_alarms << " false alarms";
}

class CameraHealth : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    const auto folder = find_recording(GetParam());
    if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
    const Recording recording = read_recording(*folder).value();
    rig_ = recording.rig;
    const auto background = load_shot(recording, *recording.find(ShotRole::background), work_).sets;
    const FrameSet body = load_shot(recording, *recording.find(ShotRole::body), work_).sets.at(0);
    silhouettes_.resize(body.frames.size());
    work_.parallel_for(body.frames.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        std::vector<Frame> empty;
        for (const FrameSet& set : background)
          for (const Frame& frame : set.frames)
            if (frame.camera == body.frames[i].camera) empty.push_back(frame);
        silhouettes_[i] = segment(empty, body.frames[i], {}).value().silhouette;
      }
    });
  }

  std::vector<CameraAgreement> check(const Rig& rig) const {
    const auto hull = carve_visual_hull(rig, silhouettes_, {}, work_);
    EXPECT_TRUE(hull.ok()) << hull.error().message;
    return hull.ok() ? hull->agreement : std::vector<CameraAgreement>();
  }

  /// @param axis  of the camera; 0 … 2: turned about it, 3 … 5: moved along it
  void move(const std::string& camera, int axis, double sign, Tally& tally) const {
    Rig rig = rig_;
    RigCamera& moved =
        *std::find_if(rig.cameras.begin(), rig.cameras.end(), [&](const RigCamera& c) { return c.id == camera; });
    Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
    const Eigen::Vector3d direction = sign * Eigen::Vector3d::Unit(axis % 3);
    if (axis < 3)
      motion.linear() = Eigen::AngleAxisd(turned_rad, direction).toRotationMatrix();
    else
      motion.translation() = moved_m * direction;
    moved.camera_from_world = motion * moved.camera_from_world;
    ++tally.tried;
    std::cout << GetParam() << " " << camera << (axis < 3 ? " turned about " : " moved along ") << "xyz"[axis % 3]
              << ":";
    for (const CameraAgreement& agreement : check(rig)) {
      if (agreement.camera == camera) std::cout << " deviates by " << agreement.deviation;
      if (!agreement.moved) continue;
      (agreement.camera == camera ? tally.named : tally.false_alarms) += 1;
      std::cout << " named " << agreement.camera << ", " << agreement.offset_px << " px;";
    }
    std::cout << "\n";
  }

  ThreadPool pool_;
  Work work_ = pool_.work();
  Rig rig_;
  std::vector<Silhouette> silhouettes_;
};

TEST_P(CameraHealth, NoCameraOfAGoodRigIsNamed) {
  for (const CameraAgreement& agreement : check(rig_)) {
    std::cout << GetParam() << " " << agreement.camera << " deviates by " << agreement.deviation << ", "
              << agreement.offset_px << " px\n";
    EXPECT_FALSE(agreement.moved) << agreement.camera;
  }
}

TEST_P(CameraHealth, ACameraThatWasMovedIsNamedAndNoOther) {
  const bool every = std::getenv("BOOTH_EVERY_CAMERA") != nullptr;
  Tally turned, moved;
  for (size_t c = 0; c < silhouettes_.size(); ++c)
    for (int axis = 0; axis < 6; ++axis)
      if (every || c == static_cast<size_t>(2 * axis) % silhouettes_.size())
        move(silhouettes_[c].camera, axis, (static_cast<int>(c) + axis) % 2 == 0 ? 1 : -1, axis < 3 ? turned : moved);
  std::cout << GetParam() << ": turned by 0.3°: " << turned << "; moved by 5 mm: " << moved << "\n";
  EXPECT_EQ(turned.false_alarms + moved.false_alarms, 0);
  // In a small image 0.3° are three pixels and 5 mm hardly more than one.
  constexpr int large_image_px = 900;
  const bool large = rig_.cameras.front().intrinsics.width > large_image_px;
  EXPECT_GE(turned.named, large ? turned.tried : turned.tried / 2);
  // A goal not reached yet: face cameras that were moved along their axis.
  if (large) {
    EXPECT_GE(moved.named, moved.tried - 1);
  }
}

INSTANTIATE_TEST_SUITE_P(Recordings, CameraHealth, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
