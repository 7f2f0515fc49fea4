#include "pipeline/face/face_sewing.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <random>

#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

constexpr double pi = 3.14159265358979;

/// A polygon and its triangles, whose reversed edges must close it: each edge of the polygon used once as it is, each
/// other edge once in both directions.
void expect_spans(const std::vector<std::array<uint32_t, 3>>& triangles, const std::vector<uint32_t>& polygon) {
  ASSERT_EQ(triangles.size(), polygon.size() - 2);
  std::vector<std::array<uint32_t, 2>> edges;
  for (const auto& t : triangles)
    for (size_t k = 0; k < 3; ++k) edges.push_back({t[k], t[(k + 1) % 3]});
  for (size_t i = 0; i < polygon.size(); ++i) edges.push_back({polygon[(i + 1) % polygon.size()], polygon[i]});
  std::sort(edges.begin(), edges.end());
  EXPECT_EQ(std::adjacent_find(edges.begin(), edges.end()), edges.end());
  for (const auto& [a, b] : edges) EXPECT_TRUE(std::binary_search(edges.begin(), edges.end(), std::array{b, a}));
}

TEST(SpanPolygon, FindsTheFlatTriangulationOfAStar) {
  // A plane star with five points: convex corners alone can be cut off.
  std::vector<Eigen::Vector3f> positions;
  std::vector<uint32_t> polygon;
  for (uint32_t i = 0; i < 10; ++i) {
    const double angle = pi * i / 5, far = i % 2 == 0 ? 1 : 0.4;
    positions.emplace_back(far * std::cos(angle), far * std::sin(angle), 0);
    polygon.push_back(i);
  }
  const std::vector<Eigen::Vector3f> beyond(10, Eigen::Vector3f::UnitZ());
  const auto triangles = span_polygon(positions, polygon, beyond, {});
  expect_spans(triangles, polygon);
  double area = 0;
  for (const auto& [a, b, c] : triangles) {
    const float signed_area = (positions[b] - positions[a]).cross(positions[c] - positions[a]).z() / 2;
    EXPECT_GT(signed_area, 0);
    area += static_cast<double>(signed_area);
  }
  EXPECT_NEAR(area, 10 * 0.5 * 0.4 * std::sin(pi / 5), 1e-6);
}

TEST(SpanPolygon, SpansRandomRims) {
  std::mt19937 random(4);
  std::uniform_real_distribution<double> noise(-0.3, 0.3);
  for (int trial = 0; trial < 30; ++trial) {
    std::vector<Eigen::Vector3f> positions;
    std::vector<uint32_t> polygon;
    const auto corners = static_cast<uint32_t>(5 + trial);
    for (uint32_t i = 0; i < corners; ++i) {
      const double angle = 2 * pi * i / corners, far = 1 + noise(random);
      positions.emplace_back(far * std::cos(angle), far * std::sin(angle), noise(random));
      polygon.push_back(i);
    }
    const std::vector<Eigen::Vector3f> beyond(corners, Eigen::Vector3f::Zero());
    expect_spans(span_polygon(positions, polygon, beyond, {}), polygon);
  }
}

TEST(SpanPolygon, TakesNoEdgeThatIsThereAlready) {
  const std::vector<Eigen::Vector3f> square{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};
  const std::vector<uint32_t> polygon{0, 1, 2, 3};
  const std::vector<Eigen::Vector3f> beyond(4, Eigen::Vector3f::UnitZ());
  for (const std::array<uint32_t, 2> diagonal : {std::array{0U, 2U}, std::array{1U, 3U}}) {
    const std::vector<std::array<uint32_t, 2>> taken{diagonal};
    const auto triangles = span_polygon(square, polygon, beyond, taken);
    expect_spans(triangles, polygon);
    for (const auto& t : triangles) {
      const auto has = [&](uint32_t v) { return std::find(t.begin(), t.end(), v) != t.end(); };
      EXPECT_FALSE(has(diagonal[0]) && has(diagonal[1]));
    }
  }
  EXPECT_TRUE(span_polygon(square, polygon, beyond, std::vector{std::array{0U, 2U}, std::array{1U, 3U}}).empty());
}

/// Whether the segment from p to q crosses the inside of a triangle, by signs of volumes.
bool pierces(const Eigen::Vector3d& p, const Eigen::Vector3d& q, const Eigen::Vector3d& a, const Eigen::Vector3d& b,
             const Eigen::Vector3d& c) {
  const auto volume = [](const Eigen::Vector3d& o, const Eigen::Vector3d& x, const Eigen::Vector3d& y,
                         const Eigen::Vector3d& z) { return (x - o).dot((y - o).cross(z - o)); };
  if (volume(p, a, b, c) * volume(q, a, b, c) >= 0) return false;
  const double u = volume(p, q, a, b), v = volume(p, q, b, c), w = volume(p, q, c, a);
  return (u > 0 && v > 0 && w > 0) || (u < 0 && v < 0 && w < 0);
}

