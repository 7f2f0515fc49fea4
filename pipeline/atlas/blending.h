#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/packing.h"
#include "pipeline/atlas/texel_painting.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// How much each camera's picture of each vertex is worth: its rating as a share of the usual one, less near outlines
/// and depth steps, 0 where the vertex is hidden. Vertex by vertex, one a view.
std::vector<float> weigh_views(const Mesh& mesh, std::span<const PreparedView> views, const CameraRatings& ratings);

/// Colours every texel of every triangle in two bands. What is large is what all cameras that see a place make of it,
/// less those that a highlight makes brighter than the others; detail comes from the cameras by their weights. Where no
/// camera sees the surface, colours spread over it from where they are known. Both sides of a chart's edge are computed
/// from the same points of the surface.
///
/// @param weights  of weigh_views()
/// @param shifts   of align_views(); empty: none
/// Source: two bands, P. J. Burt, E. H. Adelson, "A multiresolution spline with application to image mosaics", ACM TOG
/// 2(4), 1983; here the low band lives on the surface's vertices.
TexelColours blend_texels(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                          const CameraRatings& ratings, std::span<const float> weights,
                          std::span<const Eigen::Vector2f> shifts, const Work& work = {});

}  // namespace booth
