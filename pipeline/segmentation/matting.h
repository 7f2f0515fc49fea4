#pragma once

#include "pipeline/segmentation/background_model.h"
#include "pipeline/segmentation/labeling.h"
#include "pipeline/types/image.h"

namespace booth::segmentation {

/// The share of every pixel that the subject covers, 0 … 255, from labels that are right to a cell or two.
///
/// In a band along the labels' boundary the pixel's colour I lies between the background's B, which is known from
/// the empty booth under the drift and shadow seen just outside, and the subject's F, seen just inside: coverage is
/// the projection of I − B on F − B. It is taken in linear light, where a lens and a sensor mix what a pixel covers;
/// in sRGB the outline of a dark subject before a bright wall would move outwards by a quarter of its blur.
/// Where F and B hardly differ the outline known before takes over; pixels of a colour that neither has, such as
/// highlights along the rim, are subject.
///
/// @param empty_booth  of the body's size and channels; `model` is made of it
Image matte(const Image& empty_booth, const Image& body, const BackgroundModel& model, const Residual& residual,
            const CellMask& subject);

}  // namespace booth::segmentation
