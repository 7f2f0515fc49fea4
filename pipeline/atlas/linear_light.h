#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

namespace booth {

/// Linear light, 0 … 1, of every 8-bit sRGB value (IEC 61966-2-1).
extern const std::array<float, 256> linear_light_of_srgb;

inline float linear_from_srgb(uint8_t value) { return linear_light_of_srgb[value]; }

/// The nearest 8-bit sRGB value of even steps of linear light. In such steps the darkest values lie 1/3300 apart: this
/// many tell them apart with room to spare.
constexpr size_t linear_light_steps = size_t{1} << 14;
extern const std::array<uint8_t, linear_light_steps + 1> srgb_of_linear_light;

/// The nearest 8-bit sRGB value of linear light; clamped to 0 … 1.
inline uint8_t srgb_from_linear(float light) {
  return srgb_of_linear_light[static_cast<size_t>(
      static_cast<int>(std::clamp(light, 0.0F, 1.0F) * static_cast<float>(linear_light_steps) + 0.5F))];
}

}  // namespace booth
