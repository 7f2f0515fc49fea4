#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// The factor for each camera and channel of linear light that makes overlapping views of the same surface agree:
/// undoes differences of exposure, gain and white balance between cameras. The geometric mean over cameras is 1 per
/// channel, for what all cameras have in common cannot be told from the subject. A camera that shares nothing with
/// others keeps 1.
///
/// Method: robust least squares on the logarithms of blurred colours at the vertices, over all pairs of cameras
/// that see a vertex well (iteratively reweighted, Cauchy weights). A vertex counts by its area: a finely meshed,
/// glossy face must not decide the colours of a shirt.
///
/// @param mesh  world frame, metres; its vertices are those that the views hold projected and the ratings rate
std::vector<Eigen::Array3f> balance_colours(const Mesh& mesh, std::span<const PreparedView> views,
                                            const CameraRatings& ratings);

/// Multiplies every view's colours by its factors.
void apply_gains(std::span<PreparedView> views, std::span<const Eigen::Array3f> gains, const Work& work = {});

}  // namespace booth
