#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// An edge that pierces a triangle with which it shares no vertex.
struct SelfIntersection {
  std::array<uint32_t, 2> edge;  ///< vertices
  uint32_t triangle;
};

/// All of a mesh's, in the order of the triangles. Parts that only touch, or overlap in one plane, do not count.
/// Cost: O(F log F) and the pairs of triangles whose heights overlap.
std::vector<SelfIntersection> find_self_intersections(const Mesh& mesh);

/// Smooths a mesh where it pierces itself, each time a little wider, until it does not. The triangles stay.
///
/// @return how many intersections are left: 0 but for shapes that a few rounds cannot untangle
/// Source: the umbrella operator, L. Kobbelt et al., "Interactive multi-resolution modeling on arbitrary meshes",
/// SIGGRAPH 1998.
size_t remove_self_intersections(Mesh* mesh, const Work& work = {});

}  // namespace booth
