#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/atlas/unfolding.h"
#include "pipeline/types/mesh.h"

namespace booth {

/// A region laid flat, and what of it found no place.
struct Flattened {
  Chart chart;
  std::vector<uint32_t> rejected;  ///< triangles that would turn over, shrink to nothing or overlap others
};

/// Lays a region of the surface flat as one piece with as little change of shape as possible: projected along its
/// mean normal, then relaxed towards rigid triangles.
///
/// @param triangles  a connected region whose normals lie within 90° of their mean
/// @return corners in metres, with the area that the triangles have on the surface; no two of them overlap
/// Source: L. Liu et al., "A local/global approach to mesh parameterization", SGP 2008 (as rigid as possible).
Flattened flatten(const Mesh& mesh, std::span<const uint32_t> triangles);

}  // namespace booth
