#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/types/mesh.h"

namespace booth {

/// The neighbours of all vertices, one after another; one is listed once for each triangle that the two share.
struct VertexNeighbours {
  std::vector<uint32_t> first;  ///< into `list`; one more than there are vertices
  std::vector<uint32_t> list;

  std::span<const uint32_t> of(size_t v) const { return std::span(list).subspan(first[v], first[v + 1] - first[v]); }
};

VertexNeighbours neighbours_of(const Mesh& mesh);

}  // namespace booth
