#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <numbers>
#include <random>

#include "pipeline/face/control_points.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

using ::testing::HasSubstr;

constexpr size_t first_inner = 17;
const Eigen::Vector3d face_middle(0, 1.6, 0.12);

/// Landmarks of a schematic face that looks along +Z, metres: every group at its place on an ellipsoid.
std::array<Eigen::Vector3d, face_landmarks> schematic_face() {
  std::array<Eigen::Vector3d, face_landmarks> face;
  const auto at = [&](double x_mm, double y_mm, double before_mm = 0) {
    const double round_mm = -0.008 * x_mm * x_mm - 0.002 * y_mm * y_mm;
    return Eigen::Vector3d(face_middle + Eigen::Vector3d(x_mm, y_mm, round_mm + before_mm) / 1000);
  };
  for (size_t i = 0; i <= 16; ++i) {
    const double angle = std::numbers::pi * static_cast<double>(i) / 16;
    face[i] = at(-70 * std::cos(angle), 35 - 110 * std::sin(angle));
  }
  for (size_t i = 0; i < 5; ++i) {
    face[17 + i] = at(-55 + 10.0 * static_cast<double>(i), 55);
    face[22 + i] = at(15 + 10.0 * static_cast<double>(i), 55);
  }
  for (size_t i = 0; i < 4; ++i) face[27 + i] = at(0, 30 - 13.0 * static_cast<double>(i), 5.0 * static_cast<double>(i));
  for (size_t i = 0; i < 5; ++i) face[31 + i] = at(-14 + 7.0 * static_cast<double>(i), -18, 8);
  for (size_t i = 0; i < 6; ++i) {
    const double angle = 2 * std::numbers::pi * static_cast<double>(i) / 6;
    face[36 + i] = at(-31 - 14 * std::cos(angle), 32 + 5 * std::sin(angle));
    face[42 + i] = at(31 - 14 * std::cos(angle), 32 + 5 * std::sin(angle));
  }
  for (size_t i = 0; i < 20; ++i) {
    const double angle = 2 * std::numbers::pi * static_cast<double>(i) / 20;
    face[48 + i] = at(-24 * std::cos(angle), -45 + 8 * std::sin(angle), 4);
  }
  return face;
}

HeadRegion head() { return {.barycentre = {0, 1.62F, 0.02F}, .neck_y = 1.5F, .crown_y = 1.75F}; }

RigCamera camera_at(const std::string& id, double azimuth_rad, double height_m) {
  RigCamera camera;
  camera.id = id;
  camera.intrinsics = {.width = 1200, .height = 1600, .fx = 1400, .fy = 1400, .cx = 600, .cy = 800};
  camera.intrinsics.distortion = {-0.05, 0.01, 0, 0, 0};
  const Eigen::Vector3d center(2.2 * std::sin(azimuth_rad), height_m, 2.2 * std::cos(azimuth_rad));
  const Eigen::Vector3d forward = (Eigen::Vector3d(0, 1.2, 0) - center).normalized();
  const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
  Eigen::Matrix3d rows;
  rows << right.transpose(), forward.cross(right).transpose(), forward.transpose();
  camera.camera_from_world.linear() = rows;
  camera.camera_from_world.translation() = -rows * center;
  return camera;
}

Rig frontal_rig() {
  Rig rig;
  rig.volume = {Eigen::Vector3d(-0.9, 0, -0.6), Eigen::Vector3d(0.9, 2.2, 0.6)};
  rig.cameras = {camera_at("a", -0.7, 1.9), camera_at("b", -0.35, 1.5), camera_at("c", 0, 0.9),
                 camera_at("d", 0.35, 1.5), camera_at("e", 0.7, 1.9)};
  return rig;
}

std::vector<FaceObservation> observe(const Rig& rig, const std::array<Eigen::Vector3d, face_landmarks>& face,
                                     double noise_px, uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, noise_px);
  std::vector<FaceObservation> observations;
  for (const RigCamera& camera : rig.cameras) {
    FaceObservation seen;
    seen.camera = camera.id;
    seen.score = 1;
    seen.box_px = 95;  // 0.15 m
    for (size_t l = 0; l < face_landmarks; ++l) {
      const double right = noise(random), down = noise(random);
      seen.pixels[l] = *project(camera, face[l]) + Eigen::Vector2d(right, down);
      seen.sigma_px[l] = noise_px;
    }
    observations.push_back(seen);
  }
  return observations;
}

