#pragma once

#include <cstdint>
#include <vector>

#include "pipeline/structured_light/structured_light.h"
#include "pipeline/types/rig.h"
#include "tests/synthetic/body.h"

namespace booth::synthetic {

/// Two cameras of 360 × 270 and a projector of 256 × 192 about 0.7 m before `target`, all with mild distortion; volume
/// as ring_rig's.
Rig scanner_rig(const Eigen::Vector3d& target);

/// How bright an image of the pattern is at a projector coordinate, 0 … 1: each projector pixel is a box, blurred by a
/// Gaussian of that standard deviation in projector pixels.
double brightness(const GrayCodePattern& pattern, int image, const Eigen::Vector2d& at, double blur_px);

struct GrayCodeScene {
  double ambient = 30;    ///< grey levels without the projector
  double contrast = 120;  ///< grey levels that the projector adds where it shines straight on
  double noise = 1;       ///< standard deviation, grey levels
  double blur_px = 0.6;   ///< of the projected stripes, projector pixels
  Eigen::Vector3d sway_m = Eigen::Vector3d::Zero();  ///< how far the body moves from the first to the last image
  uint32_t seed = 1;
};

/// The images that the rig's cameras take of a body on which its projector throws Gray codes, shadows included.
GrayCodeCapture render_gray_code(const Body& body, const Rig& rig, const GrayCodeScene& scene = {});

}  // namespace booth::synthetic
