#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/types/avatar.h"

namespace booth {

/// Vertices with one uv each, as renderers want them: a vertex of the mesh on a seam of the atlas occurs once for
/// every uv that it has. In the order in which the triangles use them.
struct SeamVertices {
  std::vector<uint32_t> mesh_vertex;               ///< which vertex of the mesh each one is a copy of
  std::vector<Eigen::Vector2f> uv;                 ///< as the atlas has it: v downwards
  std::vector<std::array<uint32_t, 3>> triangles;  ///< the mesh's triangles, by these vertices
};

/// O(vertices + corners × uvs at a vertex). @pre check(avatar) holds
SeamVertices split_at_seams(const Avatar& avatar);

/// The mesh's vertex_normals, with +Y where a vertex has no area around it, as formats demand unit length.
std::vector<Eigen::Vector3f> unit_normals(const Mesh& mesh);

}  // namespace booth
