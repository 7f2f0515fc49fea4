#include "pipeline/surface/decimation.h"

#include <gtest/gtest.h>

#include <random>
#include <stop_token>

#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

Mesh person_mesh(double voxel_m) { return extract_surface(synthetic::sample_field(synthetic::person().body, voxel_m)); }

double smallest_area_m2(const Mesh& mesh) {
  double smallest = 1;
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3d ab = (mesh.positions[b] - mesh.positions[a]).cast<double>();
    const Eigen::Vector3d ac = (mesh.positions[c] - mesh.positions[a]).cast<double>();
    smallest = std::min(smallest, 0.5 * ab.cross(ac).norm());
  }
  return smallest;
}

TEST(Decimation, ReachesTheBudgetAndStaysClosed) {
  const Mesh mesh = person_mesh(0.01);
  const MeshTopology before = topology(mesh);
  ASSERT_TRUE(before.closed_manifold());
  for (const size_t budget : {size_t{20000}, size_t{4000}, size_t{1001}, size_t{500}}) {
    const Mesh fewer = decimate(mesh, {.triangles = budget});
    EXPECT_LE(fewer.triangles.size(), budget);
    EXPECT_GE(fewer.triangles.size() + 2, budget);
    EXPECT_TRUE(check(fewer).ok());
    const MeshTopology after = topology(fewer);
    EXPECT_TRUE(after.closed_manifold()) << budget;
    EXPECT_EQ(after.unreferenced_vertices, 0U);
    EXPECT_EQ(after.euler_number, before.euler_number);
    EXPECT_EQ(after.components, before.components);
    EXPECT_NEAR(after.signed_volume_m3, before.signed_volume_m3, 0.015 * before.signed_volume_m3) << budget;
    EXPECT_GT(smallest_area_m2(fewer), 1e-10) << budget;
  }
}

TEST(Decimation, StopsInTheMidstOfThinning) {
  std::stop_source source;
  source.request_stop();
  const Mesh mesh = person_mesh(0.008);
  const Mesh left = decimate(mesh, {.triangles = 3000}, {.stop = source.get_token(), .progress = {}, .parallel = {}});
  EXPECT_TRUE(check(left).ok());
  EXPECT_TRUE(topology(left).closed_manifold());
}

TEST(Decimation, StaysCloseToTheTrueSurface) {
  const synthetic::Body body = synthetic::person().body;
  const Mesh fewer = decimate(person_mesh(0.01), {.triangles = 8000});
  double sum = 0, worst = 0, weight = 0;
  for (const auto& [a, b, c] : fewer.triangles) {
    const Eigen::Vector3d p = fewer.positions[a].cast<double>(), q = fewer.positions[b].cast<double>();
    const Eigen::Vector3d r = fewer.positions[c].cast<double>();
    const double area = (q - p).cross(r - p).norm();
    const double off = synthetic::signed_distance(body, (p + q + r) / 3);
    sum += area * off * off;
    weight += area;
    worst = std::max(worst, std::abs(off));
  }
  EXPECT_LT(std::sqrt(sum / weight), 0.0006);
  EXPECT_LT(worst, 0.01);
}

TEST(Decimation, AFlatSideNeedsFewTriangles) {
  // A cube of 10 × 10 squares a side loses nothing when only its corners stay.
  Field field = synthetic::sample_field(synthetic::sphere(0.1), 0.01);
  const Grid& grid = field.grid();
  constexpr int side = Field::brick_side;
  for (int bz = 0; bz < field.bricks()[2]; ++bz)
    for (int by = 0; by < field.bricks()[1]; ++by)
      for (int bx = 0; bx < field.bricks()[0]; ++bx) {
        float* sample = field.block(field.brick(field.brick_index(bx, by, bz)));
        for (int k = 0; k < side; ++k)
          for (int j = 0; j < side; ++j)
            for (int i = 0; i < side; ++i) {
              const Eigen::Vector3d p = grid.point(bx * side + i, by * side + j, bz * side + k);
              *sample++ = static_cast<float>((p - Eigen::Vector3d(0, 0.1, 0)).cwiseAbs().maxCoeff() - 0.083);
            }
      }
  const Mesh cube = extract_surface(field);
  const Mesh fewer = decimate(cube, {.triangles = 60});
  EXPECT_TRUE(topology(fewer).closed_manifold());
  EXPECT_NEAR(topology(fewer).signed_volume_m3, topology(cube).signed_volume_m3, 1e-6);
}

