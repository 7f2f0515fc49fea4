#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/work.h"

namespace booth {

/// A view's levels 1, 2 and 3 in grey values about as the eye sees them, 0 … 255, so that noise is alike in light and
/// shade; the cameras' differences corrected.
struct GreyLevels {
  static constexpr size_t finest = 1, count = 3;
  std::array<FloatImage, count> images;

  /// Of 1 … 3.
  const FloatImage& level(size_t k) const { return images[k - finest]; }
};

/// One a view. A pyramid that ends early goes on with its last level.
std::vector<GreyLevels> grey_levels(std::span<const PreparedView> views, const Work& work = {});

/// Where a pixel of level 0 lies in a level of the pyramid.
inline Eigen::Vector2f on_level(const Eigen::Vector2f& pixel, float scale) {
  return ((pixel.array() + 0.5F) * scale - 0.5F).matrix();
}

}  // namespace booth
