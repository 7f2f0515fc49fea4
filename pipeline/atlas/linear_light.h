#pragma once

#include <cstdint>

namespace booth {

/// Linear light, 0 … 1, of an 8-bit sRGB value (IEC 61966-2-1).
float linear_from_srgb(uint8_t value);

/// The nearest 8-bit sRGB value of linear light; clamped to 0 … 1.
uint8_t srgb_from_linear(float light);

}  // namespace booth
