#include "pipeline/geometry/point_triangulation.h"

#include <gtest/gtest.h>

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <random>

#include "pipeline/geometry/camera_model.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

const Eigen::Vector3d face(0.05, 1.55, 0.1);

CalibratedView pinhole(const Eigen::Vector3d& center, double focal_px = 1000) {
  CalibratedView view;
  view.intrinsics = {.width = 800, .height = 600, .fx = focal_px, .fy = focal_px, .cx = 400, .cy = 300};
  view.camera_from_world.translation() = -center;  // looks along +z of the world
  return view;
}

/// What the views see of a point, with noise.
std::vector<Sighting> sight(const Rig& rig, const Eigen::Vector3d& point, double sigma_px, std::mt19937* random) {
  std::normal_distribution<double> noise(0, sigma_px);
  std::vector<Sighting> sightings;
  for (const RigCamera& camera : rig.cameras) {
    const double right = noise(*random), down = noise(*random);
    sightings.push_back({&camera, *project(camera, point) + Eigen::Vector2d(right, down), sigma_px});
  }
  return sightings;
}

double cost(const Sighting& a, const Sighting& b, const Eigen::Vector3d& p) {
  return ((*project(*a.view, p) - a.pixel) / a.sigma_px).squaredNorm() +
         ((*project(*b.view, p) - b.pixel) / b.sigma_px).squaredNorm();
}

TEST(TriangulatePair, FindsAPointThatBothSeeExactly) {
  const Rig rig = synthetic::ring_rig({.cameras = 7});
  for (size_t i = 0; i < rig.cameras.size(); ++i)
    for (size_t j = 0; j < i; ++j) {
      const auto found = triangulate_pair({&rig.cameras[i], *project(rig.cameras[i], face), 1},
                                          {&rig.cameras[j], *project(rig.cameras[j], face), 1});
      ASSERT_TRUE(found) << i << " " << j;
      EXPECT_LT((*found - face).norm(), 1e-7) << i << " " << j;
    }
}

TEST(TriangulatePair, SharesAMisfitEquallyBetweenEqualViews) {
  // Side by side, the same row is the same plane: rows 3 px up in one and 3 px down in the other meet in the middle.
  const CalibratedView left = pinhole({-0.1, 0, 0}), right = pinhole({0.1, 0, 0});
  const auto found = triangulate_pair({&left, {450, 297}, 1}, {&right, {350, 303}, 1});
  ASSERT_TRUE(found);
  EXPECT_LT((*found - Eigen::Vector3d(0, 0, 2)).norm(), 1e-9);
}

TEST(TriangulatePair, TrustsTheSurerViewMore) {
  const CalibratedView left = pinhole({-0.1, 0, 0}), right = pinhole({0.1, 0, 0});
  // Corrections fall as the variances, 1 : 4, of the 6 px between the rows.
  const auto found = triangulate_pair({&left, {450, 300}, 1}, {&right, {350, 306}, 2});
  ASSERT_TRUE(found);
  EXPECT_NEAR(project(left, *found)->y(), 301.2, 1e-6);
  EXPECT_NEAR(project(right, *found)->y(), 301.2, 1e-6);
}

TEST(TriangulatePair, NoPointNearByFitsBetter) {
  std::mt19937 random(3);
  const Rig rig = synthetic::ring_rig({.cameras = 6, .distorted = false});
  for (int trial = 0; trial < 30; ++trial) {
    const std::vector<Sighting> seen = sight(rig, face, 8, &random);
    const Sighting a = seen[static_cast<size_t>(trial % 6)],
                   b = seen[static_cast<size_t>((trial + 1 + trial / 6 % 2) % 6)];
    const auto found = triangulate_pair(a, b);
    ASSERT_TRUE(found);
    const double least = cost(a, b, *found);
    for (const double step : {1e-5, 1e-3, 1e-1})
      for (int axis = 0; axis < 3; ++axis)
        for (const double sign : {-1.0, 1.0})
          EXPECT_GE(cost(a, b, *found + sign * step * Eigen::Vector3d::Unit(axis)), least * (1 - 1e-9));
  }
}

TEST(TriangulatePair, RefusesRaysThatDoNotMeetInFront) {
  const CalibratedView left = pinhole({-0.1, 0, 0}), right = pinhole({0.1, 0, 0});
  EXPECT_FALSE(triangulate_pair({&left, {350, 300}, 1}, {&right, {450, 300}, 1})) << "they meet behind";
  EXPECT_FALSE(triangulate_pair({&left, {350, 300}, 1}, {&left, {350, 300}, 1})) << "one place";
}

