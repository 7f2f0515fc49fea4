#pragma once

#include <Eigen/Core>
#include <vector>

#include "pipeline/structured_light/pattern_images.h"

namespace booth {

/// How the image of the subject moves: for every bit, columns' first, where its images show what the finest column
/// bit's show at a pixel, relative to that pixel.
using Motion = std::vector<Eigen::Vector2d>;

/// The shift of the whole subject that explains best how the sums of pattern and inverse change.
///
/// @param tiles    what is looked for
/// @param subject  255 where the camera sees the subject, as large as its images; nullptr: anywhere
/// @return camera pixels; none where it cannot be measured
/// Source: B. Lucas, T. Kanade, "An iterative image registration technique", IJCAI 1981.
Motion measure_motion(const PatternImages& images, const SearchTiles& tiles, const Image* subject);

/// The longest way from where the first bit was shown, camera pixels.
double largest_of(const Motion& motion);

/// Moves all images so that the subject stands where it stood when the finest column bit was shown.
void hold_still(const Motion& motion, PatternImages* images);

}  // namespace booth
