#pragma once

#include <Eigen/Core>
#include <array>
#include <span>
#include <vector>

#include "pipeline/atlas/unfolding.h"
#include "pipeline/types/work.h"

namespace booth {

/// Where the triangles of the charts lie in the atlas.
struct Packing {
  double texels_per_m = 0;  ///< of a chart of density 1
  /// By triangle of the mesh: its corners in texels from the atlas's outer top-left corner, x right, y down; the
  /// centre of texel (i, j) is (i + 0.5, j + 0.5).
  std::vector<std::array<Eigen::Vector2d, 3>> corners;
};

/// Places all charts in a square atlas without overlap and as large as they fit, each turned to its narrowest
/// bounding box and by quarter turns, never mirrored. Charts for which no gap is left are halved: that costs a little
/// seam and fills the atlas.
///
/// @param triangles      how many the mesh has; the charts hold each of them once
/// @param density        one value a chart: its scale relative to the others, > 0
/// @param size           width and height of the atlas, texels
/// @param gutter_texels  least distance between texels of two charts
/// Cost: a few attempts at different scales, each a bottom-left search in a bitmap, 64 places at a time.
Packing pack_charts(std::span<const Chart> charts, size_t triangles, std::span<const double> density, int size,
                    int gutter_texels, const Work& work = {});

}  // namespace booth
