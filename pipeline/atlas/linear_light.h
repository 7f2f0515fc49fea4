#pragma once

#include <array>
#include <cstdint>

namespace booth {

/// Linear light, 0 … 1, of every 8-bit sRGB value (IEC 61966-2-1).
extern const std::array<float, 256> linear_light_of_srgb;

inline float linear_from_srgb(uint8_t value) { return linear_light_of_srgb[value]; }

/// The nearest 8-bit sRGB value of linear light; clamped to 0 … 1.
uint8_t srgb_from_linear(float light);

}  // namespace booth
