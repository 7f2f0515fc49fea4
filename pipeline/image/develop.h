#pragma once

#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"
#include "pipeline/types/result.h"

namespace booth {

/// Makes the colour image of a raw one: the two colours that each pixel lacks are interpolated from its 5 × 5
/// neighbourhood (mirrored at the edges), and linear samples are encoded as sRGB (IEC 61966-2-1).
///
/// @param raw  1 channel
/// @return 3 channels of the same size; deterministic, integer arithmetic but for the sRGB curve
/// @error invalid_argument  raw is not of one channel, is smaller than 4 × 4 or does not hold its samples
/// Source: H. S. Malvar, L. He, R. Cutler, "High-quality linear interpolation for demosaicing of Bayer-patterned color
/// images", IEEE ICASSP 2004.
Result<Image> develop(const Image& raw, const Mosaic& mosaic);

/// A frame that is raw, developed: without its mosaic and its encoded bytes. Others are returned as they are.
/// @error invalid_argument  as above; the message names the camera
Result<Frame> develop(const Frame& frame);

}  // namespace booth
