#include "pipeline/hull/rig_correction.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/hull/rig_correction_report.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

using testing::HasSubstr;
using testing::Not;

constexpr RigCorrectionOptions coarse{.voxel_m = 0.02};

/// Cameras in a ring whose calibration is exact, and two captures: people of different build, a step apart.
struct Booth {
  Rig rig;
  std::vector<std::vector<Silhouette>> captures;

  Booth(int cameras, int width)
      : rig(synthetic::ring_rig({.cameras = cameras, .width = width, .height = width * 4 / 3})) {
    captures.push_back(synthetic::render_silhouettes(synthetic::person().body, rig, 2));
    synthetic::Body other = synthetic::person({.height_m = 1.6, .arm_angle_rad = 1.0, .girth = 1.1}).body;
    const Eigen::Vector3d step(0.15, 0, -0.12);
    for (synthetic::Capsule& capsule : other) capsule.from += step, capsule.to += step;
    captures.push_back(synthetic::render_silhouettes(other, rig, 2));
  }
};
const Booth& booth_of_eight() {
  static const Booth booth(8, 240);
  return booth;
}

Rig with_moved(size_t camera, const Eigen::Vector3d& rotation_rad, const Eigen::Vector3d& translation_m, Rig rig) {
  Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
  if (rotation_rad.norm() > 0)
    motion.linear() = Eigen::AngleAxisd(rotation_rad.norm(), rotation_rad.normalized()).toRotationMatrix();
  motion.translation() = translation_m;
  rig.cameras[camera].camera_from_world = motion * rig.cameras[camera].camera_from_world;
  return rig;
}

/// By how much a camera's picture of the subject's surroundings is off, root of the mean square, pixels.
double off_px(const RigCamera& camera, const RigCamera& truth) {
  double sum = 0, count = 0;
  for (const double x : {-0.3, 0.0, 0.3})
    for (const double y : {0.2, 0.9, 1.6})
      for (const double z : {-0.2, 0.2}) {
        sum += (*project(camera, {x, y, z}) - *project(truth, {x, y, z})).squaredNorm();
        count += 1;
      }
  return std::sqrt(sum / count);
}

const Eigen::Vector3d no_turn = Eigen::Vector3d::Zero();

TEST(RigCorrection, AGoodRigNeedsNone) {
  const auto& [rig, captures] = booth_of_eight();
  const auto found = correct_rig(rig, captures, coarse);
  ASSERT_TRUE(found) << found.error().message;
  EXPECT_FALSE(found->needed);
  EXPECT_EQ(found->captures, 2);
  for (size_t c = 0; c < rig.cameras.size(); ++c) {
    EXPECT_EQ(found->rig.cameras[c].camera_from_world.matrix(), rig.cameras[c].camera_from_world.matrix());
    EXPECT_EQ(found->cameras[c].captures, 2);
    EXPECT_EQ(found->cameras[c].before_px, found->cameras[c].after_px);
  }
  EXPECT_THAT(rig_correction_report_html(*found), HasSubstr("no correction needed"));
}

TEST(RigCorrection, TwoMovedCamerasArePutBackAndNoOther) {
  const auto [rig, captures] = Booth(9, 300);
  const Rig moved = with_moved(6, no_turn, {0.03, -0.01, 0}, with_moved(2, {0.004, 0.009, 0}, {0, 0, 0}, rig));
  const auto found = correct_rig(moved, captures, coarse);
  ASSERT_TRUE(found) << found.error().message;
  EXPECT_TRUE(found->needed);
  for (size_t c = 0; c < rig.cameras.size(); ++c) {
    const CameraCorrection& one = found->cameras[c];
    EXPECT_EQ(one.moved, c == 2 || c == 6) << c;
    if (!one.moved) {
      EXPECT_EQ(found->rig.cameras[c].camera_from_world.matrix(), rig.cameras[c].camera_from_world.matrix());
      continue;
    }
    EXPECT_GT(off_px(moved.cameras[c], rig.cameras[c]), 2.0);
    EXPECT_LT(off_px(found->rig.cameras[c], rig.cameras[c]), 0.5) << c;
    EXPECT_LT(one.after_px, 0.3 * one.before_px) << c;
    const double off_m = (found->rig.cameras[c].center() - rig.cameras[c].center()).norm();
    EXPECT_LT(off_m, 3 * one.uncertainty.center_m) << c;
    EXPECT_EQ(found->rig.cameras[c].uncertainty->center_m, one.uncertainty.center_m);
  }
  const std::string page = rig_correction_report_html(*found);
  EXPECT_THAT(page, HasSubstr(rig.cameras[2].id + ": carried by"));
  EXPECT_THAT(page, HasSubstr(rig.cameras[6].id + ": carried by"));
  EXPECT_THAT(page, Not(HasSubstr(rig.cameras[3].id + ": carried by")));
}

