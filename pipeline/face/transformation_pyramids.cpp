#include "pipeline/face/transformation_pyramids.h"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>

namespace booth {
namespace {

using Triangle = std::array<uint32_t, 3>;

/// Positive when d lies in the circle through a, b and c, which run counter-clockwise.
double in_circle(const Eigen::Vector2d& a, const Eigen::Vector2d& b, const Eigen::Vector2d& c,
                 const Eigen::Vector2d& d) {
  Eigen::Matrix3d m;
  m << (a - d).transpose(), (a - d).squaredNorm(), (b - d).transpose(), (b - d).squaredNorm(), (c - d).transpose(),
      (c - d).squaredNorm();
  return m.determinant();
}

/// Delaunay triangles of points in a plane, counter-clockwise, by inserting one after the other.
/// Source: A. Bowyer, D. Watson, The Computer Journal 24(2), 1981.
std::vector<Triangle> triangulate(std::vector<Eigen::Vector2d> points) {
  const auto count = static_cast<uint32_t>(points.size());
  // Corners so far away that their circles are half-planes to the points.
  constexpr double far = 1e4;
  points.insert(points.end(), {{-far, -far}, {far, -far}, {0, far}});
  std::vector<Triangle> triangles{{count, count + 1, count + 2}};
  for (uint32_t p = 0; p < count; ++p) {
    std::vector<Triangle> kept;
    std::vector<std::array<uint32_t, 2>> edges;  // of the cavity that the point opens
    for (const Triangle& t : triangles) {
      if (in_circle(points[t[0]], points[t[1]], points[t[2]], points[p]) <= 0) {
        kept.push_back(t);
        continue;
      }
      for (size_t k = 0; k < 3; ++k) {
        const std::array<uint32_t, 2> edge{t[k], t[(k + 1) % 3]}, opposite{edge[1], edge[0]};
        const auto twin = std::find(edges.begin(), edges.end(), opposite);
        if (twin == edges.end())
          edges.push_back(edge);
        else
          edges.erase(twin);
      }
    }
    for (const auto& [a, b] : edges) kept.push_back({a, b, p});
    triangles = std::move(kept);
  }
  std::erase_if(triangles, [&](const Triangle& t) { return std::max({t[0], t[1], t[2]}) >= count; });
  return triangles;
}

}  // namespace

TransformationPyramids::TransformationPyramids(const Eigen::Vector3d& apex, std::span<const Eigen::Vector3d> controls)
    : apex_(apex), controls_(controls.begin(), controls.end()) {
  std::vector<Eigen::Vector3d> directions;
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& control : controls_) {
    directions.push_back((control - apex).normalized());
    mean += directions.back();
  }
  if (mean.isZero()) return;
  mean.normalize();
  const Eigen::Quaterniond turn = Eigen::Quaterniond::FromTwoVectors(mean, Eigen::Vector3d::UnitZ());

  // Stereographic projection keeps circles, so Delaunay triangles of the plane are those of the sphere.
  constexpr double least_cosine = 0.087, least_angle_rad = 0.01;
  std::vector<uint32_t> corners;
  std::vector<Eigen::Vector2d> plane;
  for (uint32_t c = 0; c < directions.size(); ++c) {
    if (directions[c].dot(mean) < least_cosine) continue;
    const auto close = [&](uint32_t other) { return (directions[other] - directions[c]).norm() < least_angle_rad; };
    if (std::any_of(corners.begin(), corners.end(), close)) continue;
    const Eigen::Vector3d d = turn * directions[c];
    corners.push_back(c);
    plane.emplace_back(d.head<2>() / (1 + d.z()));
  }
  for (const Triangle& t : triangulate(plane)) {
    const Triangle base{corners[t[0]], corners[t[1]], corners[t[2]]};
    Eigen::Matrix3d edges;
    for (int k = 0; k < 3; ++k) edges.col(k) = controls_[base[static_cast<size_t>(k)]] - apex;
    // Three points of the border in one plane with the apex make no pyramid.
    constexpr double least_solidity = 1e-4;
    if (edges.determinant() < least_solidity * edges.col(0).norm() * edges.col(1).norm() * edges.col(2).norm())
      continue;
    bases_.push_back(base);
    shares_of_.emplace_back(edges.inverse());
  }
}

std::optional<TransformationPyramids::Coordinates> TransformationPyramids::locate(const Eigen::Vector3d& p) const {
  // Of several pyramids at a side, the one that it is deepest in.
  std::optional<Coordinates> found;
  constexpr double rounding = 1e-9;
  double deepest = -rounding;
  for (uint32_t i = 0; i < bases_.size(); ++i) {
    const Eigen::Vector3d shares = shares_of_[i] * (p - apex_);
    const double delta = shares.sum();
    if (delta <= 0 || shares.minCoeff() / delta < deepest) continue;
    deepest = shares.minCoeff() / delta;
    found = Coordinates{i, shares.y() / delta, shares.z() / delta, delta};
  }
  return found;
}

Eigen::Vector3d TransformationPyramids::evaluate(const Coordinates& at, const Eigen::Vector3d& apex,
                                                 std::span<const Eigen::Vector3d> controls) const {
  const auto& [a, b, c] = bases_[at.pyramid];
  const Eigen::Vector3d foot = controls[a] + at.u * (controls[b] - controls[a]) + at.v * (controls[c] - controls[a]);
  return apex + at.delta * (foot - apex);
}

}  // namespace booth
