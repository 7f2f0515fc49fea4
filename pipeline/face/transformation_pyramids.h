#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace booth {

/// Pyramids with one apex in the head's barycentre and a triple of control points as the base of each. They share their
/// sides and do not overlap; together they fill the directions in which the control points lie.
///
/// A point has coordinates (u, v, δ) in its pyramid: the line from the apex through the point meets the base at
/// P₀ + u (P₁ − P₀) + v (P₂ − P₀), and the point is δ times as far from the apex as that. With other control points and
/// another apex the same coordinates give the point's new place. On a side of a pyramid they depend on its two control
/// points alone, so that what is carried over has no gap between pyramids.
/// Source: R. Pagés et al., automatic avatar booth, section 4.3 (transformation pyramids).
class TransformationPyramids {
 public:
  struct Coordinates {
    uint32_t pyramid = 0;
    double u = 0, v = 0, delta = 0;
  };

  /// The bases are the Delaunay triangles of the control points' directions from the apex. Points whose direction is
  /// within a hundredth of a radian of an earlier one's (closed lips) are no corner of a base.
  ///
  /// @param apex      any frame, metres
  /// @param controls  the same frame; all within 85° of their mean direction from the apex, the others are no corners
  TransformationPyramids(const Eigen::Vector3d& apex, std::span<const Eigen::Vector3d> controls);

  /// Three indices into the control points a pyramid, counter-clockwise seen from outside.
  const std::vector<std::array<uint32_t, 3>>& bases() const { return bases_; }

  /// Where a point is; nothing for points in no pyramid, and for the apex.
  std::optional<Coordinates> locate(const Eigen::Vector3d& p) const;

  /// The point of those coordinates, with the control points and the apex at other places.
  /// @param controls  in the order of the constructor's
  Eigen::Vector3d evaluate(const Coordinates& at, const Eigen::Vector3d& apex,
                           std::span<const Eigen::Vector3d> controls) const;

 private:
  Eigen::Vector3d apex_;
  std::vector<Eigen::Vector3d> controls_;
  std::vector<std::array<uint32_t, 3>> bases_;
  std::vector<Eigen::Matrix3d> shares_of_;  ///< per pyramid: the corners' shares in a point, from the apex
};

}  // namespace booth
