#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "pipeline/types/image.h"

namespace booth::segmentation {

/// The coarse raster that decisions are made on: a cell is step × step pixels, the last column and row may reach
/// beyond the image. Averaging a cell lowers noise and keeps the global optimisation affordable for large sensors.
struct CellGrid {
  int step = 1;    ///< pixels along a cell's edge
  int width = 0;   ///< cells
  int height = 0;  ///< cells

  size_t count() const { return static_cast<size_t>(width) * static_cast<size_t>(height); }
  size_t index(int x, int y) const {
    return static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x);
  }
  bool contains(int x, int y) const { return x >= 0 && y >= 0 && x < width && y < height; }
};

/// A grid of about `cells` cells over an image.
CellGrid make_grid(int image_width, int image_height);

/// One value a cell and channel, each channel on its own.
struct CellPlanes {
  int channels = 0;
  std::vector<float> values[3];
};

/// The lightness that image noise, drift and shadows are simple in: log(v + sRGB's offset) of an 8-bit sRGB value v.
/// sRGB is (v + offset) ∝ L^(1/2.4) but for its darkest shades, so that a shadow or a gain that multiplies linear
/// light by k adds log(k) / 2.4, whatever the surface's colour.
inline constexpr float srgb_offset = 0.055F * 255.0F;
inline constexpr float srgb_exponent = 2.4F;

}  // namespace booth::segmentation
