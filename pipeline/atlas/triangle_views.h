#pragma once

#include <Eigen/Core>
#include <array>
#include <span>
#include <vector>

#include "pipeline/atlas/camera_ratings.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/atlas/packing.h"
#include "pipeline/types/mesh.h"

namespace booth {

/// A triangle as one camera sees it.
struct TriangleView {
  size_t view = 0;
  std::array<float, 3> rating{};  ///< at the corners, as a share of the usual one
  std::array<float, 3> depth{}, x_depth{}, y_depth{};
  std::array<float, 3> x_shift{}, y_shift{};  ///< of align_views()
  float lod = 0;                              ///< log2 of the pixels under a texel's edge
  bool certain = false;  ///< all of the triangle and its surroundings is visible, far from any outline or depth step

  /// Of each of the first `count` places, given by the weights of the corners: the rating, 0 where it would be below;
  /// pixel and depth, perspectively correct.
  template <size_t places>
  void for_each(const std::array<std::array<float, places>, 3>& corner_weights, size_t count,
                std::array<float, places>* rating_at, std::array<float, places>* x, std::array<float, places>* y,
                std::array<float, places>* z) const {
    const std::array<float, places>&a = corner_weights[0], &b = corner_weights[1], &c = corner_weights[2];
    const auto interpolated = [&](const std::array<float, 3>& corners, size_t i) {
      return a[i] * corners[0] + b[i] * corners[1] + c[i] * corners[2];
    };
    for (size_t i = 0; i < count; ++i) {
      const float rating_here = interpolated(rating, i);
      (*rating_at)[i] = rating_here > 0 ? rating_here : 0;
      (*z)[i] = interpolated(depth, i);
      (*x)[i] = interpolated(x_depth, i) / (*z)[i] + interpolated(x_shift, i);
      (*y)[i] = interpolated(y_depth, i) / (*z)[i] + interpolated(y_shift, i);
    }
  }
};

/// The cameras that see at least one corner of the triangle, best first where there are more than sixteen: the others
/// are left out, they add nothing.
///
/// @param usual   rating that counts as 1
/// @param shifts  of align_views(); empty: none
std::vector<TriangleView> views_of_triangle(const Mesh& mesh, const Packing& packing, size_t triangle,
                                            std::span<const PreparedView> views, const CameraRatings& ratings,
                                            float usual, std::span<const Eigen::Vector2f> shifts = {});

constexpr size_t most_views_of_triangle = 16;

}  // namespace booth
