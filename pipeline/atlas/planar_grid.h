#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace booth {

/// A triangle in a chart's plane, counter-clockwise, metres.
using FlatCorners = std::array<Eigen::Vector2d, 3>;

/// The largest distance between the two triangles along the normal of any of the first one's edges; negative
/// when none of those separates them.
inline double separation(const FlatCorners& triangle, const FlatCorners& other) {
  double widest = -std::numeric_limits<double>::infinity();
  for (size_t k = 0; k < 3; ++k) {
    const Eigen::Vector2d& a = triangle[k];
    const Eigen::Vector2d edge = triangle[(k + 1) % 3] - a;
    const double length = edge.norm();
    if (!(length > 0)) continue;
    const Eigen::Vector2d outwards(edge.y() / length, -edge.x() / length);
    double nearest = std::numeric_limits<double>::infinity();
    for (const Eigen::Vector2d& p : other) nearest = std::min(nearest, outwards.dot(p - a));
    widest = std::max(widest, nearest);
  }
  return widest;
}

/// Triangles in the plane, found by the cells of a hashed grid that their bounding boxes touch.
class PlanarGrid {
 public:
  explicit PlanarGrid(double cell_m) : cell_m_(cell_m), first_(buckets, -1) {}

  void clear() {
    for (const size_t bucket : used_) first_[bucket] = -1;
    used_.clear();
    entries_.clear();
  }
  void add(int32_t item, const FlatCorners& corners) {
    for_each_bucket(corners, 0, [&](size_t bucket) {
      if (first_[bucket] < 0) used_.push_back(bucket);
      entries_.push_back({item, first_[bucket]});
      first_[bucket] = static_cast<int32_t>(entries_.size()) - 1;
      return true;
    });
  }
  /// Calls visit(item), perhaps repeatedly, for all that may lie within `margin_m` until it returns false.
  template <class Visitor>
  bool all_near(const FlatCorners& corners, double margin_m, const Visitor& visit) const {
    return for_each_bucket(corners, margin_m, [&](size_t bucket) {
      for (int32_t e = first_[bucket]; e >= 0; e = entries_[static_cast<size_t>(e)].next)
        if (!visit(entries_[static_cast<size_t>(e)].item)) return false;
      return true;
    });
  }

 private:
  struct Entry {
    int32_t item, next;
  };
  static constexpr size_t buckets = size_t{1} << 14;

  template <class Visitor>
  bool for_each_bucket(const FlatCorners& corners, double margin_m, const Visitor& visit) const {
    const Eigen::Array2d low = corners[0].cwiseMin(corners[1]).cwiseMin(corners[2]).array() - margin_m;
    const Eigen::Array2d high = corners[0].cwiseMax(corners[1]).cwiseMax(corners[2]).array() + margin_m;
    const auto cell = [&](double m) { return static_cast<int64_t>(std::floor(m / cell_m_)); };
    for (int64_t y = cell(low.y()); y <= cell(high.y()); ++y)
      for (int64_t x = cell(low.x()); x <= cell(high.x()); ++x) {
        const uint64_t mixed =
            static_cast<uint64_t>(x) * 0x9E3779B97F4A7C15U ^ static_cast<uint64_t>(y) * 0xC2B2AE3D27D4EB4FU;
        if (!visit(static_cast<size_t>(mixed >> 32) % buckets)) return false;
      }
    return true;
  }

  double cell_m_;
  std::vector<int32_t> first_;
  std::vector<size_t> used_;
  std::vector<Entry> entries_;
};

}  // namespace booth
