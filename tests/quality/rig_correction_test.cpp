// Cameras of a recording that were moved are put back where they were, from the recording's one capture. Recordings as
// in avatar_quality_test.cpp.

#include "pipeline/hull/rig_correction.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <iostream>
#include <numbers>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/thread_pool.h"
#include "tests/quality/recorded_capture.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

constexpr double turned_rad = 0.4 * std::numbers::pi / 180;
constexpr double carried_m = 0.005;
/// How far the picture of the subject may be off afterwards: the calibration itself is a few tenths of a pixel off.
constexpr double most_left_px = 0.6;

class RigCorrectionOfRecordings : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    const auto folder = find_recording(GetParam());
    if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
    RecordedCapture capture = load_capture(*folder, work_);
    rig_ = std::move(capture.rig);
    captures_.push_back(std::move(capture.silhouettes));
  }

  static RigCamera& camera(Rig& rig, const std::string& id) {
    return *std::find_if(rig.cameras.begin(), rig.cameras.end(), [&](const RigCamera& one) { return one.id == id; });
  }
  static void turn(Rig& rig, const std::string& id, int axis) {
    Eigen::Isometry3d& pose = camera(rig, id).camera_from_world;
    pose = Eigen::AngleAxisd(turned_rad, Eigen::Vector3d::Unit(axis)) * pose;
  }
  static void carry(Rig& rig, const std::string& id, int axis) {
    camera(rig, id).camera_from_world.pretranslate(carried_m * Eigen::Vector3d::Unit(axis));
  }

  static double off_px(const RigCamera& camera, const RigCamera& truth) {
    double sum = 0, count = 0;
    for (double y = 0.1; y < 1.8; y += 0.2)
      for (const double x : {-0.25, 0.0, 0.25})
        for (const double z : {-0.15, 0.15}) {
          const auto a = project(camera, {x, y, z}), b = project(truth, {x, y, z});
          if (!a || !b) continue;
          sum += (*a - *b).squaredNorm();
          count += 1;
        }
    return std::sqrt(sum / count);
  }

  /// Corrects `moved` and compares it with the rig as it was.
  void expect_corrected(const Rig& moved, const std::vector<std::string>& ids) const {
    const auto found = correct_rig(moved, captures_, {}, work_);
    ASSERT_TRUE(found) << found.error().message;
    EXPECT_TRUE(found->needed);
    for (const CameraCorrection& one : found->cameras) {
      const bool expected = std::find(ids.begin(), ids.end(), one.camera) != ids.end();
      EXPECT_EQ(one.moved, expected) << one.camera;
      if (!expected) continue;
      const RigCamera &truth = *rig_.find(one.camera), &corrected = *found->rig.find(one.camera);
      const double before = off_px(*moved.find(one.camera), truth), after = off_px(corrected, truth);
      const double center_m = (corrected.center() - truth.center()).norm();
      std::cout << GetParam() << " " << one.camera << ": picture of the subject off by " << before << " px, corrected "
                << after << " px; outline misses " << one.before_px << " px, then " << one.after_px
                << "; centre off by " << 1000 * center_m << " mm, certain to within " << 1000 * one.uncertainty.center_m
                << "\n";
      EXPECT_LT(after, most_left_px) << one.camera;
      EXPECT_LT(one.after_px, 0.5 * one.before_px) << one.camera;
      EXPECT_LT(center_m, 3 * one.uncertainty.center_m) << one.camera;
    }
  }

  ThreadPool pool_;
  Work work_ = pool_.work();
  Rig rig_;
  std::vector<std::vector<Silhouette>> captures_;
};

TEST_P(RigCorrectionOfRecordings, AnUnmovedRigNeedsNone) {
  const auto found = correct_rig(rig_, captures_, {}, work_);
  ASSERT_TRUE(found) << found.error().message;
  EXPECT_FALSE(found->needed);
}

TEST_P(RigCorrectionOfRecordings, OneCameraThatWasTurnedIsPutBack) {
  Rig moved = rig_;
  turn(moved, "body-03", 1);
  expect_corrected(moved, {"body-03"});
}

TEST_P(RigCorrectionOfRecordings, TwoCamerasThatWereMovedArePutBack) {
  Rig moved = rig_;
  turn(moved, "body-05", 1);
  // 5 mm are hardly more than a pixel in a small image: there it is turned too.
  constexpr int large_image_px = 900;
  if (rig_.cameras.front().intrinsics.width > large_image_px)
    carry(moved, "body-02", 1);
  else
    turn(moved, "body-02", 0);
  expect_corrected(moved, {"body-02", "body-05"});
}

INSTANTIATE_TEST_SUITE_P(Recordings, RigCorrectionOfRecordings, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
