#include "pipeline/surface/marching_cubes.h"

#include <gtest/gtest.h>

#include <numbers>
#include <random>

#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

/// A field of that many samples a side, all stored, from a function of the sample's place.
template <class Value>
Field make_field(int samples, double voxel_m, const Value& value) {
  Grid grid;
  grid.voxel_m = voxel_m;
  grid.size = {samples, samples, samples};
  Field field(grid);
  const auto [nx, ny, nz] = field.bricks();
  field.allocate_blocks(static_cast<size_t>(nx) * static_cast<size_t>(ny) * static_cast<size_t>(nz));
  constexpr int side = Field::brick_side;
  for (int z = 0; z < nz; ++z)
    for (int y = 0; y < ny; ++y)
      for (int x = 0; x < nx; ++x) {
        const size_t index = field.brick_index(x, y, z);
        field.set_brick(index, static_cast<int32_t>(index));
        float* sample = field.block(static_cast<int32_t>(index));
        for (int k = 0; k < side; ++k)
          for (int j = 0; j < side; ++j)
            for (int i = 0; i < side; ++i) *sample++ = value(x * side + i, y * side + j, z * side + k);
      }
  return field;
}

double smallest_area_m2(const Mesh& mesh) {
  double smallest = 1;
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3d ab = (mesh.positions[b] - mesh.positions[a]).cast<double>();
    const Eigen::Vector3d ac = (mesh.positions[c] - mesh.positions[a]).cast<double>();
    smallest = std::min(smallest, 0.5 * ab.cross(ac).norm());
  }
  return smallest;
}

TEST(MarchingCubes, SphereHasItsVolumeAndFacesOutwards) {
  const double radius_m = 0.2;
  const Mesh mesh = extract_surface(synthetic::sample_field(synthetic::sphere(radius_m), 0.01));
  const MeshTopology found = topology(mesh);
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 1U);
  EXPECT_EQ(found.euler_number, 2);
  EXPECT_EQ(found.unreferenced_vertices, 0U);
  const double volume = 4.0 / 3 * std::numbers::pi * radius_m * radius_m * radius_m;
  EXPECT_NEAR(found.signed_volume_m3, volume, 0.002 * volume);
  for (const Eigen::Vector3f& p : mesh.positions)
    EXPECT_NEAR((p.cast<double>() - Eigen::Vector3d(0, radius_m, 0)).norm(), radius_m, 0.0003);
}

TEST(MarchingCubes, AnyFieldGivesAClosedManifold) {
  std::mt19937 random(3);
  std::uniform_real_distribution<float> uniform(-1, 1);
  for (int round = 0; round < 20; ++round) {
    const float bias = 0.08F * static_cast<float>(round - 10);
    const Field field = make_field(21, 0.01, [&](int, int, int) { return uniform(random) + bias; });
    const Mesh mesh = extract_surface(field);
    ASSERT_TRUE(check(mesh).ok());
    const MeshTopology found = topology(mesh);
    EXPECT_TRUE(found.closed_manifold()) << "round " << round;
    EXPECT_EQ(found.unreferenced_vertices, 0U);
    EXPECT_GT(found.signed_volume_m3, 0);
    EXPECT_GT(smallest_area_m2(mesh), 1e-11);
  }
}

TEST(MarchingCubes, ExactZerosMakeNoDegenerateTriangles) {
  std::mt19937 random(4);
  std::uniform_int_distribution<int> three(-1, 1);
  const Field field = make_field(20, 0.01, [&](int, int, int) { return static_cast<float>(three(random)); });
  const Mesh mesh = extract_surface(field);
  EXPECT_TRUE(topology(mesh).closed_manifold());
  EXPECT_GT(smallest_area_m2(mesh), 1e-11);
}

TEST(MarchingCubes, NumbersThatAreNoneCountAsOutside) {
  const Field field =
      make_field(12, 0.01, [&](int i, int j, int k) { return (i + j + k) % 5 == 0 ? std::nanf("") : -1.0F; });
  const Mesh mesh = extract_surface(field);
  EXPECT_TRUE(check(mesh).ok());
  EXPECT_TRUE(topology(mesh).closed_manifold());
}

TEST(MarchingCubes, BricksThatAreNotStoredJoinWithoutAGap) {
  Grid grid;
  grid.voxel_m = 0.01;
  grid.size = {40, 40, 40};
  Field field(grid);
  field.set_brick(field.brick_index(1, 1, 1), Field::all_inside);
  field.set_brick(field.brick_index(2, 1, 1), Field::all_inside);
  field.set_brick(field.brick_index(0, 3, 3), Field::all_inside);
  const MeshTopology found = topology(extract_surface(field));
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 2U);
  EXPECT_EQ(found.euler_number, 4);
}

TEST(MarchingCubes, NothingInsideIsAnEmptyMesh) {
  const Mesh mesh = extract_surface(make_field(9, 0.01, [](int, int, int) { return 0.0F; }));
  EXPECT_TRUE(mesh.positions.empty());
  EXPECT_TRUE(mesh.triangles.empty());
  EXPECT_TRUE(extract_surface(Field()).triangles.empty());
}

TEST(MarchingCubes, ThreadsDoNotChangeTheResult) {
  const Field field = synthetic::sample_field(synthetic::person().body, 0.012);
  const Mesh serial = extract_surface(field);
  ThreadPool pool(8);
  const Mesh parallel = extract_surface(field, pool.work());
  EXPECT_EQ(serial.positions, parallel.positions);
  EXPECT_EQ(serial.triangles, parallel.triangles);
  EXPECT_TRUE(topology(serial).closed_manifold());
  EXPECT_EQ(topology(serial).components, 1U);
}

}  // namespace
}  // namespace booth
