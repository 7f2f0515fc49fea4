#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "pipeline/atlas/input_preparation.h"

namespace booth {

namespace sampling {

/// Four numbers in one register: vectors of the compiler rather than Eigen's, for those cannot be converted from
/// integers at once.
using Floats = float __attribute__((vector_size(16)));

/// A pixel's red, green, blue and padding.
inline Floats pixel_at(const uint16_t* p) {
  using Words = uint16_t __attribute__((vector_size(8)));
  using Integers = int32_t __attribute__((vector_size(16)));
  Words words;
  std::memcpy(&words, p, sizeof words);
  return __builtin_convertvector(
      std::bit_cast<Integers>(__builtin_shufflevector(words, Words{}, 0, 4, 1, 5, 2, 6, 3, 7)), Floats);
}

/// Of the four pixels around a place that is `f` behind the second.
inline Floats cubic_weights(float f) {
  constexpr Floats constant{0, 1, 0, 0}, linear{-0.5F, 0, 0.5F, 0}, square{1, -2.5F, 2, -0.5F},
      cube{-0.5F, 1.5F, -1.5F, 0.5F};
  return constant + f * (linear + f * (square + f * cube));
}

/// Light of sample_level() in the camera's units.
inline Floats bilinear(const LightPyramid& pyramid, size_t level, float x, float y) {
  const LightImage& image = pyramid[level];
  const float scale = 1 / static_cast<float>(1 << level);
  const float u = std::clamp((x + 0.5F) * scale - 0.5F, 0.0F, static_cast<float>(image.width - 1));
  const float v = std::clamp((y + 0.5F) * scale - 0.5F, 0.0F, static_cast<float>(image.height - 1));
  const int u0 = std::min(static_cast<int>(u), std::max(0, image.width - 2));
  const int v0 = std::min(static_cast<int>(v), std::max(0, image.height - 2));
  const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
  const uint16_t* a = image.pixel(u0, v0);
  const uint16_t* b = image.width > 1 ? a + 4 : a;
  const ptrdiff_t down = image.height > 1 ? 4 * static_cast<ptrdiff_t>(image.width) : 0;
  return (1 - fv) * ((1 - fu) * pixel_at(a) + fu * pixel_at(b)) +
         fv * ((1 - fu) * pixel_at(a + down) + fu * pixel_at(b + down));
}

/// Light of sample_pyramid() on level 0 in the camera's units, by cubic convolution, which keeps the detail that
/// bilinear interpolation blurs. Next to the image's border it is bilinear.
/// Source: R. Keys, "Cubic convolution interpolation for digital image processing", IEEE ASSP 29(6), 1981.
inline Floats cubic(const LightPyramid& pyramid, float x, float y) {
  const LightImage& image = pyramid.front();
  if (!(x >= 1 && y >= 1 && x < static_cast<float>(image.width - 2) && y < static_cast<float>(image.height - 2)))
    return bilinear(pyramid, 0, x, y);
  const int u0 = static_cast<int>(x), v0 = static_cast<int>(y);
  const Floats across = cubic_weights(x - static_cast<float>(u0)), along = cubic_weights(y - static_cast<float>(v0));
  const uint16_t* row = image.pixel(u0 - 1, v0 - 1);
  const ptrdiff_t down = 4 * static_cast<ptrdiff_t>(image.width);
  Floats light{};
  for (size_t j = 0; j < 4; ++j, row += down)
    light += along[j] * (across[0] * pixel_at(row) + across[1] * pixel_at(row + 4) + across[2] * pixel_at(row + 8) +
                         across[3] * pixel_at(row + 12));
  return light > 0 ? light : Floats{};
}

}  // namespace sampling

/// Linear light at a pixel of level 0, interpolated bilinearly on one level of the pyramid.
inline Eigen::Array3f sample_level(const LightPyramid& pyramid, size_t level, float x, float y) {
  const sampling::Floats light = sampling::bilinear(pyramid, level, x, y) / full_light;
  return {light[0], light[1], light[2]};
}

/// Linear light under a footprint of 2^lod pixels: between two levels, linearly, so that nothing aliases where a texel
/// covers several pixels; by cubic convolution where it covers one or less. The last of four is not used.
/// Source: L. Williams, "Pyramidal parametrics", SIGGRAPH 1983.
inline Eigen::Array4f sample_pyramid(const LightPyramid& pyramid, float lod, float x, float y) {
  const float level = std::clamp(lod, 0.0F, static_cast<float>(pyramid.size() - 1));
  const auto fine = static_cast<size_t>(level);
  const float rest = level - static_cast<float>(fine);
  constexpr float negligible = 0.05F;
  sampling::Floats light = fine == 0 ? sampling::cubic(pyramid, x, y) : sampling::bilinear(pyramid, fine, x, y);
  if (rest >= negligible) light = (1 - rest) * light + rest * sampling::bilinear(pyramid, fine + 1, x, y);
  light /= full_light;
  return Eigen::Map<const Eigen::Array4f, Eigen::Aligned16>(&light[0]);
}

/// What is known about a surface point in a camera; both 0 … 1.
struct Trust {
  float visible = 0;     ///< 0 where the point lies behind another surface
  float confidence = 0;  ///< of PreparedView::confidence
};

/// Looks a surface point up in the depth and confidence maps by its pixel of level 0 and its depth.
inline Trust look_up(const PreparedView& view, float x, float y, float depth_m) {
  const float u = std::clamp(0.5F * x - 0.25F, 0.0F, static_cast<float>(view.depth.width - 1));
  const float v = std::clamp(0.5F * y - 0.25F, 0.0F, static_cast<float>(view.depth.height - 1));
  const int u0 = std::min(static_cast<int>(u), std::max(0, view.depth.width - 2));
  const int v0 = std::min(static_cast<int>(v), std::max(0, view.depth.height - 2));
  const ptrdiff_t right = view.depth.width > 1 ? 1 : 0, down = view.depth.height > 1 ? view.depth.width : 0;
  const float* depth = view.depth.pixel(u0, v0);
  const float surface_m = std::max(std::max(depth[0], depth[right]), std::max(depth[down], depth[down + right]));
  // Fully visible up to half the bias behind the depth map, hidden from one and a half of it.
  constexpr float bias_m = 0.012F;
  const float visible = std::clamp(1.5F - (depth_m - surface_m) / bias_m, 0.0F, 1.0F);
  if (visible <= 0) return {};
  const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
  const uint8_t* sure = view.confidence.pixel(u0, v0);
  const auto between = [fu](uint8_t here, uint8_t beside) {
    return (1 - fu) * static_cast<float>(here) + fu * static_cast<float>(beside);
  };
  return {visible, ((1 - fv) * between(sure[0], sure[right]) + fv * between(sure[down], sure[down + right])) / 255};
}

}  // namespace booth
