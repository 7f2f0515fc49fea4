#include "pipeline/atlas/surface_diffusion.h"

#include <algorithm>

namespace booth {
namespace {

/// The neighbours of all vertices, one after another; `first` has one entry more than there are vertices.
struct VertexNeighbours {
  std::vector<uint32_t> first, list;
};

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

}  // namespace

void diffuse_colours(const Mesh& mesh, std::span<Eigen::Array3f> colours, std::span<const uint8_t> known) {
  const VertexNeighbours neighbours = neighbours_of(mesh);
  const auto around = [&](uint32_t v) {
    return std::span(neighbours.list).subspan(neighbours.first[v], neighbours.first[v + 1] - neighbours.first[v]);
  };
  // Layer by layer inwards from what is known: a good start, and the order in which the sweeps converge fast.
  std::vector<uint8_t> reached(known.begin(), known.end());
  std::vector<uint32_t> order;
  Eigen::Array3f sum = Eigen::Array3f::Zero();
  float count = 0;
  std::vector<uint32_t> front;
  for (uint32_t v = 0; v < mesh.positions.size(); ++v)
    if (known[v] != 0) {
      front.push_back(v);
      sum += colours[v];
      ++count;
    }
  while (!front.empty()) {
    std::vector<uint32_t> next;
    for (const uint32_t v : front)
      for (const uint32_t n : around(v)) {
        if (reached[n] != 0) continue;
        reached[n] = 1;
        next.push_back(n);
        colours[n] = colours[v];
      }
    order.insert(order.end(), next.begin(), next.end());
    front.swap(next);
  }
  constexpr int sweeps = 60;
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    for (const uint32_t v : order) {
      Eigen::Array3f mean = Eigen::Array3f::Zero();
      for (const uint32_t n : around(v)) mean += colours[n];
      colours[v] = mean / static_cast<float>(around(v).size());
    }
    std::reverse(order.begin(), order.end());
  }
  constexpr float grey = 0.2F;
  const Eigen::Array3f mean = count > 0 ? Eigen::Array3f(sum / count) : Eigen::Array3f::Constant(grey);
  for (size_t v = 0; v < colours.size(); ++v)
    if (reached[v] == 0) colours[v] = mean;
}

}  // namespace booth
