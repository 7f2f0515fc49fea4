#include "pipeline/atlas/unfolding.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <vector>

#include "pipeline/atlas/charting.h"
#include "pipeline/atlas/partition.h"
#include "pipeline/atlas/planar_grid.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

Mesh person_mesh() { return extract_surface(synthetic::sample_field(synthetic::person().body, 0.03)); }

/// Two triangles a side, outward.
Mesh cube() {
  Mesh mesh;
  for (int i = 0; i < 8; ++i)
    mesh.positions.emplace_back(static_cast<float>(i & 1), static_cast<float>(i >> 1 & 1), static_cast<float>(i >> 2));
  for (const auto& [a, b, c, d] : std::vector<std::array<uint32_t, 4>>{
           {0, 2, 3, 1}, {4, 5, 7, 6}, {0, 1, 5, 4}, {2, 6, 7, 3}, {0, 4, 6, 2}, {1, 3, 7, 5}}) {
    mesh.triangles.push_back({a, b, c});
    mesh.triangles.push_back({a, c, d});
  }
  return mesh;
}

double edge_length(const Mesh& mesh, uint32_t t, size_t k) {
  return static_cast<double>(
      (mesh.positions[mesh.triangles[t][(k + 1) % 3]] - mesh.positions[mesh.triangles[t][k]]).norm());
}

void expect_every_triangle_once(const std::vector<Chart>& charts, size_t triangles) {
  std::vector<int> times(triangles, 0);
  for (const Chart& chart : charts) {
    ASSERT_EQ(chart.triangles.size(), chart.corners.size());
    for (const uint32_t t : chart.triangles) ++times.at(t);
  }
  EXPECT_TRUE(std::all_of(times.begin(), times.end(), [](int n) { return n == 1; }));
}

/// Pairs of one chart's triangles whose insides meet by more than rounding.
size_t overlapping_pairs(const Chart& chart) {
  constexpr double rounding_m = 1e-8;
  PlanarGrid grid(0.05);
  size_t pairs = 0;
  for (size_t i = 0; i < chart.corners.size(); ++i) {
    std::vector<int32_t> met;
    grid.all_near(chart.corners[i], 0, [&](int32_t other) {
      const FlatCorners& placed = chart.corners[static_cast<size_t>(other)];
      if (std::max(separation(chart.corners[i], placed), separation(placed, chart.corners[i])) < -rounding_m)
        met.push_back(other);
      return true;
    });
    std::sort(met.begin(), met.end());
    pairs += static_cast<size_t>(std::unique(met.begin(), met.end()) - met.begin());
    grid.add(static_cast<int32_t>(i), chart.corners[i]);
  }
  return pairs;
}

TEST(Unfolding, EveryTriangleKeepsItsShape) {
  const Mesh mesh = person_mesh();
  const std::vector<Chart> charts = unfold(mesh, {}, {});
  expect_every_triangle_once(charts, mesh.triangles.size());
  for (const Chart& chart : charts)
    for (size_t i = 0; i < chart.triangles.size(); ++i)
      for (size_t k = 0; k < 3; ++k)
        EXPECT_NEAR((chart.corners[i][(k + 1) % 3] - chart.corners[i][k]).norm(),
                    edge_length(mesh, chart.triangles[i], k), 1e-7);
}

TEST(Unfolding, NothingOverlapsInAChart) {
  for (const Chart& chart : unfold(person_mesh(), {}, {.clearance_m = 0.002})) EXPECT_EQ(overlapping_pairs(chart), 0U);
}

TEST(Unfolding, TrianglesThatAreNotNeighboursKeepTheirClearance) {
  const Mesh mesh = person_mesh();
  constexpr double clearance_m = 0.004;
  for (const Chart& chart : unfold(mesh, {}, {.clearance_m = clearance_m})) {
    for (size_t i = 0; i < chart.triangles.size(); ++i)
      for (size_t j = 0; j < i; ++j) {
        const auto &one = mesh.triangles[chart.triangles[i]], &two = mesh.triangles[chart.triangles[j]];
        if (std::find_first_of(one.begin(), one.end(), two.begin(), two.end()) != one.end()) continue;
        // At least how far apart they are: along an edge's normal or between their bounding boxes.
        const FlatCorners &p = chart.corners[i], &q = chart.corners[j];
        const auto low = [](const FlatCorners& c) { return c[0].cwiseMin(c[1]).cwiseMin(c[2]).eval(); };
        const auto high = [](const FlatCorners& c) { return c[0].cwiseMax(c[1]).cwiseMax(c[2]).eval(); };
        const double gap = std::max(
            {separation(p, q), separation(q, p), (low(p) - high(q)).maxCoeff(), (low(q) - high(p)).maxCoeff()});
        ASSERT_GE(gap, clearance_m * 0.999);
      }
  }
}

