#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <limits>
#include <vector>

namespace booth {

/// Surface points in the world frame, metres, ordered on a grid of rows whose neighbours are neighbours on the surface
/// (one point a projector pixel, or a camera's). Where nothing was measured the point is NaN.
struct RangeScan {
  int width = 0;
  int height = 0;
  std::vector<Eigen::Vector3f> points;  ///< row by row
  std::vector<float> sigma_m;           ///< standard deviation of each point along its least certain direction

  RangeScan() = default;
  RangeScan(int width_, int height_)
      : width(width_),
        height(height_),
        points(static_cast<size_t>(width_) * static_cast<size_t>(height_),
               Eigen::Vector3f::Constant(std::numeric_limits<float>::quiet_NaN())),
        sigma_m(points.size(), std::numeric_limits<float>::infinity()) {}

  size_t index(int x, int y) const {
    return static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x);
  }
  bool measured(size_t i) const { return points[i].x() == points[i].x(); }
};

}  // namespace booth