TEST(LandmarkPlacement, FindsWhatWasProjected) {
  const Rig rig = frontal_rig();
  const auto face = schematic_face();
  const auto placed = place_landmarks(rig, observe(rig, face, 0, 1), head());
  ASSERT_TRUE(placed) << placed.error().message;
  for (size_t l = 0; l < face_landmarks; ++l) {
    ASSERT_TRUE(placed->points[l]) << l;
    EXPECT_LT((placed->points[l]->position - face[l]).norm(), 1e-6) << l;
    EXPECT_EQ(placed->points[l]->views, 5) << l;
    EXPECT_EQ(placed->points[l]->contour, l < first_inner) << l;
  }
  EXPECT_LT((placed->frame.forward - Eigen::Vector3d::UnitZ()).norm(), 0.15);
  EXPECT_LT((placed->frame.left - Eigen::Vector3d::UnitX()).norm(), 1e-6);
  EXPECT_NEAR(placed->frame.eye_distance_m, 0.062, 1e-3);
}

TEST(LandmarkPlacement, IsNotSurerThanItIsRight) {
  const Rig rig = frontal_rig();
  const auto face = schematic_face();
  double squares = 0;
  int count = 0;
  for (uint32_t seed = 0; seed < 20; ++seed) {
    const auto placed = place_landmarks(rig, observe(rig, face, 1.5, seed), head());
    ASSERT_TRUE(placed) << placed.error().message;
    for (size_t l = first_inner; l < face_landmarks; ++l) {
      if (!placed->points[l]) continue;
      const Eigen::Vector3d error = placed->points[l]->position - face[l];
      squares += error.dot(placed->points[l]->covariance.inverse() * error);
      ++count;
    }
  }
  // χ² of three degrees of freedom; the model's own errors, which are assumed on top, leave room below.
  EXPECT_LT(squares / count, 3);
  EXPECT_GT(squares / count, 0.5) << "an uncertainty that is far too large is none";
}

TEST(LandmarkPlacement, JawLineIsTheLessCertain) {
  const Rig rig = frontal_rig();
  const auto placed = place_landmarks(rig, observe(rig, schematic_face(), 1, 3), head());
  ASSERT_TRUE(placed) << placed.error().message;
  double jaw = 0, inner = 0;
  for (size_t l = 0; l < face_landmarks; ++l)
    if (placed->points[l])
      (l < first_inner ? jaw : inner) = std::max(l < first_inner ? jaw : inner, placed->points[l]->covariance.trace());
  EXPECT_GT(jaw, 2 * inner);
}

TEST(LandmarkPlacement, LeavesOutAViewThatSawSomethingElse) {
  const Rig rig = frontal_rig();
  const auto face = schematic_face();
  auto observations = observe(rig, face, 0.5, 5);
  for (Eigen::Vector2d& pixel : observations[3].pixels) pixel = {700 + 0.3 * (pixel.y() - 500), 500 - 0.4 * pixel.x()};
  const auto placed = place_landmarks(rig, observations, head());
  ASSERT_TRUE(placed) << placed.error().message;
  ASSERT_EQ(placed->observations.size(), 4U);
  EXPECT_TRUE(std::none_of(placed->observations.begin(), placed->observations.end(),
                           [](const FaceObservation& seen) { return seen.camera == "d"; }));
  for (size_t l = first_inner; l < face_landmarks; ++l)
    EXPECT_LT((placed->points[l]->position - face[l]).norm(), 0.006) << l;
}

