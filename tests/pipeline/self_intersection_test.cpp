#include "pipeline/surface/self_intersection.h"

#include <gtest/gtest.h>

#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

Mesh ball() { return extract_surface(synthetic::sample_field(synthetic::sphere(0.1), 0.01)); }

/// The vertex farthest along a direction.
size_t farthest(const Mesh& mesh, const Eigen::Vector3f& direction) {
  size_t best = 0;
  for (size_t v = 1; v < mesh.positions.size(); ++v)
    if (mesh.positions[v].dot(direction) > mesh.positions[best].dot(direction)) best = v;
  return best;
}

TEST(SelfIntersection, FindsAnEdgeThroughATriangle) {
  Mesh mesh;
  mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0.2F, 0.2F, -1}, {0.2F, 0.2F, 1}, {0.2F, 0.25F, -1}};
  mesh.triangles = {{0, 1, 2}, {3, 4, 5}};
  const auto found = find_self_intersections(mesh);
  ASSERT_EQ(found.size(), 2U);
  EXPECT_EQ(found[0].edge, (std::array<uint32_t, 2>{3, 4}));
  EXPECT_EQ(found[1].edge, (std::array<uint32_t, 2>{4, 5}));
  EXPECT_EQ(found[0].triangle, 0U);
  EXPECT_EQ(found[1].triangle, 0U);
  mesh.positions[4].z() = -0.5F;  // ends before it
  EXPECT_TRUE(find_self_intersections(mesh).empty());
  mesh.positions[4].z() = 0;  // touches
  EXPECT_TRUE(find_self_intersections(mesh).empty());
}

TEST(SelfIntersection, FindsBallsThatPierceEachOther) {
  Mesh mesh = ball();
  EXPECT_TRUE(find_self_intersections(mesh).empty());
  const auto first = static_cast<uint32_t>(mesh.positions.size());
  const Mesh other = mesh;
  for (const Eigen::Vector3f& p : other.positions) mesh.positions.emplace_back(p + Eigen::Vector3f(0.0513F, 0.031F, 0));
  for (const auto& [a, b, c] : other.triangles) mesh.triangles.push_back({a + first, b + first, c + first});
  EXPECT_GT(find_self_intersections(mesh).size(), 50U);
}

TEST(SelfIntersection, UntanglesAndLeavesTheRest) {
  Mesh mesh = ball();
  const Mesh before = mesh;
  const size_t top = farthest(mesh, {0.1F, 1, 0.2F});
  mesh.positions[top] = mesh.positions[top] - Eigen::Vector3f(0.004F, 0.21F, 0.003F);  // out at the bottom
  ASSERT_FALSE(find_self_intersections(mesh).empty());
  EXPECT_EQ(remove_self_intersections(&mesh), 0U);
  EXPECT_TRUE(find_self_intersections(mesh).empty());
  EXPECT_EQ(mesh.triangles, before.triangles);
  const size_t side = farthest(mesh, {1, 0, 0});
  EXPECT_EQ(mesh.positions[side], before.positions[side]);
}

TEST(SelfIntersection, ChangesNothingWithoutNeed) {
  Mesh mesh = ball();
  const Mesh before = mesh;
  EXPECT_EQ(remove_self_intersections(&mesh), 0U);
  EXPECT_EQ(mesh.positions, before.positions);
}

}  // namespace
}  // namespace booth
