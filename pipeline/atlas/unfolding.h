#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/types/mesh.h"

namespace booth {

/// A piece of the surface laid out flat. Every triangle keeps its exact shape and size, so the chart has no
/// distortion; it is cut where the surface is curved instead.
struct Chart {
  std::vector<uint32_t> triangles;                      ///< of the mesh, in the order in which they were added
  std::vector<std::array<Eigen::Vector2d, 3>> corners;  ///< metres, counter-clockwise, one entry a triangle
};

struct UnfoldingOptions {
  double clearance_m = 0;            ///< least gap between triangles of a chart that share no vertex of the mesh
  double largest_chart_share = 0.1;  ///< of the surface's area; bounds the size of a chart, so that charts pack well
};

/// The triangle on the other side of each edge (corner k to corner k + 1), or −1 where there is none or where
/// more than two triangles, or two of opposite orientation, meet.
std::vector<std::array<int32_t, 3>> triangle_neighbours(const Mesh& mesh);

/// Cuts the mesh into charts and lays them out: a chart grows from a seed by unfolding neighbouring triangles
/// rigidly into the plane, nearest to the seed first, as long as they do not overlap what already lies there.
///
/// @param group  one value a triangle: a chart never spans two groups. Empty: one group
/// @return every triangle in exactly one chart; within a chart no two triangles overlap
/// Cost: O(triangles) grid look-ups. Deterministic.
/// Source: Pagés et al., CGF 2015, section 3.1.
std::vector<Chart> unfold(const Mesh& mesh, std::span<const uint8_t> group, const UnfoldingOptions& options);

}  // namespace booth