/// Either could explain a part of what both did.
TEST(RigCorrection, OfTwoMovedCamerasThatFaceEachOtherItSaysThatItCannotTell) {
  const auto& [rig, captures] = booth_of_eight();
  const Rig moved = with_moved(6, no_turn, {0.03, -0.01, 0}, with_moved(2, {0.004, 0.009, 0}, {0, 0, 0}, rig));
  const auto found = correct_rig(moved, captures, coarse);
  ASSERT_TRUE(found) << found.error().message;
  EXPECT_FALSE(found->needed);
  for (size_t c = 0; c < rig.cameras.size(); ++c) EXPECT_EQ(found->cameras[c].doubtful, c == 2 || c == 6) << c;
  EXPECT_EQ(describe(*found),
            "no correction possible: the silhouettes of body-02, body-06 contradict the others, but 2 captures cannot "
            "tell who moved: calibrate with the board");
}

TEST(RigCorrection, SeveralCapturesLeaveLessInDoubt) {
  const auto [rig, captures] = Booth(9, 240);  // no camera faces another
  const Rig moved = with_moved(4, {0, 0.009, 0}, {0, 0, 0}, rig);
  const auto one = correct_rig(moved, std::span(captures).first(1), coarse);
  const auto both = correct_rig(moved, captures, coarse);
  ASSERT_TRUE(one && both);
  ASSERT_TRUE(one->cameras[4].moved && both->cameras[4].moved);
  EXPECT_LT(both->cameras[4].uncertainty.center_m, 0.9 * one->cameras[4].uncertainty.center_m);
  EXPECT_LT(both->cameras[4].uncertainty.rotation_rad, 0.9 * one->cameras[4].uncertainty.rotation_rad);
}

TEST(RigCorrection, GivesTheSameWhateverTheThreadCount) {
  const auto& [rig, captures] = booth_of_eight();
  const Rig moved = with_moved(1, {0.009, 0, 0}, {0, 0, 0}, rig);
  ThreadPool pool(3);
  const auto serial = correct_rig(moved, std::span(captures).first(1), coarse);
  const auto parallel = correct_rig(moved, std::span(captures).first(1), coarse, pool.work());
  ASSERT_TRUE(serial && parallel);
  EXPECT_EQ(serial->rig.cameras[1].camera_from_world.matrix(), parallel->rig.cameras[1].camera_from_world.matrix());
  EXPECT_EQ(rig_correction_report_html(*serial), rig_correction_report_html(*parallel));
}

TEST(RigCorrection, SaysWhyItCannotTell) {
  const auto& [rig, captures] = booth_of_eight();
  EXPECT_FALSE(correct_rig(rig, {}, coarse));
  std::vector<std::vector<Silhouette>> few{{captures[0].begin(), captures[0].begin() + 5}};
  const auto found = correct_rig(rig, few, coarse);
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, ErrorCode::too_few_views);
  // A capture in which nobody is seen is left out, and said.
  std::vector<std::vector<Silhouette>> one_empty{captures[0], captures[1]};
  for (Silhouette& silhouette : one_empty[1])
    std::fill(silhouette.coverage.samples.begin(), silhouette.coverage.samples.end(), uint8_t{0});
  const auto from_one = correct_rig(rig, one_empty, coarse);
  ASSERT_TRUE(from_one);
  EXPECT_EQ(from_one->captures, 1);
  EXPECT_THAT(from_one->messages, testing::ElementsAre(HasSubstr("capture 2 was left out")));
}

}  // namespace
}  // namespace booth
