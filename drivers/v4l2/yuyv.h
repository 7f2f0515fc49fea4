#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "pipeline/types/image.h"

namespace booth {

/// How luma and colour differences were made of R, G and B.
struct YuvEncoding {
  bool bt709 = false;       ///< ITU-R BT.709's weights, else BT.601's
  bool full_range = false;  ///< 0 … 255, else 16 … 235 (luma) and 16 … 240 (colour differences)
};

/// @param bytes           height rows of `bytes_per_line`: Y0 U Y1 V for each two pixels
/// @param width           even
/// @return 3 channels, R, G, B; each colour difference holds for its two pixels
/// Source: Recommendations ITU-R BT.601-7 and BT.709-6.
Image rgb_from_yuyv(std::span<const uint8_t> bytes, size_t bytes_per_line, int width, int height, YuvEncoding encoding);

}  // namespace booth
