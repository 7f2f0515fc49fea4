#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>

#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/linear_light.h"

namespace booth {

/// Linear light at a pixel of level 0, interpolated bilinearly on one level of the pyramid.
inline Eigen::Array3f sample_level(const Pyramid& pyramid, size_t level, float x, float y) {
  const Image& image = pyramid[level];
  const float scale = 1 / static_cast<float>(1 << level);
  const float u = std::clamp((x + 0.5F) * scale - 0.5F, 0.0F, static_cast<float>(image.width - 1));
  const float v = std::clamp((y + 0.5F) * scale - 0.5F, 0.0F, static_cast<float>(image.height - 1));
  const int u0 = std::min(static_cast<int>(u), std::max(0, image.width - 2));
  const int v0 = std::min(static_cast<int>(v), std::max(0, image.height - 2));
  const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
  const uint8_t* a = image.pixel(u0, v0);
  const uint8_t* b = image.width > 1 ? a + 3 : a;
  const uint8_t* c = image.height > 1 ? a + 3 * image.width : a;
  const uint8_t* d = image.width > 1 ? c + 3 : c;
  Eigen::Array3f light;
  for (int k = 0; k < 3; ++k)
    light[k] = (1 - fv) * ((1 - fu) * linear_from_srgb(a[k]) + fu * linear_from_srgb(b[k])) +
               fv * ((1 - fu) * linear_from_srgb(c[k]) + fu * linear_from_srgb(d[k]));
  return light;
}

/// The same with a footprint of 2^lod pixels: between two levels, linearly.
inline Eigen::Array3f sample_pyramid(const Pyramid& pyramid, float lod, float x, float y) {
  const float level = std::clamp(lod, 0.0F, static_cast<float>(pyramid.size() - 1));
  const auto fine = static_cast<size_t>(level);
  const float rest = level - static_cast<float>(fine);
  constexpr float negligible = 0.05F;
  if (rest < negligible) return sample_level(pyramid, fine, x, y);
  return (1 - rest) * sample_level(pyramid, fine, x, y) + rest * sample_level(pyramid, fine + 1, x, y);
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
  const int u1 = std::min(u0 + 1, view.depth.width - 1), v1 = std::min(v0 + 1, view.depth.height - 1);
  const float surface_m = std::max(std::max(view.depth.at(u0, v0), view.depth.at(u1, v0)),
                                   std::max(view.depth.at(u0, v1), view.depth.at(u1, v1)));
  // Fully visible up to half the bias behind the depth map, hidden from one and a half of it.
  constexpr float bias_m = 0.012F;
  const float visible = std::clamp(1.5F - (depth_m - surface_m) / bias_m, 0.0F, 1.0F);
  if (visible <= 0) return {};
  const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
  const auto confidence = [&](int i, int j) { return static_cast<float>(view.confidence.at(i, j)); };
  const float sure = (1 - fv) * ((1 - fu) * confidence(u0, v0) + fu * confidence(u1, v0)) +
                     fv * ((1 - fu) * confidence(u0, v1) + fu * confidence(u1, v1));
  return {visible, sure / 255};
}

}  // namespace booth
