#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
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

/// Texels of one triangle, a few at a time, each quantity contiguous for the processor's vector units.
struct TexelBatch {
  static constexpr size_t capacity = 64;
  template <class T>
  using Each = std::array<T, capacity>;

  size_t count = 0;
  /// Where on the triangle the texels lie: the weights of its three corners, whose sum is 1. In the band around the
  /// triangle a weight may be below 0.
  std::array<Each<float>, 3> corner_weights;
  Each<Eigen::Array4f> light;  ///< the painter's answer: linear red, green and blue; the last is not used
};

/// Gives the texels of a batch, all of one triangle, their colours.
using TrianglePainter = std::function<void(TexelBatch& batch)>;

/// Colours every texel of every triangle, and a band of two texels around so that bilinear look-ups at its edges stay
/// on the surface.
///
/// @param painter_of  of a triangle; called from several threads, for one triangle perhaps more than once
TexelColours paint_texels(const Packing& packing, int size, const std::function<TrianglePainter(size_t)>& painter_of,
                          const Work& work = {});

}  // namespace booth
