#include "pipeline/atlas/vertex_neighbours.h"

namespace booth {

VertexNeighbours neighbours_of(const Mesh& mesh) {
  VertexNeighbours neighbours;
  neighbours.first.assign(mesh.positions.size() + 1, 0);
  for (const auto& triangle : mesh.triangles)
    for (const uint32_t v : triangle) neighbours.first[v + 1] += 2;
  for (size_t v = 0; v < mesh.positions.size(); ++v) neighbours.first[v + 1] += neighbours.first[v];
  neighbours.list.resize(neighbours.first.back());
  std::vector<uint32_t> next(neighbours.first.begin(), neighbours.first.end() - 1);
  for (const auto& triangle : mesh.triangles)
    for (size_t k = 0; k < 3; ++k) {
      neighbours.list[next[triangle[k]]++] = triangle[(k + 1) % 3];
      neighbours.list[next[triangle[k]]++] = triangle[(k + 2) % 3];
    }
  return neighbours;
}

}  // namespace booth
