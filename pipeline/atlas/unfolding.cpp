#include "pipeline/atlas/unfolding.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <queue>
#include <tuple>

#include "pipeline/atlas/planar_grid.h"

namespace booth {
namespace {

using Corners = FlatCorners;

double area_of(const Mesh& mesh, size_t t) {
  const auto& [a, b, c] = mesh.triangles[t];
  const Eigen::Vector3d origin = mesh.positions[a].cast<double>();
  return 0.5 * (mesh.positions[b].cast<double>() - origin).cross(mesh.positions[c].cast<double>() - origin).norm();
}

/// Where `apex` lies when the triangle (from, to, apex) is laid into the plane on the left of the edge a → b,
/// which is as long as from → to.
Eigen::Vector2d lay_out(const Eigen::Vector3d& from, const Eigen::Vector3d& to, const Eigen::Vector3d& apex,
                        const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  const Eigen::Vector3d edge = to - from;
  const double length = edge.norm(), flat_length = (b - a).norm();
  if (!(length > 0) || !(flat_length > 0)) return a + Eigen::Vector2d((apex - from).norm(), 0);
  const double along = (apex - from).dot(edge) / length, across = edge.cross(apex - from).norm() / length;
  const Eigen::Vector2d direction = (b - a) / flat_length;
  return a + along * direction + across * Eigen::Vector2d(-direction.y(), direction.x());
}

/// Grows charts one after another; each triangle goes to the first chart that has room for it.
class Unfolder {
 public:
  Unfolder(const Mesh& mesh, std::span<const uint8_t> group, const UnfoldingOptions& options)
      : mesh_(mesh),
        group_(group),
        clearance_m_(options.clearance_m),
        neighbours_(triangle_neighbours(mesh)),
        areas_(mesh.triangles.size()),
        normals_(mesh.triangles.size()),
        in_chart_(mesh.triangles.size(), false),
        grid_(1) {
    double total = 0;
    for (size_t t = 0; t < areas_.size(); ++t) {
      total += areas_[t] = area_of(mesh, t);
      const auto& [a, b, c] = mesh.triangles[t];
      normals_[t] = (mesh.positions[b] - mesh.positions[a])
                        .cast<double>()
                        .cross((mesh.positions[c] - mesh.positions[a]).cast<double>())
                        .normalized();
    }
    largest_area_ = options.largest_chart_share * total;
    const double mean_area = areas_.empty() ? 0 : total / static_cast<double>(areas_.size());
    grid_ = PlanarGrid(mean_area > 0 ? 1.5 * std::sqrt(2 * mean_area) : 1.0);
  }

  std::vector<Chart> run() {
    std::vector<Chart> charts;
    for (const uint32_t seed : seeds())
      if (!in_chart_[seed]) charts.push_back(grow(seed));
    return charts;
  }

 private:
  struct Candidate {
    double cost;
    uint32_t triangle;   ///< to be added
    uint32_t from_slot;  ///< the chart's triangle that it hangs on
    uint32_t edge;       ///< of that triangle
    bool operator>(const Candidate& o) const {
      return std::tie(cost, triangle, edge) > std::tie(o.cost, o.triangle, o.edge);
    }
  };

  /// Flat surroundings first: there a chart grows large before curvature stops it.
  std::vector<uint32_t> seeds() const {
    std::vector<double> bend(areas_.size(), 0);
    for (size_t t = 0; t < bend.size(); ++t)
      for (const int32_t n : neighbours_[t])
        bend[t] += n < 0 ? 1 : 1 - normals_[t].dot(normals_[static_cast<size_t>(n)]);
    std::vector<double> smooth(bend.size());
    constexpr int rounds = 8;
    for (int round = 0; round < rounds; ++round) {
      for (size_t t = 0; t < bend.size(); ++t) {
        smooth[t] = bend[t];
        for (const int32_t n : neighbours_[t]) smooth[t] += n < 0 ? bend[t] : bend[static_cast<size_t>(n)];
        smooth[t] /= 4;
      }
      bend.swap(smooth);
    }
    std::vector<uint32_t> order(bend.size());
    for (size_t t = 0; t < order.size(); ++t) order[t] = static_cast<uint32_t>(t);
    std::sort(order.begin(), order.end(),
              [&](uint32_t l, uint32_t r) { return std::tie(bend[l], l) < std::tie(bend[r], r); });
    return order;
  }

  Chart grow(uint32_t seed) {
    chart_ = {};
    chart_area_ = 0;
    grid_.clear();
    open_ = {};
    const auto p = [&](size_t k) { return mesh_.positions[mesh_.triangles[seed][k]].cast<double>(); };
    const Eigen::Vector2d a(0, 0), b((p(1) - p(0)).norm(), 0);
    const Eigen::Vector2d c = lay_out(p(0), p(1), p(2), a, b);
    center_ = (a + b + c) / 3;
    place(seed, {a, b, c});
    while (!open_.empty()) {
      const Candidate candidate = open_.top();
      open_.pop();
      if (in_chart_[candidate.triangle] || chart_area_ + areas_[candidate.triangle] > largest_area_) continue;
      const Corners corners = unfolded(candidate);
      if (has_room(candidate, corners)) place(candidate.triangle, corners);
    }
    return std::move(chart_);
  }

