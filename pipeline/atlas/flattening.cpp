#include "pipeline/atlas/flattening.h"

#include <Eigen/Geometry>
#include <Eigen/SparseCholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <unordered_map>

#include "pipeline/atlas/planar_grid.h"

namespace booth {
namespace {

/// One triangle on its own in the plane, and how its edges pull: the cotangents of the angles opposite to them.
struct Rest {
  std::array<size_t, 3> vertex;           ///< local indices
  std::array<Eigen::Vector2d, 3> corner;  ///< metres
  std::array<double, 3> weight;           ///< of the edge from corner k to k + 1
};

double cross(const Eigen::Vector2d& a, const Eigen::Vector2d& b) { return a.x() * b.y() - a.y() * b.x(); }

Rest rest_of(const std::array<Eigen::Vector3d, 3>& p, const std::array<size_t, 3>& vertex) {
  Rest rest{vertex, {}, {}};
  const Eigen::Vector3d edge = p[1] - p[0], other = p[2] - p[0];
  const double length = std::max(edge.norm(), 1e-12);
  rest.corner = {Eigen::Vector2d(0, 0), Eigen::Vector2d(length, 0),
                 Eigen::Vector2d(other.dot(edge) / length, edge.cross(other).norm() / length)};
  // Bounded: nearly degenerate triangles would outweigh all others or push instead of pull.
  constexpr double weakest = 0.05, strongest = 20;
  for (size_t k = 0; k < 3; ++k) {
    const Eigen::Vector2d a = rest.corner[k] - rest.corner[(k + 2) % 3];
    const Eigen::Vector2d b = rest.corner[(k + 1) % 3] - rest.corner[(k + 2) % 3];
    rest.weight[k] = std::clamp(a.dot(b) / std::max(cross(a, b), 1e-15), weakest, strongest);
  }
  return rest;
}

/// The rotation that brings the triangle at rest closest to how it lies.
Eigen::Rotation2Dd closest_rotation(const Rest& rest, const Eigen::MatrixX2d& flat) {
  double along = 0, across = 0;
  for (size_t k = 0; k < 3; ++k) {
    const Eigen::Vector2d from = rest.corner[(k + 1) % 3] - rest.corner[k];
    const Eigen::Vector2d to = (flat.row(static_cast<Eigen::Index>(rest.vertex[(k + 1) % 3])) -
                                flat.row(static_cast<Eigen::Index>(rest.vertex[k])))
                                   .transpose();
    along += rest.weight[k] * from.dot(to);
    across += rest.weight[k] * cross(from, to);
  }
  return Eigen::Rotation2Dd(std::atan2(across, along));
}

/// Local/global iterations from a start without flips.
bool relax(std::span<const Rest> rests, Eigen::MatrixX2d& flat) {
  const Eigen::Index vertices = flat.rows();
  std::vector<Eigen::Triplet<double>> entries;
  for (const Rest& rest : rests)
    for (size_t k = 0; k < 3; ++k) {
      const auto i = static_cast<int>(rest.vertex[k]), j = static_cast<int>(rest.vertex[(k + 1) % 3]);
      entries.emplace_back(i, i, rest.weight[k]);
      entries.emplace_back(j, j, rest.weight[k]);
      entries.emplace_back(i, j, -rest.weight[k]);
      entries.emplace_back(j, i, -rest.weight[k]);
    }
  entries.emplace_back(0, 0, 1.0);  // holds the chart in place
  Eigen::SparseMatrix<double> laplacian(vertices, vertices);
  laplacian.setFromTriplets(entries.begin(), entries.end());
  const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> solver(laplacian);
  if (solver.info() != Eigen::Success) return false;
  constexpr int rounds = 10;
  for (int round = 0; round < rounds; ++round) {
    Eigen::MatrixX2d right = Eigen::MatrixX2d::Zero(vertices, 2);
    right.row(0) = flat.row(0);
    for (const Rest& rest : rests) {
      const Eigen::Matrix2d rotation = closest_rotation(rest, flat).toRotationMatrix();
      for (size_t k = 0; k < 3; ++k) {
        const Eigen::RowVector2d pull =
            rest.weight[k] * (rotation * (rest.corner[k] - rest.corner[(k + 1) % 3])).transpose();
        right.row(static_cast<Eigen::Index>(rest.vertex[k])) += pull;
        right.row(static_cast<Eigen::Index>(rest.vertex[(k + 1) % 3])) -= pull;
      }
    }
    flat = solver.solve(right);
  }
  return flat.allFinite();
}

constexpr double least_cell_m = 1e-6;

/// Whether a triangle of the region overlaps none that the chart holds already.
bool has_room(const Mesh& mesh, uint32_t t, const FlatCorners& corners, const Chart& chart, const PlanarGrid& grid) {
  return grid.all_near(corners, 0, [&](int32_t item) {
    const auto slot = static_cast<size_t>(item);
    const auto& triangle = mesh.triangles[t];
    const auto& other = mesh.triangles[chart.triangles[slot]];
    size_t shared = 0;
    for (const uint32_t v : triangle) shared += static_cast<size_t>(std::count(other.begin(), other.end(), v));
    // Neighbours over an edge lie on its two sides, for neither is turned over.
    if (shared >= 2) return true;
    constexpr double touch_m = -1e-9;
    return std::max(separation(corners, chart.corners[slot]), separation(chart.corners[slot], corners)) >= touch_m;
  });
}

}  // namespace

Flattened flatten(const Mesh& mesh, std::span<const uint32_t> triangles) {
  std::unordered_map<uint32_t, size_t> local;
  std::vector<Eigen::Vector3d> positions;
  std::vector<Rest> rests;
  Eigen::Vector3d normal = Eigen::Vector3d::Zero();
  for (const uint32_t t : triangles) {
    std::array<Eigen::Vector3d, 3> p;
    std::array<size_t, 3> vertex;
    for (size_t k = 0; k < 3; ++k) {
      const uint32_t v = mesh.triangles[t][k];
      p[k] = mesh.positions[v].cast<double>();
      vertex[k] = local.try_emplace(v, positions.size()).first->second;
      if (vertex[k] == positions.size()) positions.push_back(p[k]);
    }
    normal += (p[1] - p[0]).cross(p[2] - p[0]);
    rests.push_back(rest_of(p, vertex));
  }
  normal.normalize();
  const Eigen::Vector3d right = normal.unitOrthogonal(), up = normal.cross(right);
  Eigen::MatrixX2d flat(static_cast<Eigen::Index>(positions.size()), 2);
  for (size_t v = 0; v < positions.size(); ++v)
    flat.row(static_cast<Eigen::Index>(v)) << right.dot(positions[v]), up.dot(positions[v]);
  if (!relax(rests, flat)) return {{}, {triangles.begin(), triangles.end()}};

  Flattened result;
  Chart& chart = result.chart;
  double flat_area = 0, area = 0, extent = 0;
  for (size_t i = 0; i < rests.size(); ++i) extent += rests[i].corner[1].x();
  PlanarGrid grid(std::max(least_cell_m, 1.5 * extent / static_cast<double>(std::max<size_t>(1, rests.size()))));
  for (size_t i = 0; i < triangles.size(); ++i) {
    FlatCorners corners;
    for (size_t k = 0; k < 3; ++k) corners[k] = flat.row(static_cast<Eigen::Index>(rests[i].vertex[k])).transpose();
    const double here = 0.5 * cross(corners[1] - corners[0], corners[2] - corners[0]);
    const double there = 0.5 * cross(rests[i].corner[1], rests[i].corner[2]);
    constexpr double least_share = 0.1;  // of its area: less would show as a smear
    if (!(here >= least_share * there) || !has_room(mesh, triangles[i], corners, chart, grid)) {
      result.rejected.push_back(triangles[i]);
      continue;
    }
    grid.add(static_cast<int32_t>(chart.triangles.size()), corners);
    chart.triangles.push_back(triangles[i]);
    chart.corners.push_back(corners);
    flat_area += here;
    area += there;
  }
  if (flat_area > 0)
    for (FlatCorners& corners : chart.corners)
      for (Eigen::Vector2d& p : corners) p *= std::sqrt(area / flat_area);
  return result;
}

}  // namespace booth