TEST(Unfolding, ACubeBecomesOneNet) {
  const std::vector<Chart> charts = unfold(cube(), {}, {.largest_chart_share = 1});
  ASSERT_EQ(charts.size(), 1U);
  EXPECT_EQ(overlapping_pairs(charts[0]), 0U);
}

TEST(Unfolding, AChartNeverSpansTwoGroups) {
  const Mesh mesh = person_mesh();
  std::vector<uint8_t> group(mesh.triangles.size());
  for (size_t t = 0; t < group.size(); ++t) group[t] = mesh.positions[mesh.triangles[t][0]].y() > 1 ? 1 : 0;
  for (const Chart& chart : unfold(mesh, group, {}))
    for (const uint32_t t : chart.triangles) EXPECT_EQ(group[t], group[chart.triangles[0]]);
}

TEST(Unfolding, SurvivesDegenerateAndNonManifoldTriangles) {
  Mesh mesh = cube();
  mesh.positions.push_back(mesh.positions[0]);  // a triangle without area …
  mesh.triangles.push_back({0, 8, 1});
  mesh.triangles.push_back({0, 3, 2});  // … and a third one at an edge
  for (const Charting charting : {Charting::unfolding, Charting::flattening})
    expect_every_triangle_once(cut_into_charts(mesh, charting, 0.001), mesh.triangles.size());
}

TEST(TriangleNeighbours, AreMutualAndCompleteOnAClosedMesh) {
  const Mesh mesh = cube();
  const auto neighbours = triangle_neighbours(mesh);
  for (int32_t t = 0; t < static_cast<int32_t>(neighbours.size()); ++t)
    for (const int32_t n : neighbours[static_cast<size_t>(t)]) {
      ASSERT_GE(n, 0);
      const auto& back = neighbours[static_cast<size_t>(n)];
      EXPECT_EQ(std::count(back.begin(), back.end(), t), 1);
    }
}

TEST(Partition, RegionsAreConnectedAndNearlyFlat) {
  const Mesh mesh = person_mesh();
  const auto neighbours = triangle_neighbours(mesh);
  const auto regions = partition_surface(mesh, neighbours, 60);
  size_t triangles = 0;
  for (const auto& region : regions) {
    triangles += region.size();
    Eigen::Vector3f mean = Eigen::Vector3f::Zero();
    const auto normal = [&](uint32_t t) -> Eigen::Vector3f {
      const auto& [a, b, c] = mesh.triangles[t];
      return (mesh.positions[b] - mesh.positions[a]).cross(mesh.positions[c] - mesh.positions[a]);
    };
    for (const uint32_t t : region) mean += normal(t);
    for (const uint32_t t : region) EXPECT_GE(normal(t).dot(mean), -1e-9F);
  }
  EXPECT_EQ(triangles, mesh.triangles.size());
}

TEST(Flattening, ChangesLengthsLittleAndOverlapsNothing) {
  const Mesh mesh = person_mesh();
  const std::vector<Chart> charts = cut_into_charts(mesh, Charting::flattening, 0.002);
  expect_every_triangle_once(charts, mesh.triangles.size());
  double change = 0, length = 0;
  for (const Chart& chart : charts) {
    EXPECT_EQ(overlapping_pairs(chart), 0U);
    for (size_t i = 0; i < chart.triangles.size(); ++i)
      for (size_t k = 0; k < 3; ++k) {
        const double here = edge_length(mesh, chart.triangles[i], k);
        change += std::abs((chart.corners[i][(k + 1) % 3] - chart.corners[i][k]).norm() - here);
        length += here;
      }
  }
  EXPECT_LT(change / length, 0.03);
  EXPECT_LT(charts.size(), unfold(mesh, {}, {}).size());
}

}  // namespace
}  // namespace booth