TEST(LandmarkPlacement, LeavesOutSingleLandmarksThatAreWrong) {
  const Rig rig = frontal_rig();
  const auto face = schematic_face();
  auto observations = observe(rig, face, 0.5, 7);
  constexpr size_t mouth_corner = 48, brow = 19;
  observations[1].pixels[mouth_corner] += Eigen::Vector2d(15, -20);
  observations[2].pixels[brow] += Eigen::Vector2d(-25, 5);
  const auto placed = place_landmarks(rig, observations, head());
  ASSERT_TRUE(placed) << placed.error().message;
  EXPECT_FALSE(placed->observations[1].agrees[mouth_corner]);
  EXPECT_FALSE(placed->observations[2].agrees[brow]);
  EXPECT_TRUE(placed->observations[1].agrees[brow]);
  EXPECT_EQ(placed->points[mouth_corner]->views, 4);
  EXPECT_LT((placed->points[mouth_corner]->position - face[mouth_corner]).norm(), 0.004);
  EXPECT_LT((placed->points[brow]->position - face[brow]).norm(), 0.004);
}

TEST(LandmarkPlacement, TwoViewsAreEnoughAndOneIsNot) {
  const Rig rig = frontal_rig();
  const auto face = schematic_face();
  auto observations = observe(rig, face, 0.3, 9);
  observations = {observations[1], observations[3]};
  const auto placed = place_landmarks(rig, observations, head());
  ASSERT_TRUE(placed) << placed.error().message;
  EXPECT_LT((placed->points[30]->position - face[30]).norm(), 0.004);

  observations.pop_back();
  const auto alone = place_landmarks(rig, observations, head());
  ASSERT_FALSE(alone);
  EXPECT_EQ(alone.error().code, ErrorCode::too_few_views);
  EXPECT_THAT(alone.error().message, HasSubstr("b"));
}

TEST(LandmarkPlacement, RefusesTwoViewsThatDoNotAgree) {
  const Rig rig = frontal_rig();
  auto observations = observe(rig, schematic_face(), 0.3, 11);
  observations = {observations[1], observations[3]};
  for (Eigen::Vector2d& pixel : observations[1].pixels) pixel.y() += 80;
  const auto placed = place_landmarks(rig, observations, head());
  ASSERT_FALSE(placed);
  EXPECT_EQ(placed.error().code, ErrorCode::too_few_views);
  EXPECT_THAT(placed.error().message, HasSubstr("no two cameras agree"));
}

TEST(LandmarkPlacement, RefusesWhatIsNoFaceOfThatHead) {
  const Rig rig = frontal_rig();
  const auto refusal = [&](const auto& moved) {
    auto face = schematic_face();
    for (Eigen::Vector3d& p : face) p = moved(Eigen::Vector3d(p - face_middle)) + face_middle;
    const auto placed = place_landmarks(rig, observe(rig, face, 0, 1), head());
    return placed ? std::string("accepted") : placed.error().message;
  };
  EXPECT_THAT(refusal([](Eigen::Vector3d p) { return Eigen::Vector3d(2 * p); }), HasSubstr("mm apart"));
  EXPECT_THAT(refusal([](Eigen::Vector3d p) { return Eigen::Vector3d(p.y(), -p.x(), p.z()); }), HasSubstr("upright"));
  EXPECT_THAT(refusal([](Eigen::Vector3d p) { return Eigen::Vector3d(p + Eigen::Vector3d(0, -0.6, 0)); }),
              HasSubstr("on the head"));
}

TEST(LandmarkPlacement, DoesNotDependOnTheOrderOfObservations) {
  const Rig rig = frontal_rig();
  auto observations = observe(rig, schematic_face(), 1, 13);
  const auto placed = place_landmarks(rig, observations, head());
  std::swap(observations[0], observations[4]);
  std::swap(observations[1], observations[2]);
  const auto again = place_landmarks(rig, observations, head());
  ASSERT_TRUE(placed && again);
  for (size_t l = 0; l < face_landmarks; ++l) {
    ASSERT_EQ(placed->points[l].has_value(), again->points[l].has_value()) << l;
    if (placed->points[l]) {
      EXPECT_EQ(placed->points[l]->position, again->points[l]->position) << l;
    }
  }
}

TEST(LandmarkPlacement, LeavesOutCamerasThatTheRigDoesNotHave) {
  const Rig rig = frontal_rig();
  auto observations = observe(rig, schematic_face(), 0.5, 15);
  observations.push_back(observations.front());
  observations.back().camera = "unknown";
  const auto placed = place_landmarks(rig, observations, head());
  ASSERT_TRUE(placed) << placed.error().message;
  EXPECT_EQ(placed->observations.size(), 5U);
}

}  // namespace
}  // namespace booth
