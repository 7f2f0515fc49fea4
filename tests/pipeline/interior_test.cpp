#include "pipeline/geometry/interior.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>
#include <vector>

#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

using Eigen::Vector3d;

Mesh surface_of(const synthetic::Body& body) { return extract_surface(synthetic::sample_field(body, 0.02)); }

size_t nearest_voxel(const Interior& interior, const Vector3d& p) {
  return *std::min_element(interior.inside.begin(), interior.inside.end(), [&](uint32_t a, uint32_t b) {
    return (interior.point(a) - p).squaredNorm() < (interior.point(b) - p).squaredNorm();
  });
}

double volume(const Interior& interior) {
  return static_cast<double>(interior.inside.size()) * std::pow(interior.grid.voxel_m, 3);
}

TEST(Interior, ABallHasItsVolumeAndDepths) {
  const double radius = 0.5;
  const Interior interior = sample_interior(surface_of(synthetic::sphere(radius)), 60);
  EXPECT_NEAR(volume(interior), 4.0 / 3 * std::numbers::pi * std::pow(radius, 3), 0.01);
  for (const uint32_t v : interior.inside) {
    const double truth = radius - (interior.point(v) - Vector3d(0, radius, 0)).norm();
    EXPECT_NEAR(static_cast<double>(interior.depth_m[v]), truth, 1.2 * interior.grid.voxel_m);
  }
  EXPECT_NEAR(interior.depth({0.2, radius, 0}), 0.3, interior.grid.voxel_m);
  EXPECT_EQ(interior.depth({2, 0, 0}), 0);
}

TEST(Interior, KeepsTheLargestPartAndFillsOverlaps) {
  const Mesh ball = surface_of(synthetic::sphere(0.5));
  Mesh mesh = ball;
  const auto append = [&](const Mesh& part, const Eigen::Vector3f& step) {
    const uint32_t first = static_cast<uint32_t>(mesh.positions.size());
    for (const auto& p : part.positions) mesh.positions.push_back(p + step);
    for (const auto& t : part.triangles) mesh.triangles.push_back({t[0] + first, t[1] + first, t[2] + first});
  };
  append(surface_of(synthetic::sphere(0.1)), {1.0F, 0.4F, 0});  // beside it
  append(surface_of(synthetic::sphere(0.2)), {0, 0.3F, 0});     // inside it
  EXPECT_NEAR(volume(sample_interior(mesh, 60)), volume(sample_interior(ball, 60)), 0.005);
}

TEST(Interior, AFlatMeshEnclosesNothing) {
  Mesh flat;
  flat.positions = {{0, 0, 0}, {0.5F, 0, 0}, {0, 1.7F, 0}};
  flat.triangles = {{0, 1, 2}};
  EXPECT_TRUE(sample_interior(flat, 60).inside.empty());
}

/// Two legs joined at the top.
synthetic::Body horseshoe() {
  return {{{-0.4, 0, 0}, {-0.4, 1, 0}, 0.1, 0.1},
          {{-0.4, 1, 0}, {0.4, 1, 0}, 0.1, 0.1},
          {{0.4, 1, 0}, {0.4, 0, 0}, 0.1, 0.1}};
}

TEST(Geodesics, GoAroundGaps) {
  const Interior interior = sample_interior(surface_of(horseshoe()), 80);
  const size_t from = nearest_voxel(interior, {-0.4, 0, 0}), to = nearest_voxel(interior, {0.4, 0, 0});
  const Geodesics ways = geodesics_from(interior, std::array{GeodesicSource{from, 0}});
  const double way = ways.steps[to] * interior.grid.voxel_m / 10;
  EXPECT_GT(way, 2.3);
  EXPECT_LT(way, 2.8);
  // Two sources share the body in the middle; a lead moves the border.
  const auto share_of_first = [&](uint32_t start) {
    const Geodesics both = geodesics_from(interior, std::array{GeodesicSource{from, start}, GeodesicSource{to, 0}});
    const auto first =
        std::count_if(interior.inside.begin(), interior.inside.end(), [&](uint32_t v) { return both.origin[v] == 0; });
    return static_cast<double>(first) / static_cast<double>(interior.inside.size());
  };
  EXPECT_NEAR(share_of_first(0), 0.5, 0.03);
  EXPECT_LT(share_of_first(300), 0.45);
}

TEST(Extremities, AreTheEndsOfTheShapeWithTheirLimbs) {
  const Interior interior = sample_interior(surface_of(horseshoe()), 80);
  const size_t top = nearest_voxel(interior, {0, 1, 0});
  const Geodesics ways = geodesics_from(interior, std::array{GeodesicSource{top, 0}});
  const auto ends = find_extremities(interior, ways, 100);
  ASSERT_EQ(ends.size(), 2U);
  for (const Extremity& end : ends) EXPECT_LT(interior.point(end.tip).y(), 0.05);
  EXPECT_EQ(ends[0].saddle_steps, 0U);
  const auto limbs = limbs_of(interior, ways, {ends[0].tip, ends[1].tip});
  ASSERT_EQ(limbs.size(), 2U);
  for (size_t n = 0; n < 2; ++n) {
    EXPECT_EQ(limbs[n].front(), ends[n].tip);
    for (const uint32_t v : limbs[n]) EXPECT_GT(interior.point(v).x() * interior.point(ends[n].tip).x(), -0.01);
    EXPECT_GT(limbs[n].size(), interior.inside.size() / 3);
  }
}

}  // namespace
}  // namespace booth
