#include "pipeline/face/transformation_pyramids.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <map>
#include <random>

namespace booth {
namespace {

/// Directions within some 60° of +Z at distances of about ten centimetres, as a face's landmarks around a head's
/// middle.
std::vector<Eigen::Vector3d> random_controls(size_t count, uint32_t seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> across(-1, 1), far(0.09, 0.12);
  std::vector<Eigen::Vector3d> controls;
  for (size_t i = 0; i < count; ++i)
    controls.push_back(far(random) * Eigen::Vector3d(across(random), across(random), 1).normalized());
  return controls;
}

TEST(TransformationPyramids, OneBaseHasKnownCoordinates) {
  const std::vector<Eigen::Vector3d> controls{{0, 0, 1}, {1, 0, 1}, {0, 1, 1}};
  const TransformationPyramids pyramids(Eigen::Vector3d::Zero(), controls);
  ASSERT_EQ(pyramids.bases().size(), 1U);
  const auto at = pyramids.locate({0.5, 0.25, 2});  // twice as far as its foot (0.25, 0.125, 1)
  ASSERT_TRUE(at.has_value());
  EXPECT_NEAR(at->delta, 2, 1e-12);
  EXPECT_NEAR((pyramids.evaluate(*at, {0, 0, 0}, controls) - Eigen::Vector3d(0.5, 0.25, 2)).norm(), 0, 1e-12);
  // The second control point twice as far away: the foot goes by its share of a quarter.
  std::vector<Eigen::Vector3d> moved = controls;
  for (Eigen::Vector3d& p : moved)
    if (p.x() > 0.5) p *= 2;
  EXPECT_NEAR((pyramids.evaluate(*at, {0, 0, 0}, moved) - Eigen::Vector3d(1, 0.25, 2.5)).norm(), 0, 1e-12);
  EXPECT_FALSE(pyramids.locate({-0.1, 0.2, 1}).has_value());
  EXPECT_FALSE(pyramids.locate({-0.1, -0.1, -1}).has_value());
  EXPECT_FALSE(pyramids.locate({0, 0, 0}).has_value());
}

TEST(TransformationPyramids, BasesFillTheDirectionsOnceAndFaceOutwards) {
  const auto controls = random_controls(60, 3);
  const TransformationPyramids pyramids(Eigen::Vector3d::Zero(), controls);
  std::map<std::array<uint32_t, 2>, int> directed;
  for (const auto& base : pyramids.bases()) {
    EXPECT_GT(controls[base[0]].dot(controls[base[1]].cross(controls[base[2]])), 0);
    for (size_t k = 0; k < 3; ++k) ++directed[{base[k], base[(k + 1) % 3]}];
  }
  for (const auto& [edge, times] : directed) EXPECT_EQ(times, 1);
  // Every mean of three control points lies in exactly one pyramid: the pyramids leave no gap and do not overlap.
  std::mt19937 random(7);
  std::uniform_int_distribution<size_t> any(0, controls.size() - 1);
  for (int trial = 0; trial < 300; ++trial) {
    const Eigen::Vector3d p = controls[any(random)] + controls[any(random)] + controls[any(random)];
    int inside = 0;
    for (const auto& [a, b, c] : pyramids.bases()) {
      const auto side = [&](uint32_t i, uint32_t k) { return p.dot(controls[i].cross(controls[k])); };
      inside += side(a, b) > 1e-9 && side(b, c) > 1e-9 && side(c, a) > 1e-9 ? 1 : 0;
    }
    EXPECT_LE(inside, 1);
    EXPECT_TRUE(pyramids.locate(p).has_value());
  }
}

TEST(TransformationPyramids, SameControlsGiveTheSamePlace) {
  const auto controls = random_controls(40, 5);
  const Eigen::Vector3d apex(0.01, -0.02, 0.005);
  const TransformationPyramids pyramids(apex, controls);
  for (const Eigen::Vector3d& p : random_controls(200, 6))
    if (const auto at = pyramids.locate(p)) {
      EXPECT_LT((pyramids.evaluate(*at, apex, controls) - p).norm(), 1e-12);
    }
}

TEST(TransformationPyramids, CarryOverEveryAffineMapExactly) {
  const auto controls = random_controls(40, 8);
  Eigen::Affine3d map = Eigen::Affine3d::Identity();
  map.linear() << 1.1, 0.2, -0.1, 0.05, 0.9, 0.15, -0.2, 0.1, 1.3;
  map.translation() << 0.3, 1.5, -0.2;
  std::vector<Eigen::Vector3d> mapped;
  for (const Eigen::Vector3d& p : controls) mapped.push_back(map * p);
  const TransformationPyramids pyramids(Eigen::Vector3d::Zero(), controls);
  for (const Eigen::Vector3d& p : random_controls(200, 9))
    if (const auto at = pyramids.locate(p)) {
      EXPECT_LT((pyramids.evaluate(*at, map.translation(), mapped) - map * p).norm(), 1e-12);
    }
}

TEST(TransformationPyramids, HaveNoGapBetweenThem) {
  const auto controls = random_controls(40, 10);
  std::vector<Eigen::Vector3d> moved = random_controls(40, 11);
  for (size_t i = 0; i < moved.size(); ++i) moved[i] = controls[i] + 0.05 * moved[i];
  const TransformationPyramids pyramids(Eigen::Vector3d::Zero(), controls);
  std::map<std::array<uint32_t, 2>, std::vector<uint32_t>> pyramids_of;
  for (uint32_t i = 0; i < pyramids.bases().size(); ++i)
    for (size_t k = 0; k < 3; ++k) {
      const uint32_t a = pyramids.bases()[i][k], b = pyramids.bases()[i][(k + 1) % 3];
      pyramids_of[{std::min(a, b), std::max(a, b)}].push_back(i);
    }
  int sides = 0;
  for (const auto& [edge, both] : pyramids_of) {
    if (both.size() != 2) continue;
    // A point of the side that both share, a hair to each side of it.
    const Eigen::Vector3d on = 1.2 * (0.3 * controls[edge[0]] + 0.7 * controls[edge[1]]);
    const Eigen::Vector3d across = controls[edge[0]].cross(controls[edge[1]]).normalized();
    constexpr double hair_m = 1e-7;
    const auto before = pyramids.locate(on - hair_m * across), after = pyramids.locate(on + hair_m * across);
    ASSERT_TRUE(before && after);
    EXPECT_NE(before->pyramid, after->pyramid);
    EXPECT_LT((pyramids.evaluate(*before, {0, 0, 0}, moved) - pyramids.evaluate(*after, {0, 0, 0}, moved)).norm(),
              1e-5);
    ++sides;
  }
  EXPECT_GT(sides, 40);
}

TEST(TransformationPyramids, PointsOfOneDirectionMakeNoFlatPyramid) {
  auto controls = random_controls(20, 12);
  controls.push_back(1.1 * controls.front());
  const TransformationPyramids pyramids(Eigen::Vector3d::Zero(), controls);
  for (const auto& base : pyramids.bases()) EXPECT_LT(std::max({base[0], base[1], base[2]}), 20U);
  EXPECT_TRUE(pyramids.locate(controls.back()).has_value());
}

TEST(TransformationPyramids, TooFewPointsMakeNone) {
  EXPECT_TRUE(TransformationPyramids({0, 0, 0}, {}).bases().empty());
  EXPECT_TRUE(TransformationPyramids({0, 0, 0}, random_controls(2, 1)).bases().empty());
}

}  // namespace
}  // namespace booth
