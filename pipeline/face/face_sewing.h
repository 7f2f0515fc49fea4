#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/face/face_patch.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/result.h"

namespace booth {

/// Triangles that span a closed polygon of vertices, without new ones: of all triangulations the one whose sharpest
/// fold, against its neighbours around the hole and within itself, is least, and of equals the one with the least area.
///
/// @param positions  metres
/// @param polygon    vertices in the direction in which the triangles are to use its edges; a vertex may come twice, as
///                   at the ends of a bridge between two loops
/// @param beyond     per edge polygon[i] → polygon[i + 1]: the normal of the triangle beyond it, zero where there is
/// none
/// @param taken      edges of the mesh that must not come again, each with its smaller vertex first, sorted
/// @return nothing where every triangulation takes such an edge
/// Cost: O(n³).
/// Source: P. Liepa, "Filling holes in meshes", Symposium on Geometry Processing 2003, section 3; G. Barequet,
/// M. Sharir, "Filling gaps in the boundary of a polyhedron", CAGD 12(2), 1995.
std::vector<std::array<uint32_t, 3>> span_polygon(std::span<const Eigen::Vector3f> positions,
                                                  std::span<const uint32_t> polygon,
                                                  std::span<const Eigen::Vector3f> beyond,
                                                  std::span<const std::array<uint32_t, 2>> taken);

/// A closed mesh with a patch sewn in.
struct SewnFace {
  Mesh mesh;
  std::vector<uint8_t> face;  ///< per vertex: 1 where it is the patch's
};

/// The paper's way to join a face: what of the hull lies before or behind the patch is cut out, the patch is bent to
/// the hull where its weight falls, so that both rims run alike, and the gap between them is spanned by triangles.
///
/// @param hull  closed, world frame
/// @error no_subject  the hull cannot be cut along one loop there, or the gap not be spanned so that the mesh is closed
/// Source: R. Pagés et al., automatic avatar booth, section 4.3.
Result<SewnFace> sew_face(const Mesh& hull, const FacePatch& patch);

}  // namespace booth
