#pragma once

#include <span>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/occluder.h"
#include "pipeline/atlas/packing.h"
#include "pipeline/atlas/texel_painting.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// Each triangle from the one camera that rates it highest, as it is: the method that Pagés et al. compare with (their
/// figure 2). A triangle that no camera sees continues the colours around it.
TexelColours paint_best_views(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                              const CameraRatings& ratings, const Work& work = {});

/// Each texel the mean of the cameras that see it, weighted by their ratings interpolated between the triangle's
/// corners. A camera from which a ray meets the surface before the texel does not count for it; rays are cast where
/// the depth map leaves a doubt. Where nobody sees a texel, it continues the colours around it.
///
/// @param occluder  of the same mesh
/// Source: R. Pagés, D. Berjón, F. Morán, N. García, "Seamless, static multi-texturing of 3D meshes", Computer
/// Graphics Forum 34(1), 2015, equation 1.
TexelColours paint_rating_means(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                                const CameraRatings& ratings, const Occluder& occluder, const Work& work = {});

}  // namespace booth
