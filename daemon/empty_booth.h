#pragma once

#include <span>
#include <vector>

#include "pipeline/types/frame.h"

namespace booth {

/// What one camera sees, coarsely: the mean of each cell of a grid, relative to the whole picture's mean, so that
/// neither noise nor the light's strength matters.
struct CoarseView {
  int columns = 0, rows = 0;
  std::vector<float> cells;  ///< row by row; 1 is as bright as the picture's mean
};

/// @param frame  any size and colour, raw mosaics included
CoarseView coarse_view(const Frame& frame);

/// The share of cells, 0 … 1, that are not the same in all views; 0 for fewer than two. Views of another grid than the
/// first are left out.
double changed_share(std::span<const CoarseView> views);

}  // namespace booth
