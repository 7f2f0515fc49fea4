#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace booth::segmentation {

enum class Connectivity { four, eight };

/// The connected parts of a raster's cells that have a given value.
struct Components {
  std::vector<int32_t> label;  ///< a cell's part, numbered in scan order from 0; -1 for cells of another value
  std::vector<size_t> areas;   ///< cells, by part
};

/// @param mask  row by row, width × height
Components connected_components(std::span<const uint8_t> mask, int width, int height, uint8_t value,
                                Connectivity connectivity);

}  // namespace booth::segmentation
