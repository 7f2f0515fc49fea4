#pragma once

#include <array>
#include <cstdint>
#include <vector>

namespace booth::segmentation {

/// Steps to the eight neighbours of a raster's cell; that of 7 − k is opposite to that of k.
inline constexpr std::array<std::array<int, 2>, 8> neighbor_steps{
    {{-1, -1}, {0, -1}, {1, -1}, {-1, 0}, {1, 0}, {-1, 1}, {0, 1}, {1, 1}}};

/// Nodes in an 8-neighbourhood, each with a terminal preference.
struct CutGraph {
  struct Node {
    int32_t terminal = 0;                                             ///< > 0 prefers the source by that much
    std::array<int32_t, 8> neighbor{-1, -1, -1, -1, -1, -1, -1, -1};  ///< a node's number, or -1 for none
    std::array<int32_t, 8> capacity{};  ///< what cutting towards that neighbour costs, ≥ 0
  };
  std::vector<Node> nodes;
};

/// Which nodes stay with the source in a minimum cut: 1 for the source's side, 0 for the sink's. Of several
/// minimum cuts it is the one with the smallest source side.
///
/// Source: Y. Boykov, V. Kolmogorov, "An experimental comparison of min-cut/max-flow algorithms for energy
/// minimization in vision", IEEE PAMI 26(9), 2004. Integer capacities, so the same graph gives the same cut anywhere.
std::vector<uint8_t> minimum_cut(CutGraph graph);

}  // namespace booth::segmentation
