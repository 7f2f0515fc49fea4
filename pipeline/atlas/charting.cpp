#include "pipeline/atlas/charting.h"

#include <algorithm>
#include <utility>

#include "pipeline/atlas/flattening.h"
#include "pipeline/atlas/partition.h"

namespace booth {
namespace {

/// Charts of the given triangles alone.
std::vector<Chart> unfold_part(const Mesh& mesh, const std::vector<uint32_t>& triangles,
                               const UnfoldingOptions& options) {
  Mesh part;
  part.positions = mesh.positions;
  for (const uint32_t t : triangles) part.triangles.push_back(mesh.triangles[t]);
  std::vector<Chart> charts = unfold(part, {}, options);
  for (Chart& chart : charts)
    for (uint32_t& t : chart.triangles) t = triangles[t];
  return charts;
}

}  // namespace

std::vector<Chart> cut_into_charts(const Mesh& mesh, Charting charting, double clearance_m, const Work& work) {
  UnfoldingOptions unfolding;
  unfolding.clearance_m = clearance_m;
  if (charting == Charting::unfolding) return unfold(mesh, {}, unfolding);

  // Few and large, for short seams; curvature adds more. Not fewer triangles than make a disc.
  constexpr int most_regions = 50;
  constexpr size_t triangles_a_region = 24;
  const int regions = static_cast<int>(std::clamp<size_t>(mesh.triangles.size() / triangles_a_region, 1, most_regions));
  const auto neighbours = triangle_neighbours(mesh);
  const std::vector<std::vector<uint32_t>> parts = partition_surface(mesh, neighbours, regions);
  std::vector<Flattened> flattened(parts.size());
  work.parallel_for(parts.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) flattened[i] = flatten(mesh, parts[i]);
  });
  std::vector<Chart> charts;
  std::vector<uint32_t> rejected;
  for (Flattened& part : flattened) {
    rejected.insert(rejected.end(), part.rejected.begin(), part.rejected.end());
    if (!part.chart.triangles.empty()) charts.push_back(std::move(part.chart));
  }
  std::sort(rejected.begin(), rejected.end());
  for (Chart& chart : unfold_part(mesh, rejected, unfolding)) charts.push_back(std::move(chart));
  return charts;
}

}  // namespace booth
