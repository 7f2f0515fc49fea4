#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

#include "pipeline/atlas/input_preparation.h"

namespace booth {

namespace sampling {

/// Four numbers in one register: vectors of the compiler rather than Eigen's, for those cannot be converted from
/// integers at once.
using Floats = float __attribute__((vector_size(16)));

/// A pixel's red, green, blue and padding.
inline Floats pixel_at(const int16_t* p) {
  using Words = int16_t __attribute__((vector_size(8)));
  using Integers = int32_t __attribute__((vector_size(16)));
  Words words;
  std::memcpy(&words, p, sizeof words);
  return __builtin_convertvector(
      std::bit_cast<Integers>(__builtin_shufflevector(words, Words{}, 0, 4, 1, 5, 2, 6, 3, 7)), Floats);
}

/// Four samples of either sign.
inline Floats signed_pixel_at(const int16_t* p) {
  using Words = int16_t __attribute__((vector_size(8)));
  Words words;
  std::memcpy(&words, p, sizeof words);
  return __builtin_convertvector(words, Floats);
}

/// Weights of the four pixels around a place that is `f` behind the second, in whole numbers.
/// Source: R. Keys, "Cubic convolution interpolation for digital image processing", IEEE ASSP 29(6), 1981.
struct CubicWeights {
  static constexpr int one = 1 << 14;
  std::array<int16_t, 4> of{};

  constexpr CubicWeights() = default;
  constexpr explicit CubicWeights(double f) {
    const auto whole = [](double weight) { return static_cast<int16_t>(one * weight + (weight < 0 ? -0.5 : 0.5)); };
    const double f2 = f * f, f3 = f2 * f;
    of = {whole(f2 - 0.5 * (f + f3)), 0, whole(0.5 * f + 2 * f2 - 1.5 * f3), whole(0.5 * (f3 - f2))};
    of[1] = static_cast<int16_t>(one - of[0] - of[2] - of[3]);  // so that they sum to one exactly
  }
};

/// A place is told to a thousandth of a pixel, about.
constexpr int cubic_steps = 512;
inline constexpr auto cubic_weights = [] {
  std::array<CubicWeights, cubic_steps + 1> table;
  for (int i = 0; i <= cubic_steps; ++i)
    table[static_cast<size_t>(i)] = CubicWeights(static_cast<double>(i) / cubic_steps);
  return table;
}();

/// The weighted sum of four pixels side by side, times CubicWeights::one.
inline Floats weighted_row(const int16_t* pixels, const CubicWeights& weights) {
#ifdef __SSE2__
  const __m128i all = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(weights.of.data()));
  const auto pair = [](const int16_t* two, __m128i factors) {
    const __m128i both = _mm_loadu_si128(reinterpret_cast<const __m128i*>(two));
    return _mm_madd_epi16(_mm_unpacklo_epi16(both, _mm_unpackhi_epi64(both, both)), factors);
  };
  return _mm_cvtepi32_ps(
      _mm_add_epi32(pair(pixels, _mm_shuffle_epi32(all, 0x00)), pair(pixels + 8, _mm_shuffle_epi32(all, 0x55))));
#else
  Floats sum{};
  for (size_t c = 0; c < 4; ++c) {
    int32_t whole = 0;
    for (size_t i = 0; i < 4; ++i) whole += weights.of[i] * pixels[4 * i + c];
    sum[c] = static_cast<float>(whole);
  }
  return sum;
#endif
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
  const int16_t* a = image.pixel(u0, v0);
  const int16_t* b = image.width > 1 ? a + 4 : a;
  const ptrdiff_t down = image.height > 1 ? 4 * static_cast<ptrdiff_t>(image.width) : 0;
  return (1 - fv) * ((1 - fu) * pixel_at(a) + fu * pixel_at(b)) +
         fv * ((1 - fu) * pixel_at(a + down) + fu * pixel_at(b + down));
}

/// Light of sample_pyramid() on level 0 in the camera's units, by cubic convolution, which keeps the detail that
/// bilinear interpolation blurs. Next to the image's border it is bilinear.
inline Floats cubic(const LightPyramid& pyramid, float x, float y) {
  const LightImage& image = pyramid.front();
  if (!(x >= 1 && y >= 1 && x < static_cast<float>(image.width - 2) && y < static_cast<float>(image.height - 2)))
    return bilinear(pyramid, 0, x, y);
  const int u0 = static_cast<int>(x), v0 = static_cast<int>(y);
  const auto weights = [](float f) -> const CubicWeights& {
    return cubic_weights[static_cast<size_t>(static_cast<int>(f * cubic_steps + 0.5F))];
  };
  const CubicWeights &across = weights(x - static_cast<float>(u0)), &along = weights(y - static_cast<float>(v0));
  const int16_t* row = image.pixel(u0 - 1, v0 - 1);
  const size_t down = 4 * static_cast<size_t>(image.width);
  const Floats factors = signed_pixel_at(along.of.data());
  Floats light = factors[0] * weighted_row(row, across);
  for (size_t j = 1; j < 4; ++j) light += factors[j] * weighted_row(row + j * down, across);
  constexpr float scale = 1.0F / CubicWeights::one / CubicWeights::one;
  light *= scale;
  return light > 0 ? light : Floats{};
}

}  // namespace sampling

