#pragma once

#include <cstdint>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/work.h"

namespace booth {

/// An image and its halves, quarters, …: pixel (i, j) of level k covers 2^k × 2^k pixels of level 0, so its centre
/// lies at ((i + 0.5) · 2^k − 0.5, …) there.
using Pyramid = std::vector<Image>;

/// Linear light, 0 … 32767: red, green, blue and one that is not used, so that a pixel fills a register.
using LightImage = Raster<int16_t>;
/// As Pyramid.
using LightPyramid = std::vector<LightImage>;

/// Fills the pixels that are not valid from those that are, smoothly and from ever farther away, and returns all
/// levels on the way; averages are taken in linear light.
///
/// @param image  sRGB of 3 channels, or light
/// @param valid  1 channel, the same size, not 0 where a pixel holds a colour; if it is 0 everywhere, all is grey
/// Source: S. J. Gortler et al., "The Lumigraph", SIGGRAPH 1996, section 4.2 (pull-push).
Pyramid push_pull(Image image, Image valid, const Work& work = {});
LightPyramid push_pull(LightImage image, Image valid, const Work& work = {});

}  // namespace booth
