#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/types/image.h"

namespace booth {

/// An animated WebP that repeats for ever.
///
/// @param frames   RGBA, all of one size, at least one
/// @param frame_s  how long each is shown, at least 0.01
/// @param quality  1 … 100, of the colours; transparency is kept exactly
/// @throws std::invalid_argument  when the frames are not as they should be
/// Source: Google, "WebP Container Specification", 2021.
std::vector<uint8_t> encode_webp_animation(std::span<const Image> frames, double frame_s, int quality);

}  // namespace booth
