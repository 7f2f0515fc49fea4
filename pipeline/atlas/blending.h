#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/packing.h"
#include "pipeline/types/image.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// How the colours of several cameras become one.
enum class Blending {
  /// The mean, weighted by the ratings interpolated between vertices. Pagés et al., CGF 2015, equation 1.
  rating_mean,
  /// Weights fall towards outlines and depth steps, vanish where a texel is hidden, and are sharpened so that the
  /// best view dominates and changes over to the next one smoothly.
  best_view
};

struct TexelColours {
  Image image;            ///< sRGB
  Image painted;          ///< 1 channel, 255 where a texel of `image` belongs to a triangle or the band around it
  double used_share = 0;  ///< of the texels whose centre lies in a triangle
};

/// Colours every texel of every triangle, and a band around so that bilinear look-ups at its edges stay on the
/// surface. Where no camera sees the surface, colours spread over it from where they are known. Both sides of a
/// chart's edge are computed from the same points of the surface, so seams do not show.
///
/// @param gains  one a view, factors on linear light
TexelColours blend_texels(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                          const CameraRatings& ratings, std::span<const Eigen::Array3f> gains, Blending blending,
                          const Work& work = {});

}  // namespace booth
