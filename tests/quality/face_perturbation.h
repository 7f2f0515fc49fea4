#pragma once

#include <cstdint>

#include "pipeline/structured_light/structured_light.h"
#include "pipeline/types/rig.h"

namespace booth::quality {

// What goes wrong with the images of a face scan, done to a recording's.

/// Gaussian noise in every image. @param sigma  grey levels
GrayCodeCapture with_noise(const GrayCodeCapture& capture, double sigma, uint32_t seed);

/// Light that falls on the subject besides the projector's, in every image: `share` of what the projector adds to each
/// pixel, so that what the projector lights well is also lit well by the room.
GrayCodeCapture with_ambient_light(const GrayCodeCapture& capture, double share, uint32_t seed);

/// Without a share of the images, chosen at random among all cameras'.
GrayCodeCapture without_images(const GrayCodeCapture& capture, double share, uint32_t seed);

/// A share of the images shows the pattern before once more, in all cameras: the projector did not step.
GrayCodeCapture with_repeats(const GrayCodeCapture& capture, double share, uint32_t seed);

/// The subject sways during the sequence, evenly from 0 to `sway_m` (world frame). Images are made anew from the lit
/// and the unlit one and from where `scan` says that the projector lights each pixel; what was not measured moves with
/// its surroundings.
GrayCodeCapture with_sway(const GrayCodeCapture& capture, const Rig& rig, const RangeScan& scan,
                          const Eigen::Vector3d& sway_m, uint32_t seed);

}  // namespace booth::quality
