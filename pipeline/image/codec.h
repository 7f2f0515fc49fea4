#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/result.h"

namespace booth {

enum class ImageFormat { png, jpeg };

/// Which format the bytes are, by their signature, and how large the image in them says it is.
struct ImageHeader {
  ImageFormat format = ImageFormat::png;
  int width = 0;
  int height = 0;
  int channels = 0;  ///< as decode_image will return: 1, 3 or 4
};

/// Reads the header only. @error invalid_file  neither a PNG nor a JPEG, or damaged
Result<ImageHeader> read_image_header(std::span<const uint8_t> bytes);

/// Decodes a PNG (8 or 16 bits a sample, brought to 8; palettes expanded) or a JPEG to grey (1 channel), RGB (3)
/// or, from a PNG with transparency, RGBA (4).
///
/// @error invalid_file  neither PNG nor JPEG, damaged, truncated (also a JPEG that a lenient decoder would fill
///                      with grey), or more than 100 million pixels
Result<Image> decode_image(std::span<const uint8_t> bytes);

/// @param image    1, 3 or 4 channels, not empty
/// @param level    libdeflate's, 0 … 12: larger makes smaller files, slower
/// Source: W3C, "Portable Network Graphics (PNG) Specification (Second Edition)", 2003.
std::vector<uint8_t> encode_png(const Image& image, int level = 6);

/// @param image    1 or 3 channels, not empty
/// @param quality  1 … 100; colour is not subsampled from 90 on
std::vector<uint8_t> encode_jpeg(const Image& image, int quality = 92);

}  // namespace booth
