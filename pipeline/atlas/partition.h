#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/types/mesh.h"

namespace booth {

/// Divides the surface into connected regions, each nearly flat and compact: all normals of a region lie within 75°
/// of its mean normal, so that looking along it no triangle is turned over.
///
/// @param neighbours  of triangle_neighbours()
/// @param regions     about how many; curvature adds more
/// @return the triangles of each region, ascending; every triangle in exactly one
/// Source: D. Cohen-Steiner, P. Alliez, M. Desbrun, "Variational shape approximation", SIGGRAPH 2004; ours adds the
/// distance from the region's middle to the error, for compact regions, and the bound on the normals.
std::vector<std::vector<uint32_t>> partition_surface(const Mesh& mesh,
                                                     std::span<const std::array<int32_t, 3>> neighbours, int regions);

}  // namespace booth
