#pragma once

#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"

namespace booth {

/// A small upright picture for people to look at.
///
/// @param image         grey or RGB, as the camera delivers it; not empty
/// @param rotation_deg  turning the image clockwise by it makes it upright: 0, 90, 180, 270
/// @param max_width     of the upright picture, at least 1; the image is never enlarged
/// @return each pixel the mean of those that it covers
Image make_preview(const Image& image, int rotation_deg, int max_width);

/// A raw frame's picture for people, at half its size: each 2 × 2 pixels become one, far quicker than developing them.
///
/// @param raw  1 channel, at least 2 × 2
/// @return RGB in sRGB
Image bin_mosaic(const Image& raw, const Mosaic& mosaic);

}  // namespace booth
