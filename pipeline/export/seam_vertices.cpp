#include "pipeline/export/seam_vertices.h"

#include <limits>

namespace booth {

SeamVertices split_at_seams(const Avatar& avatar) {
  constexpr uint32_t none = std::numeric_limits<uint32_t>::max();
  SeamVertices split;
  split.triangles.resize(avatar.mesh.triangles.size());
  // The copies of a mesh vertex are a linked list, as most have a single one.
  std::vector<uint32_t> first_copy(avatar.mesh.positions.size(), none), next_copy;
  for (size_t t = 0; t < avatar.mesh.triangles.size(); ++t)
    for (size_t corner = 0; corner < 3; ++corner) {
      const uint32_t vertex = avatar.mesh.triangles[t][corner];
      const Eigen::Vector2f& uv = avatar.atlas.uv[t][corner];
      uint32_t copy = first_copy[vertex];
      while (copy != none && split.uv[copy] != uv) copy = next_copy[copy];
      if (copy == none) {
        copy = static_cast<uint32_t>(split.uv.size());
        split.mesh_vertex.push_back(vertex);
        split.uv.push_back(uv);
        next_copy.push_back(first_copy[vertex]);
        first_copy[vertex] = copy;
      }
      split.triangles[t][corner] = copy;
    }
  return split;
}

std::vector<Eigen::Vector3f> unit_normals(const Mesh& mesh) {
  std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
  for (Eigen::Vector3f& normal : normals)
    if (normal.isZero(0)) normal = Eigen::Vector3f::UnitY();
  return normals;
}

}  // namespace booth
