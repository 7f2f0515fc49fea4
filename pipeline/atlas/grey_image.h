#pragma once

#include <algorithm>
#include <cmath>

#include "pipeline/atlas/input_preparation.h"

namespace booth {

/// Grey values about as the eye sees them, 0 … 255, so that noise is alike in light and shade.
inline FloatImage grey_image(const LightImage& light) {
  FloatImage grey(light.width, light.height, 1);
  for (size_t i = 0; i < grey.samples.size(); ++i) {
    const int16_t* p = light.samples.data() + 4 * i;
    const float luma =
        0.25F * static_cast<float>(p[0]) + 0.5F * static_cast<float>(p[1]) + 0.25F * static_cast<float>(p[2]);
    grey.samples[i] = 255 * std::sqrt(luma / full_light);
  }
  return grey;
}

/// Where a pixel of level 0 lies in a level of the pyramid.
inline Eigen::Vector2f on_level(const Eigen::Vector2f& pixel, float scale) {
  return ((pixel.array() + 0.5F) * scale - 0.5F).matrix();
}

}  // namespace booth
