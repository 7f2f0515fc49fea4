#pragma once

#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/mesh.h"

namespace booth {

/// What makes overlapping views of the same surface agree, one a view: undoes differences of exposure, gain and white
/// balance between cameras, and their lenses' vignetting. The geometric mean of the gains over cameras is 1 per
/// channel, for what all cameras have in common cannot be told from the subject. A camera that shares nothing with
/// others keeps
/// 1. Vignetting shows only where cameras see the same place at different distances from their images' middles; as far
/// as they do not, it stays 0.
///
/// Method: robust least squares on the logarithms of blurred colours at the vertices, over all pairs of cameras
/// that see a vertex well (iteratively reweighted, Cauchy weights). A vertex counts by its area: a finely meshed,
/// glossy face must not decide the colours of a shirt.
///
/// @param mesh  world frame, metres; its vertices are those that the views hold projected and the ratings rate
/// Source: the model of gain and vignetting from overlaps, D. B. Goldman, J.-H. Chen, "Vignette and exposure
/// calibration and compensation", ICCV 2005; ours takes the first term of its even polynomial, in the logarithm.
std::vector<LightCorrection> balance_colours(const Mesh& mesh, std::span<const PreparedView> views,
                                             const CameraRatings& ratings);

}  // namespace booth