  /// The candidate's corners when it is turned about its shared edge into the chart's plane.
  Corners unfolded(const Candidate& candidate) const {
    const auto& triangle = mesh_.triangles[candidate.triangle];
    const auto& from = mesh_.triangles[chart_.triangles[candidate.from_slot]];
    const Corners& placed = chart_.corners[candidate.from_slot];
    const size_t start = candidate.edge, end = (candidate.edge + 1) % 3;
    // The neighbour runs along the shared edge the other way.
    size_t k = 0;
    while (triangle[k] != from[end] || triangle[(k + 1) % 3] != from[start]) ++k;
    Corners corners;
    corners[k] = placed[end];
    corners[(k + 1) % 3] = placed[start];
    const auto p = [&](size_t corner) { return mesh_.positions[triangle[corner % 3]].cast<double>(); };
    corners[(k + 2) % 3] =
        snapped(triangle[(k + 2) % 3], lay_out(p(k), p(k + 1), p(k + 2), placed[end], placed[start]));
    return corners;
  }

  /// In a flat region a vertex is reached by several ways that agree but for rounding; then they shall agree exactly.
  Eigen::Vector2d snapped(uint32_t vertex, const Eigen::Vector2d& position) const {
    constexpr double rounding_m = 1e-9;
    Eigen::Vector2d result = position;
    const Corners point{position, position, position};
    grid_.all_near(point, rounding_m, [&](int32_t slot) {
      const auto& other = mesh_.triangles[chart_.triangles[static_cast<size_t>(slot)]];
      for (size_t k = 0; k < 3; ++k) {
        const Eigen::Vector2d& q = chart_.corners[static_cast<size_t>(slot)][k];
        if (other[k] != vertex || (q - position).squaredNorm() > rounding_m * rounding_m) continue;
        result = q;
        return false;
      }
      return true;
    });
    return result;
  }

  bool has_room(const Candidate& candidate, const Corners& corners) const {
    const auto& triangle = mesh_.triangles[candidate.triangle];
    return grid_.all_near(corners, clearance_m_, [&](int32_t slot) {
      if (slot == static_cast<int32_t>(candidate.from_slot)) return true;
      const auto& other = mesh_.triangles[chart_.triangles[static_cast<size_t>(slot)]];
      const Corners& placed = chart_.corners[static_cast<size_t>(slot)];
      bool related = false, touching = false;
      for (size_t i = 0; i < 3; ++i)
        for (size_t j = 0; j < 3; ++j)
          if (triangle[i] == other[j]) {
            related = true;
            touching = touching || corners[i] == placed[j];
          }
      // Both sides of a slit may lie as close as they like, but must not round to the same place.
      constexpr double slit_m = 1e-7, touch_m = -1e-12;
      const double gap = std::max(separation(corners, placed), separation(placed, corners));
      return gap >= (touching ? touch_m : related ? slit_m : std::max(slit_m, clearance_m_));
    });
  }

  void place(uint32_t t, const Corners& corners) {
    in_chart_[t] = true;
    chart_area_ += areas_[t];
    const auto slot = static_cast<uint32_t>(chart_.triangles.size());
    chart_.triangles.push_back(t);
    chart_.corners.push_back(corners);
    grid_.add(static_cast<int32_t>(slot), corners);
    for (uint32_t k = 0; k < 3; ++k) {
      const int32_t n = neighbours_[t][k];
      if (n < 0 || in_chart_[static_cast<size_t>(n)]) continue;
      if (!group_.empty() && group_[static_cast<size_t>(n)] != group_[t]) continue;
      // A disc grows: compact charts pack well. Flat neighbours first, so that slits open where it bends anyway.
      const Eigen::Vector2d middle = 0.5 * (corners[k] + corners[(k + 1) % 3]);
      const double bend = 1 - normals_[t].dot(normals_[static_cast<size_t>(n)]);
      open_.push({(middle - center_).norm() * (1 + bend), static_cast<uint32_t>(n), slot, k});
    }
  }

  const Mesh& mesh_;
  std::span<const uint8_t> group_;
  double clearance_m_;
  double largest_area_ = 0;
  std::vector<std::array<int32_t, 3>> neighbours_;
  std::vector<double> areas_;
  std::vector<Eigen::Vector3d> normals_;
  std::vector<bool> in_chart_;
  Chart chart_;
  double chart_area_ = 0;
  Eigen::Vector2d center_ = Eigen::Vector2d::Zero();
  PlanarGrid grid_;
  std::priority_queue<Candidate, std::vector<Candidate>, std::greater<>> open_;
};

}  // namespace

std::vector<std::array<int32_t, 3>> triangle_neighbours(const Mesh& mesh) {
  struct Side {
    uint64_t edge;
    uint32_t triangle, corner;
    bool forward;
  };
  std::vector<Side> sides;
  sides.reserve(mesh.triangles.size() * 3);
  for (uint32_t t = 0; t < mesh.triangles.size(); ++t)
    for (uint32_t k = 0; k < 3; ++k) {
      const uint64_t from = mesh.triangles[t][k], to = mesh.triangles[t][(k + 1) % 3];
      sides.push_back({std::min(from, to) << 32 | std::max(from, to), t, k, from < to});
    }
  std::sort(sides.begin(), sides.end(), [](const Side& l, const Side& r) {
    return std::tie(l.edge, l.triangle, l.corner) < std::tie(r.edge, r.triangle, r.corner);
  });
  std::vector<std::array<int32_t, 3>> neighbours(mesh.triangles.size(), {-1, -1, -1});
  for (size_t begin = 0, end = 0; begin < sides.size(); begin = end) {
    while (end < sides.size() && sides[end].edge == sides[begin].edge) ++end;
    if (end - begin != 2 || sides[begin].forward == sides[begin + 1].forward) continue;
    const Side &one = sides[begin], &two = sides[begin + 1];
    neighbours[one.triangle][one.corner] = static_cast<int32_t>(two.triangle);
    neighbours[two.triangle][two.corner] = static_cast<int32_t>(one.triangle);
  }
  return neighbours;
}

std::vector<Chart> unfold(const Mesh& mesh, std::span<const uint8_t> group, const UnfoldingOptions& options) {
  return Unfolder(mesh, group, options).run();
}

}  // namespace booth
