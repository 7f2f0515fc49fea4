#pragma once

#include <Eigen/Core>
#include <functional>

#include "pipeline/atlas/packing.h"
#include "pipeline/types/image.h"
#include "pipeline/types/work.h"

namespace booth {

struct TexelColours {
  Image image;            ///< sRGB
  Image painted;          ///< 1 channel, 255 where a texel of `image` belongs to a triangle or the band around it
  double used_share = 0;  ///< of the texels whose centre lies in a triangle
};

/// Linear light at a point of a triangle, given by the weights of its corners (their sum is 1). In the band around the
/// triangle a weight may be below 0.
using TrianglePainter = std::function<Eigen::Array3f(const Eigen::Vector3f& corner_weights)>;

/// Colours every texel of every triangle, and a band of two texels around so that bilinear look-ups at its edges stay
/// on the surface.
///
/// @param painter_of  of a triangle; called from several threads, for one triangle perhaps more than once
TexelColours paint_texels(const Packing& packing, int size, const std::function<TrianglePainter(size_t)>& painter_of,
                          const Work& work = {});

}  // namespace booth