TEST(Decimation, DegenerateInput) {
  const Mesh tetrahedron{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}}};
  const Mesh kept = decimate(tetrahedron, {.triangles = 2});
  EXPECT_EQ(kept.triangles.size(), 4U);
  EXPECT_TRUE(topology(kept).closed_manifold());
  EXPECT_EQ(decimate(tetrahedron, {.triangles = 100}).triangles, tetrahedron.triangles);
  EXPECT_TRUE(decimate({}, {.triangles = 0}).triangles.empty());

  const Mesh ball = extract_surface(synthetic::sample_field(synthetic::sphere(0.05), 0.01));
  const Mesh least = decimate(ball, {.triangles = 0});
  EXPECT_GE(least.triangles.size(), 4U);
  EXPECT_TRUE(topology(least).closed_manifold());
  EXPECT_EQ(topology(least).euler_number, 2);
}

TEST(Decimation, NoiseStaysManifold) {
  std::mt19937 random(6);
  std::uniform_real_distribution<float> uniform(-1, 1);
  Field field = synthetic::sample_field(synthetic::sphere(0.1), 0.01);
  for (size_t b = 0; b < field.blocks(); ++b)
    for (size_t s = 0; s < Field::samples_per_brick; ++s) field.block(static_cast<int32_t>(b))[s] = uniform(random);
  const Mesh mesh = extract_surface(field);
  const MeshTopology before = topology(mesh);
  ASSERT_TRUE(before.closed_manifold());
  for (const size_t share : {2, 5, 20}) {
    const Mesh fewer = decimate(mesh, {.triangles = mesh.triangles.size() / share});
    const MeshTopology after = topology(fewer);
    EXPECT_TRUE(check(fewer).ok());
    EXPECT_TRUE(after.closed_manifold()) << share;
    EXPECT_EQ(after.euler_number, before.euler_number);
    EXPECT_EQ(after.components, before.components);
  }
}

TEST(Decimation, WhatIsNotAManifoldKeepsItsOddPlaces) {
  // Two tetrahedra that share an edge, and an open ball: nothing may be lost at the shared edge or the hole's rim.
  Mesh pair{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {0, -1, 0}, {0, 0, -1}},
            {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}, {0, 4, 1}, {0, 1, 5}, {0, 5, 4}, {1, 4, 5}}};
  EXPECT_EQ(topology(decimate(pair, {.triangles = 4})).components, topology(pair).components);
  Mesh open = extract_surface(synthetic::sample_field(synthetic::sphere(0.1), 0.01));
  open.triangles.resize(open.triangles.size() / 2);
  const MeshTopology before = topology(open);
  const MeshTopology after = topology(decimate(open, {.triangles = open.triangles.size() / 4}));
  EXPECT_EQ(after.boundary_edges, before.boundary_edges);
  EXPECT_EQ(after.nonmanifold_edges, 0U);
}

TEST(Decimation, TheSameInputGivesTheSameBytes) {
  const Mesh mesh = person_mesh(0.008);  // large enough to be thinned in slabs
  ASSERT_GT(mesh.triangles.size(), 20000U);
  const Mesh alone = decimate(mesh, {.triangles = 3000});
  for (const unsigned threads : {2U, 8U}) {
    ThreadPool pool(threads);
    const Mesh together = decimate(mesh, {.triangles = 3000}, pool.work());
    EXPECT_EQ(together.positions, alone.positions) << threads;
    EXPECT_EQ(together.triangles, alone.triangles) << threads;
  }
}

}  // namespace
}  // namespace booth