size_t self_intersections(const Mesh& mesh, const Eigen::AlignedBox3f& within) {
  std::vector<std::array<uint32_t, 3>> near;
  for (const auto& t : mesh.triangles)
    if (within.contains(mesh.positions[t[0]])) near.push_back(t);
  // By their lowest x, so that only triangles whose extents overlap are compared.
  const auto low = [&](const auto& t) {
    return std::min({mesh.positions[t[0]].x(), mesh.positions[t[1]].x(), mesh.positions[t[2]].x()});
  };
  const auto high = [&](const auto& t) {
    return std::max({mesh.positions[t[0]].x(), mesh.positions[t[1]].x(), mesh.positions[t[2]].x()});
  };
  std::sort(near.begin(), near.end(), [&](const auto& a, const auto& b) { return low(a) < low(b); });
  size_t found = 0;
  const auto at = [&](uint32_t v) -> Eigen::Vector3d { return mesh.positions[v].cast<double>(); };
  for (size_t i = 0; i < near.size(); ++i)
    for (size_t k = i + 1; k < near.size() && low(near[k]) <= high(near[i]); ++k) {
      const auto &s = near[i], &t = near[k];
      if (std::any_of(s.begin(), s.end(), [&](uint32_t v) { return std::find(t.begin(), t.end(), v) != t.end(); }))
        continue;
      for (size_t e = 0; e < 3; ++e)
        found += pierces(at(s[e]), at(s[(e + 1) % 3]), at(t[0]), at(t[1]), at(t[2])) ||
                         pierces(at(t[e]), at(t[(e + 1) % 3]), at(s[0]), at(s[1]), at(s[2]))
                     ? 1
                     : 0;
    }
  return found;
}

/// A ball on the floor, 10 cm in radius, as the hull, and a patch of rings on a ball of another radius before it.
FacePatch cap(double radius_m, double half_angle_rad) {
  FacePatch patch;
  constexpr int rings = 16, spokes = 40;
  const Eigen::Vector3d middle(0, 0.1, 0);
  patch.mesh.positions.emplace_back(0, 0.1, radius_m);
  patch.weight.push_back(1);
  for (int r = 1; r <= rings; ++r)
    for (int s = 0; s < spokes; ++s) {
      const double tilt = half_angle_rad * r / rings, angle = 2 * pi * s / spokes;
      const Eigen::Vector3d way(std::sin(tilt) * std::cos(angle), std::sin(tilt) * std::sin(angle), std::cos(tilt));
      patch.mesh.positions.push_back((middle + radius_m * way).cast<float>());
      constexpr int fading = 5;
      patch.weight.push_back(std::min(1.0F, static_cast<float>(rings - r) / fading));
    }
  const auto at = [&](int r, int s) { return static_cast<uint32_t>(1 + (r - 1) * spokes + s % spokes); };
  for (int s = 0; s < spokes; ++s) {
    patch.mesh.triangles.push_back({0, at(1, s), at(1, s + 1)});
    for (int r = 1; r < rings; ++r) {
      patch.mesh.triangles.push_back({at(r, s), at(r + 1, s), at(r + 1, s + 1)});
      patch.mesh.triangles.push_back({at(r, s), at(r + 1, s + 1), at(r, s + 1)});
    }
  }
  patch.eye = {0, 0.1F, 1};
  return patch;
}

class SewFace : public testing::Test {
 protected:
  const Mesh ball_ = extract_surface(synthetic::sample_field(synthetic::sphere(0.1), 0.007));
};

TEST_F(SewFace, ClosesTheHullAroundThePatch) {
  for (const double radius_m : {0.095, 0.1, 0.104}) {
    const FacePatch patch = cap(radius_m, 0.7);
    const auto sewn = sew_face(ball_, patch);
    ASSERT_TRUE(sewn.ok()) << sewn.error().message;
    const MeshTopology found = topology(sewn->mesh);
    EXPECT_TRUE(found.closed_manifold());
    EXPECT_EQ(found.components, 1U);
    EXPECT_EQ(found.euler_number, 2);
    EXPECT_GT(found.signed_volume_m3, 0.003);
    const auto of_face = static_cast<size_t>(std::count(sewn->face.begin(), sewn->face.end(), 1));
    EXPECT_EQ(of_face, patch.mesh.positions.size());  // no new vertices, none lost
    EXPECT_EQ(self_intersections(sewn->mesh, Eigen::AlignedBox3f(Eigen::Vector3f(-1, -1, 0), Eigen::Vector3f(1, 1, 1))),
              0U);
    // Both rims run alike: no fold anywhere along the seam.
    for (const auto& [a, b, c] : sewn->mesh.triangles) {
      const auto& p = sewn->mesh.positions;
      const Eigen::Vector3f out = (p[a] + p[b] + p[c]) / 3 - Eigen::Vector3f(0, 0.1F, 0);
      EXPECT_GT((p[b] - p[a]).cross(p[c] - p[a]).normalized().dot(out.normalized()), 0.5F);
    }
  }
}

TEST_F(SewFace, RefusesWhatCannotBeSewn) {
  EXPECT_FALSE(sew_face(ball_, {}).ok());
  EXPECT_FALSE(sew_face({}, cap(0.1, 0.7)).ok());
  FacePatch torn = cap(0.1, 0.7);
  torn.mesh.triangles.erase(torn.mesh.triangles.begin(), torn.mesh.triangles.begin() + 4);  // a hole in the middle
  const auto refused = sew_face(ball_, torn);
  ASSERT_FALSE(refused.ok());
  EXPECT_EQ(refused.error().code, ErrorCode::no_subject);
}

}  // namespace
}  // namespace booth
