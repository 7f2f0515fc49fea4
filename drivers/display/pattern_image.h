#pragma once

#include <cstdint>
#include <span>

#include "pipeline/types/shot.h"

namespace booth {

/// Draws pattern `index` of the sequence full-size: `white` or 0 for each pixel.
///
/// @param pattern  width × height, 1 or more each
/// @param index    0 … pattern_count(pattern) − 1
/// @param white    the pixel value of white
/// @param pixels   pattern.height rows of `stride` pixels, stride ≥ pattern.width; what lies beyond the width is kept
/// Source: F. Gray, "Pulse code communication", US patent 2632058, 1953 (the reflected binary code); the order is that
/// of GrayCodePattern.
void draw_pattern(const GrayCodePattern& pattern, int index, uint32_t white, std::span<uint32_t> pixels, size_t stride);

}  // namespace booth