TEST(TriangulateViews, AgreesWithTheOptimalPair) {
  std::mt19937 random(5);
  const Rig rig = synthetic::ring_rig({.cameras = 8, .distorted = false});
  for (int trial = 0; trial < 20; ++trial) {
    const auto seen = sight(rig, face, 3, &random);
    const std::vector<Sighting> pair{seen[0], seen[1]};
    const auto optimal = triangulate_pair(pair[0], pair[1]);
    ASSERT_TRUE(optimal);
    const auto fitted = triangulate_views(pair, *optimal + Eigen::Vector3d(0.02, -0.01, 0.03));
    ASSERT_TRUE(fitted);
    EXPECT_LT((fitted->position - *optimal).norm(), 1e-6);
  }
}

TEST(TriangulateViews, ErrsAsMuchAsItSays) {
  std::mt19937 random(7);
  const Rig rig = synthetic::ring_rig({.cameras = 5});
  constexpr int trials = 400;
  double squares = 0, chi_square = 0;
  for (int trial = 0; trial < trials; ++trial) {
    const auto seen = sight(rig, face, 0.7, &random);
    const auto found = triangulate_views(seen, face + Eigen::Vector3d(0.01, 0, 0));
    ASSERT_TRUE(found);
    const Eigen::Vector3d error = found->position - face;
    squares += error.dot(found->covariance.inverse() * error);
    chi_square += found->chi_square;
    EXPECT_EQ(found->degrees_of_freedom, 7);
  }
  // χ² of three degrees of freedom has the mean 3 and the variance 6; that of seven 7 and 14.
  EXPECT_NEAR(squares / trials, 3, 4 * std::sqrt(6.0 / trials));
  EXPECT_NEAR(chi_square / trials, 7, 4 * std::sqrt(14.0 / trials));
}

TEST(TriangulateViews, SaysWhenTheViewsDoNotFixThePoint) {
  const CalibratedView left = pinhole({0, 0, 0}), right = pinhole({1e-6, 0, 0});
  const std::vector<Sighting> seen{{&left, {400, 300}, 1}, {&right, {400, 300}, 1}};
  EXPECT_FALSE(triangulate_views(seen, {0, 0, 2}));
  EXPECT_FALSE(triangulate_views(std::span(seen).first(1), {0, 0, 2}));
  EXPECT_FALSE(triangulate_views(seen, {0, 0, -2})) << "behind";
}

TEST(TriangulateConsensus, LeavesOutViewsThatAreWrong) {
  std::mt19937 random(11);
  std::uniform_real_distribution<double> anywhere(40, 200);
  const Rig rig = synthetic::ring_rig({.cameras = 8});
  for (int trial = 0; trial < 20; ++trial) {
    auto seen = sight(rig, face, 0.5, &random);
    const auto wrong = static_cast<size_t>(trial % 8);
    for (const size_t w : {wrong, (wrong + 3) % 8, (wrong + 4) % 8})
      seen[w].pixel += Eigen::Vector2d(anywhere(random), -anywhere(random)) / 8;
    const auto found = triangulate_consensus(seen, 5);
    ASSERT_TRUE(found);
    for (size_t i = 0; i < seen.size(); ++i)
      EXPECT_EQ(found->agrees[i], i != wrong && i != (wrong + 3) % 8 && i != (wrong + 4) % 8) << trial << ": " << i;
    const Eigen::Vector3d error = found->point.position - face;
    EXPECT_LT(error.dot(found->point.covariance.inverse() * error), 25);
  }
}

TEST(TriangulateConsensus, DoesNotDependOnTheOrderOfViews) {
  std::mt19937 random(13);
  const Rig rig = synthetic::ring_rig({.cameras = 6});
  auto seen = sight(rig, face, 1, &random);
  seen[2].pixel.x() += 30;
  const auto found = triangulate_consensus(seen, 4);
  std::reverse(seen.begin(), seen.end());
  const auto again = triangulate_consensus(seen, 4);
  ASSERT_TRUE(found && again);
  EXPECT_LT((found->point.position - again->point.position).norm(), 1e-8);
  EXPECT_FALSE(again->agrees[3]);
}

TEST(TriangulateConsensus, FindsNothingWhereNoTwoAgree) {
  const CalibratedView left = pinhole({-0.1, 0, 0}), right = pinhole({0.1, 0, 0});
  const std::vector<Sighting> seen{{&left, {450, 200}, 1}, {&right, {350, 400}, 1}};
  EXPECT_FALSE(triangulate_consensus(seen, 4));
  EXPECT_FALSE(triangulate_consensus(std::span(seen).first(1), 4));
}

}  // namespace
}  // namespace booth
