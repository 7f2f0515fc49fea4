#pragma once

#include <cstdint>
#include <vector>

#include "pipeline/segmentation/background_model.h"

namespace booth::segmentation {

struct LabelingOptions {
  double darkest_shadow = 0.25;  ///< share of the light that the deepest soft shadow leaves
  double smoothness = 3;         ///< price of a boundary where the image shows none
  double smallest_part = 0.02;   ///< of the largest part's area; smaller parts are specks
};

/// 1 where a cell is mostly subject.
using CellMask = std::vector<uint8_t>;

struct Labeling {
  CellMask subject;
  size_t subject_cells = 0;
  double second_part = 0;    ///< the second largest connected part's share of the largest's area
  double faint_outline = 0;  ///< share of the outline along which the subject hardly differs from the background
  double contrast = 0;       ///< median evidence of the subject's cells, 0 (looks like background) … 1
};

/// Which cells are subject: the minimum of an energy whose data term asks how unlike a shadowed, drifted, noisy
/// background a cell is, and whose smoothness term makes a boundary cheap only where the body frame has an edge
/// that the background has not.
///
/// Source: J. Sun, W. Zhang, X. Tang, H.-Y. Shum, "Background Cut", ECCV 2006 (contrast attenuated by the
/// background's); shadows as a loss of lightness that keeps chromaticity and texture: T. Horprasert, D. Harwood,
/// L. S. Davis, "A statistical approach for real-time robust background subtraction and shadow detection", 1999.
/// @param body  the body frame's lightness
Labeling label_cells(const CellGrid& grid, const Residual& residual, const CellPlanes& body,
                     const LabelingOptions& options);

}  // namespace booth::segmentation
