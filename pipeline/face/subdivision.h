#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/types/mesh.h"

namespace booth {

/// Where a new vertex on an edge goes: its middle, or by the modified butterfly scheme, which also bends.
enum class SubdivisionRule { midpoint, butterfly };

struct Subdivision {
  Mesh mesh;                     ///< the old vertices first, in place
  std::vector<uint8_t> refined;  ///< per triangle: 1 where it is a quarter of a marked one
};

/// Quarters the marked triangles. Their neighbours are cut in two or three along the new vertices, so that a closed
/// mesh stays closed; marked triangles keep no T-junction.
///
/// @param marked  per triangle of a manifold mesh, 0 or 1
/// Source: N. Dyn, D. Levin, J. Gregory, "A butterfly subdivision scheme for surface interpolation with tension
/// control", ACM ToG 9(2), 1990; at vertices with other than six neighbours D. Zorin, P. Schröder, W. Sweldens,
/// "Interpolating subdivision for meshes with arbitrary topology", SIGGRAPH 1996; closing the border: R. Bank et al.,
/// 1983 (red and green triangles).
Subdivision subdivide(const Mesh& mesh, std::span<const uint8_t> marked, SubdivisionRule rule);

}  // namespace booth
