// Whether a camera that was moved after its calibration is named, and no other: each camera of a recording is moved by
// 5 mm along, or turned by 0.3° about, each of its axes. Two checks look for it: the silhouettes of all cameras, which
// no longer agree, and the camera's own background, which is no longer where it was. Recordings as in
// avatar_quality_test.cpp; some of the motions are tried, or all of them for every camera when BOOTH_EVERY_CAMERA is
// set.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <numbers>
#include <optional>

#include "pipeline/health/background_registration.h"
#include "pipeline/hull/visual_hull.h"
#include "pipeline/thread_pool.h"
#include "tests/quality/knocked_camera.h"
#include "tests/quality/recorded_capture.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

constexpr double turned_rad = 0.3 * std::numbers::pi / 180;
constexpr double moved_m = 0.005;
constexpr int large_image_px = 900;

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
    capture_ = load_capture(*folder, work_);
  }

  std::vector<CameraAgreement> check_silhouettes(const Rig& rig) const {
    const auto hull = carve_visual_hull(rig, capture_.silhouettes, {}, work_);
    EXPECT_TRUE(hull.ok()) << hull.error().message;
    return hull.ok() ? hull->agreement : std::vector<CameraAgreement>();
  }

  BackgroundMotion check_background(size_t c, const Frame& frame, const Image& subject) const {
    const auto motion = register_background(capture_.background[c].mean, frame, subject, camera(c).intrinsics);
    EXPECT_TRUE(motion.ok()) << motion.error().message;
    return motion.ok() ? *motion : BackgroundMotion{};
  }

  const RigCamera& camera(size_t c) const { return *capture_.rig.find(capture_.silhouettes[c].camera); }

  /// @param axis  of the camera; 0 … 2: turned about it, 3 … 5: moved along it
  static Eigen::Isometry3d motion_about(int axis, double sign) {
    Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
    const Eigen::Vector3d direction = sign * Eigen::Vector3d::Unit(axis % 3);
    if (axis < 3)
      motion.linear() = Eigen::AngleAxisd(turned_rad, direction).toRotationMatrix();
    else
      motion.translation() = moved_m * direction;
    return motion;
  }

  /// Calls `with` for the motions to try: (camera, axis, motion).
  template <class With>
  void for_each_motion(const With& with) const {
    const bool every = std::getenv("BOOTH_EVERY_CAMERA") != nullptr;
    for (size_t c = 0; c < capture_.silhouettes.size(); ++c)
      for (int axis = 0; axis < 6; ++axis)
        if (every || c == static_cast<size_t>(2 * axis) % capture_.silhouettes.size())
          with(c, axis, motion_about(axis, (static_cast<int>(c) + axis) % 2 == 0 ? 1 : -1));
  }

  std::string describe(size_t c, int axis) const {
    return std::string(GetParam()) + " " + camera(c).id + (axis < 3 ? " turned about " : " moved along ") +
           "xyz"[axis % 3];
  }

  bool large_images() const { return capture_.rig.cameras.front().intrinsics.width > large_image_px; }

  ThreadPool pool_;
  Work work_ = pool_.work();
  RecordedCapture capture_;
};

TEST_P(CameraHealth, NoCameraOfAGoodRigIsNamed) {
  for (const CameraAgreement& agreement : check_silhouettes(capture_.rig)) {
    std::cout << GetParam() << " " << agreement.camera << " deviates by " << agreement.deviation << ", "
              << agreement.offset_px << " px\n";
    EXPECT_FALSE(agreement.moved) << agreement.camera;
  }
  for (size_t c = 0; c < capture_.frames.size(); ++c) {
    const BackgroundMotion motion = check_background(c, capture_.frames[c], capture_.silhouettes[c].coverage);
    std::cout << GetParam() << " " << camera(c).id << " background deviates by " << motion.deviation << ", "
              << motion.shift_px << " ± " << motion.sigma_px << " px\n";
    EXPECT_FALSE(motion.moved) << camera(c).id;
    EXPECT_GT(motion.deviation, 0) << camera(c).id;
  }
}

TEST_P(CameraHealth, ACameraThatWasMovedIsNamedBySilhouettesAndNoOther) {
  Tally turned, moved;
  for_each_motion([&](size_t c, int axis, const Eigen::Isometry3d& motion) {
    Rig rig = capture_.rig;
    const std::string id = camera(c).id;
    RigCamera& knocked =
        *std::find_if(rig.cameras.begin(), rig.cameras.end(), [&](const RigCamera& one) { return one.id == id; });
    knocked.camera_from_world = motion * knocked.camera_from_world;
    Tally& tally = axis < 3 ? turned : moved;
    ++tally.tried;
    std::cout << describe(c, axis) << ":";
    for (const CameraAgreement& agreement : check_silhouettes(rig)) {
      if (agreement.camera == id) std::cout << " deviates by " << agreement.deviation;
      if (!agreement.moved) continue;
      (agreement.camera == id ? tally.named : tally.false_alarms) += 1;
      std::cout << " named " << agreement.camera << ", " << agreement.offset_px << " px;";
    }
    std::cout << "\n";
  });
  std::cout << GetParam() << ", by silhouettes: turned by 0.3°: " << turned << "; moved by 5 mm: " << moved << "\n";
  EXPECT_EQ(turned.false_alarms + moved.false_alarms, 0);
  // In a small image 0.3° are three pixels and 5 mm hardly more than one.
  EXPECT_GE(turned.named, large_images() ? turned.tried : turned.tried / 2);
  // A goal not reached yet: face cameras that were moved along their axis.
  if (large_images()) {
    EXPECT_GE(moved.named, moved.tried - 1);
  }
}

TEST_P(CameraHealth, ACameraThatWasMovedIsNamedByItsBackground) {
  Tally turned, moved;
  std::optional<KnockedCamera> knocked;
  size_t made_for = 0;
  for_each_motion([&](size_t c, int axis, const Eigen::Isometry3d& motion) {
    if (!knocked || made_for != c)
      knocked.emplace(capture_.rig, camera(c), capture_.frames[c], capture_.silhouettes[c]);
    made_for = c;
    const KnockedCamera::View view = knocked->see(motion);
    const BackgroundMotion found = check_background(c, view.frame, view.subject);
    Tally& tally = axis < 3 ? turned : moved;
    ++tally.tried;
    tally.named += found.moved;
    std::cout << describe(c, axis) << ": background deviates by " << found.deviation << ", " << found.shift_px << " ± "
              << found.sigma_px << " px, turned by " << found.rotation_rad.transpose() * 180 / std::numbers::pi
              << "°, grown by " << found.growth << "\n";
    if (axis < 3) {
      const Eigen::AngleAxisd turn(motion.linear());
      EXPECT_LT((found.rotation_rad - turn.angle() * turn.axis()).norm(), 0.1 * turned_rad) << describe(c, axis);
    }
  });
  std::cout << GetParam() << ", by the background: turned by 0.3°: " << turned << "; moved by 5 mm: " << moved << "\n";
  EXPECT_EQ(turned.named, turned.tried);
  EXPECT_EQ(moved.named, moved.tried);
}

INSTANTIATE_TEST_SUITE_P(Recordings, CameraHealth, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
