#pragma once

#include <vector>

namespace booth::segmentation {

/// Each value becomes the mean of its 3 × 3 neighbourhood; the border repeats.
void box_mean_3x3(std::vector<float>& values, int width, int height);

/// Convolution with a Gaussian of that standard deviation, cut off at 3 σ; beyond the border there is nothing, so
/// that a quotient of two blurred rasters is a weighted mean.
void gaussian_blur(std::vector<float>& values, int width, int height, float sigma);

}  // namespace booth::segmentation
