#include "pipeline/face/face_patch.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "pipeline/face/field_fusion.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

FittedHead head_as_it_is() {
  const auto neutral = parse_neutral_head(built_in_neutral_head());
  FittedHead head;
  head.mesh = neutral->mesh;
  head.face = neutral->face_front;
  head.bare.assign(head.face.begin(), head.face.end());
  return head;
}

TEST(FacePatch, FallsToNothingAtItsRim) {
  const FittedHead head = head_as_it_is();
  const FacePatch patch = face_patch(head);
  const MeshTopology found = topology(patch.mesh);
  EXPECT_EQ(found.components, 1U);
  EXPECT_EQ(found.euler_number, 1);
  EXPECT_EQ(found.boundary_edges, 108U);
  EXPECT_EQ(patch.weight.size(), patch.mesh.positions.size());
  EXPECT_EQ(std::count(patch.weight.begin(), patch.weight.end(), 0.0F), 108);
  EXPECT_GT(std::count(patch.weight.begin(), patch.weight.end(), 1.0F), 3000);
  EXPECT_LT(patch.core.mesh.triangles.size(), patch.mesh.triangles.size());
  EXPECT_GT(patch.core.mesh.triangles.size(), patch.mesh.triangles.size() / 2);
  EXPECT_GT(patch.eye.z(), 0.5F);
}

TEST(FacePatch, LeavesOutWhatIsCoveredButNotNoise) {
  FittedHead head = head_as_it_is();
  // A fringe over the left of the forehead, and a few doubtful vertices on the nose.
  int covered = 0, noisy = 0;
  for (size_t v = 0; v < head.mesh.positions.size(); ++v) {
    const Eigen::Vector3f& p = head.mesh.positions[v];
    if (head.face[v] != 0 && p.x() > 0.01F && p.y() > 0.05F) head.bare[v] = 0, ++covered;
    if (p.z() > 0.106F) head.bare[v] = 0, ++noisy;
  }
  ASSERT_GT(covered, 30);
  ASSERT_GT(noisy, 3);
  const FacePatch patch = face_patch(head);
  for (size_t v = 0; v < patch.mesh.positions.size(); ++v) {
    const Eigen::Vector3f& p = patch.mesh.positions[v];
    if (p.x() > 0.01F && p.y() > 0.05F) {
      EXPECT_EQ(patch.weight[v], 0);
    }
    if (p.z() > 0.106F) {
      EXPECT_EQ(patch.weight[v], 1);
    }
  }
}

/// A disk of that radius across the line z = height, with rings of vertices.
Mesh disk(double radius_m, double height_m) {
  Mesh mesh;
  constexpr int rings = 20, spokes = 48;
  constexpr double pi = 3.14159265358979;
  mesh.positions.emplace_back(0, radius_m, height_m);
  for (int r = 1; r <= rings; ++r)
    for (int s = 0; s < spokes; ++s) {
      const double angle = 2 * pi * s / spokes, far = radius_m * r / rings;
      mesh.positions.emplace_back(far * std::cos(angle), radius_m + far * std::sin(angle), height_m);
    }
  const auto at = [&](int r, int s) { return static_cast<uint32_t>(1 + (r - 1) * spokes + s % spokes); };
  for (int s = 0; s < spokes; ++s) {
    mesh.triangles.push_back({0, at(1, s), at(1, s + 1)});
    for (int r = 1; r < rings; ++r) {
      mesh.triangles.push_back({at(r, s), at(r + 1, s), at(r + 1, s + 1)});
      mesh.triangles.push_back({at(r, s), at(r + 1, s + 1), at(r, s + 1)});
    }
  }
  return mesh;
}

class BlendSurface : public testing::Test {
 protected:
  // A ball of 10 cm on the floor; a plane 8 mm below its foremost point, in a disk of 3 cm.
  const Field ball_ = synthetic::sample_field(synthetic::sphere(0.1), 0.004);
  const Mesh plane_ = disk(0.1, 0.092);
  const Eigen::Vector3f eye_{0, 0.1F, 1};

  std::vector<float> weights(float inner_m, float outer_m) const {
    std::vector<float> weight;
    for (const Eigen::Vector3f& p : plane_.positions)
      weight.push_back(std::clamp((outer_m - std::hypot(p.x(), p.y() - 0.1F)) / (outer_m - inner_m), 0.0F, 1.0F));
    return weight;
  }
};

TEST_F(BlendSurface, PutsTheSurfaceWhereItsWeightIsOne) {
  const Mesh mesh = extract_surface(blend_surface(ball_, plane_, weights(0.02F, 0.06F), eye_));
  EXPECT_TRUE(topology(mesh).closed_manifold());
  EXPECT_EQ(topology(mesh).components, 1U);
  int within = 0;
  for (const Eigen::Vector3f& p : mesh.positions) {
    if (p.z() < 0) continue;
    if (std::hypot(p.x(), p.y() - 0.1F) < 0.018F) {
      EXPECT_NEAR(p.z(), 0.092F, 0.0004F);
      ++within;
    }
    if (std::hypot(p.x(), p.y() - 0.1F) > 0.065F) {
      EXPECT_NEAR((p - Eigen::Vector3f(0, 0.1F, 0)).norm(), 0.1F, 0.0005F);
    }
  }
  EXPECT_GT(within, 40);
}

TEST_F(BlendSurface, ChangesNothingWithoutWeight) {
  const Field blended = blend_surface(ball_, plane_, std::vector<float>(plane_.positions.size(), 0), eye_);
  const auto size = ball_.grid().size;
  for (int k = 0; k < size[2]; ++k)
    for (int j = 0; j < size[1]; ++j)
      for (int i = 0; i < size[0]; ++i) ASSERT_EQ(blended.at(i, j, k), ball_.at(i, j, k));
}

TEST_F(BlendSurface, LeavesTheBackAlone) {
  const Mesh mesh = extract_surface(blend_surface(ball_, plane_, weights(0.02F, 0.06F), eye_));
  for (const Eigen::Vector3f& p : mesh.positions) {
    if (p.z() < 0) {
      EXPECT_NEAR((p - Eigen::Vector3f(0, 0.1F, 0)).norm(), 0.1F, 0.0005F);
    }
  }
}

}  // namespace
}  // namespace booth
