#include "pipeline/atlas/surface_diffusion.h"

#include <algorithm>

#include "pipeline/atlas/vertex_neighbours.h"

namespace booth {

void diffuse_colours(const Mesh& mesh, std::span<Eigen::Array3f> colours, std::span<const uint8_t> known) {
  const VertexNeighbours neighbours = neighbours_of(mesh);
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
      for (const uint32_t n : neighbours.of(v)) {
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
      for (const uint32_t n : neighbours.of(v)) mean += colours[n];
      colours[v] = mean / static_cast<float>(neighbours.of(v).size());
    }
    std::reverse(order.begin(), order.end());
  }
  constexpr float grey = 0.2F;
  const Eigen::Array3f mean = count > 0 ? Eigen::Array3f(sum / count) : Eigen::Array3f::Constant(grey);
  for (size_t v = 0; v < colours.size(); ++v)
    if (reached[v] == 0) colours[v] = mean;
}

}  // namespace booth
