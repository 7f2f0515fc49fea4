#pragma once

#include <array>
#include <span>
#include <vector>

#include "pipeline/segmentation/cell_grid.h"
#include "pipeline/types/frame.h"

namespace booth::segmentation {

/// What a camera sees without a subject, cell by cell.
struct BackgroundModel {
  CellGrid grid;
  int frames = 0;              ///< how many it was learned from
  CellPlanes lightness;        ///< log(v + srgb_offset) of the mean over frames and cell
  CellPlanes level;            ///< that mean, 0 … 255
  std::vector<float> flicker;  ///< variance between the frames, mean over channels and 3 × 3 cells, level²;
                               ///< empty when learned from one frame
};

/// The mean and spread of the frames.
///
/// @param frames  at least one, all of one size and 1 or 3 channels
BackgroundModel learn_background(std::span<const Frame> frames);

/// A frame brought to the model's grid.
struct CellFrame {
  CellPlanes lightness, level;
};
CellFrame average_cells(const Image& image, const CellGrid& grid);

/// How the body frame differs from the background model.
struct Residual {
  CellPlanes difference;              ///< lightness of body − background, drift removed
  CellPlanes body;                    ///< lightness of the body frame
  CellPlanes variance;                ///< of `difference` where nothing but noise and vibration is at work
  CellPlanes drift;                   ///< what was removed: how much lighter the whole place became, per cell
  std::array<float, 3> mean_drift{};  ///< the drift's constant part, per channel
  double drift_support = 0;           ///< share of the image that agrees with the drift, 0 … 1
};

/// Finds the drift of gain, white balance and light between the two captures (it may vary slowly over the image)
/// from the cells that look like background under it, and the noise from how much those scatter.
Residual compare(const BackgroundModel& background, const CellFrame& body);

}  // namespace booth::segmentation