/// Linear light at a pixel of level 0, interpolated bilinearly on one level of the pyramid.
inline Eigen::Array3f sample_level(const LightPyramid& pyramid, size_t level, float x, float y) {
  const sampling::Floats light = sampling::bilinear(pyramid, level, x, y) / full_light;
  return {light[0], light[1], light[2]};
}

/// How the pixels of level 0 are interpolated: bilinearly, or by cubic convolution, which keeps all detail.
enum class Sharpness { usual, full };

/// Linear light under a footprint of 2^lod pixels: between two levels, linearly, so that nothing aliases where a texel
/// covers several pixels; by cubic convolution where it covers one or less. The last of four is not used.
/// Source: L. Williams, "Pyramidal parametrics", SIGGRAPH 1983.
inline Eigen::Array4f sample_pyramid(const LightPyramid& pyramid, float lod, float x, float y,
                                     Sharpness sharpness = Sharpness::full) {
  const float level = std::clamp(lod, 0.0F, static_cast<float>(pyramid.size() - 1));
  const auto fine = static_cast<size_t>(level);
  const float rest = level - static_cast<float>(fine);
  constexpr float negligible = 0.05F;
  sampling::Floats light = fine == 0 && sharpness == Sharpness::full ? sampling::cubic(pyramid, x, y)
                                                                     : sampling::bilinear(pyramid, fine, x, y);
  if (rest >= negligible) light = (1 - rest) * light + rest * sampling::bilinear(pyramid, fine + 1, x, y);
  light /= full_light;
  return {light[0], light[1], light[2], light[3]};
}

/// What is known about a surface point in a camera; both 0 … 1.
struct Trust {
  float visible = 0;     ///< 0 where the point lies behind another surface
  float confidence = 0;  ///< of PreparedView::confidence
};

/// Looks a surface point up by its pixel of level 0 and its depth. Without branches, so that the compiler can do it for
/// several points at once.
inline Trust look_up(const TrustCell* cells, int width, int height, float x, float y, float depth_m) {
  const float u = std::min(std::max(0.0F, 0.5F * x - 0.25F), static_cast<float>(width - 1));
  const float v = std::min(std::max(0.0F, 0.5F * y - 0.25F), static_cast<float>(height - 1));
  const int u0 = static_cast<int>(u), v0 = static_cast<int>(v);
  const TrustCell& cell = cells[v0 * width + u0];
  // Fully visible up to half the bias behind the surface, hidden from one and a half of it.
  constexpr float bias_m = 0.012F;
  const float visible = std::min(std::max(0.0F, 1.5F - (depth_m - cell.surface_m) / bias_m), 1.0F);
  const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
  const auto sure = [&](int corner) {
    return static_cast<float>(static_cast<int32_t>(cell.confidence >> (8 * corner) & 255));
  };
  const float above = (1 - fu) * sure(0) + fu * sure(1), below = (1 - fu) * sure(2) + fu * sure(3);
  return {visible, ((1 - fv) * above + fv * below) * (1.0F / 255)};
}

inline Trust look_up(const PreparedView& view, float x, float y, float depth_m) {
  return look_up(view.trust.samples.data(), view.trust.width, view.trust.height, x, y, depth_m);
}

}  // namespace booth
