#pragma once

#include <array>
#include <span>
#include <vector>

#include "pipeline/segmentation/cell_grid.h"
#include "pipeline/types/empty_view.h"
#include "pipeline/types/frame.h"

namespace booth::segmentation {

/// By how many whole pixels the body frame's picture of the booth has moved to the right and down.
struct PixelOffset {
  int x = 0, y = 0;
};

/// What a camera sees without a subject, cell by cell.
struct BackgroundModel {
  CellGrid grid;
  PixelOffset offset;
  CellPlanes lightness;        ///< log(v + srgb_offset) of the mean over the cell
  CellPlanes level;            ///< that mean, 0 … 255
  std::vector<float> flicker;  ///< variance between the frames, mean over channels and 3 × 3 cells, level²;
                               ///< empty when learned from one frame
};

/// The mean and spread of the frames.
///
/// @param frames  at least one, all of one size and 1 or 3 channels
EmptyView learn_view(std::span<const Frame> frames);

/// The cells of what was learned.
///
/// @param offset  how far the view is moved first; the border repeats
BackgroundModel model_background(const EmptyView& empty, const PixelOffset& offset = {});

/// A frame brought to the model's grid.
struct CellFrame {
  CellPlanes lightness, level;
};
CellFrame average_cells(const Image& image, const CellGrid& grid, const PixelOffset& offset = {});

/// How the body frame differs from the background model.
struct Residual {
  CellPlanes difference;               ///< lightness of body − background, drift and movement removed
  CellPlanes variance;                 ///< of `difference` where nothing but noise and vibration is at work
  std::array<float, 3> mean_drift{};   ///< what was removed: how much lighter the place became on average, per channel
  double drift_support = 0;            ///< share of the image that agrees with the drift, 0 … 1
  std::array<float, 2> movement_px{};  ///< of the body frame against the background frames, to the right and down
};

/// Finds the drift of gain, white balance and light between the two captures (it may vary slowly over the image)
/// from the cells that look like background under it, the noise from how much those scatter, and by how much the camera
/// was moved from the edges of the background.
Residual compare(const BackgroundModel& background, const CellFrame& body);

}  // namespace booth::segmentation
