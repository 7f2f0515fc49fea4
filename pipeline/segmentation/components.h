#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace booth::segmentation {

enum class Connectivity { four, eight };

/// The connected parts of a raster's cells that have a value in a given range, as runs along rows.
struct Components {
  struct Run {
    int row, begin, end;  ///< columns, end excluded
    int32_t part;
  };
  std::vector<Run> runs;      ///< in scan order
  std::vector<size_t> areas;  ///< cells, by part; parts are numbered in scan order of their first cells
};

/// @param values  row by row, width × height
Components connected_components(std::span<const uint8_t> values, int width, int height, uint8_t low, uint8_t high,
                                Connectivity connectivity);

}  // namespace booth::segmentation
