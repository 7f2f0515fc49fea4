#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/grey_image.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// By how many pixels (of level 0) each vertex must be looked up beside its projection in each view, so that the views
/// show the same there: a print that lies double where surface or calibration are off by some millimetres becomes one.
/// Vertex by vertex, one a view; at most a few pixels, zero where nothing can be told.
///
/// Method: around every vertex a patch of its tangent plane is drawn from each camera; each is moved towards the mean
/// of all (Lucas and Kanade's step, in the camera's own pixels), together with the patches around the neighbouring
/// vertices, and less where patches differ by more than a motion explains. Repeated.
///
/// @param weights  vertex by vertex, one a view: how much its picture of the vertex is worth, 0 = nothing
/// Source: B. D. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo vision",
/// IJCAI 1981; the application to textures, M. Eisemann et al., "Floating textures", Eurographics 2008.
std::vector<Eigen::Vector2f> align_views(const Mesh& mesh, std::span<const PreparedView> views,
                                         std::span<const GreyLevels> greys, const CameraRatings& ratings,
                                         std::span<const float> weights, const Work& work = {});

}  // namespace booth
