#include "pipeline/refine/handle_removal.h"

#include <gtest/gtest.h>

#include <cmath>

#include "pipeline/geometry/solid_parts.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

constexpr double voxel_m = 0.004;

long genus(const Field& field) {
  const MeshTopology shape = topology(extract_surface(field));
  EXPECT_TRUE(shape.closed_manifold());
  EXPECT_EQ(shape.components, 1U);
  return 1 - shape.euler_number / 2;
}

/// A closed polygon of capsules around the z axis.
synthetic::Body ring(double radius_m, double thickness_m) {
  constexpr int corners = 16;
  synthetic::Body body;
  const auto corner = [&](int n) {
    const double angle = 2 * 3.14159265358979 * n / corners;
    return Eigen::Vector3d(radius_m * std::cos(angle), radius_m * std::sin(angle), 0);
  };
  for (int n = 0; n < corners; ++n) body.push_back({corner(n), corner(n + 1), thickness_m, thickness_m});
  return body;
}

TEST(HandleRemoval, CutsARingThatIsThin) {
  Field field = synthetic::sample_field(ring(0.12, 0.010), voxel_m);
  ASSERT_EQ(genus(field), 1);
  const RemovedHandles removed = remove_small_handles(field, {});
  EXPECT_EQ(genus(field), 0);
  EXPECT_GT(removed.cut_samples, 0U);
  EXPECT_LT(removed.cut_samples, 60U);
  EXPECT_EQ(removed.filled_samples, 0U);
}

TEST(HandleRemoval, FillsAnOpeningThatIsNarrow) {
  Field field = synthetic::sample_field(ring(0.06, 0.052), voxel_m);
  ASSERT_EQ(genus(field), 1);
  const RemovedHandles removed = remove_small_handles(field, {});
  EXPECT_EQ(genus(field), 0);
  EXPECT_GT(removed.filled_samples, 0U);
  EXPECT_EQ(removed.cut_samples, 0U);
}

TEST(HandleRemoval, KeepsARingThatIsThickAndWide) {
  Field field = synthetic::sample_field(ring(0.12, 0.04), voxel_m);
  ASSERT_EQ(genus(field), 1);
  const RemovedHandles removed = remove_small_handles(field, {});
  EXPECT_EQ(genus(field), 1);
  EXPECT_EQ(removed.cut_samples + removed.filled_samples, 0U);
}

TEST(HandleRemoval, RemovesTheSmallOfManyRingsAtATime) {
  synthetic::Body body = ring(0.12, 0.04);
  for (const double height : {-0.05, 0.0, 0.05})
    for (const double direction : {-1.0, 1.0}) {
      // A small ring on the outside of the large one.
      const Eigen::Vector3d root(direction * 0.15, height, 0), way(direction * 0.05, 0, 0), up(0, 0.012, 0);
      body.push_back({root - up, root + way - up, 0.006, 0.006});
      body.push_back({root + up, root + way + up, 0.006, 0.006});
      body.push_back({root + way - up, root + way + up, 0.006, 0.006});
    }
  Field field = synthetic::sample_field(body, voxel_m);
  ASSERT_EQ(genus(field), 7);
  remove_small_handles(field, {});
  EXPECT_EQ(genus(field), 1);
}

TEST(HandleRemoval, LeavesAPersonWithoutRingsAlone) {
  Field field = synthetic::sample_field(synthetic::person().body, 0.006);
  ASSERT_EQ(genus(field), 0);
  const RemovedHandles removed = remove_small_handles(field, {});
  EXPECT_EQ(genus(field), 0);
  EXPECT_EQ(removed.cut_samples + removed.filled_samples, 0U);
}

TEST(HandleRemoval, TakesAnEmptyField) {
  Field field;
  EXPECT_EQ(remove_small_handles(field, {}).cut_samples, 0U);
}

}  // namespace
}  // namespace booth
