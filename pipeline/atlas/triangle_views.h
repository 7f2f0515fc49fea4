#pragma once

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
  float lod = 0;         ///< log2 of the pixels under a texel's edge
  bool certain = false;  ///< all of the triangle and its surroundings is visible, far from any outline or depth step

  float rating_at(const Eigen::Vector3f& corner_weights) const { return interpolate(rating, corner_weights); }
  /// Pixel x, y and depth, perspectively correct.
  Eigen::Vector3f pixel_at(const Eigen::Vector3f& corner_weights) const {
    const float z = interpolate(depth, corner_weights);
    return {interpolate(x_depth, corner_weights) / z, interpolate(y_depth, corner_weights) / z, z};
  }
  static float interpolate(const std::array<float, 3>& corners, const Eigen::Vector3f& weights) {
    return weights[0] * corners[0] + weights[1] * corners[1] + weights[2] * corners[2];
  }
};

/// The cameras that see at least one corner of the triangle, best first where there are more than sixteen: the others
/// are left out, they add nothing.
///
/// @param usual  rating that counts as 1
std::vector<TriangleView> views_of_triangle(const Mesh& mesh, const Packing& packing, size_t triangle,
                                            std::span<const PreparedView> views, const CameraRatings& ratings,
                                            float usual);

constexpr size_t most_views_of_triangle = 16;

}  // namespace booth
