#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// A triangle mesh in the world frame, metres, counter-clockwise seen from outside. Vertices are shared: a closed
/// mesh has every directed edge once and its opposite once.
struct Mesh {
  std::vector<Eigen::Vector3f> positions;
  std::vector<std::array<uint32_t, 3>> triangles;
};

/// Indices in range, positions finite, no triangle with a repeated vertex.
Result<void> check(const Mesh& mesh);

/// What a topology test finds. A closed, consistently oriented 2-manifold has zero in each of the first five.
struct MeshTopology {
  size_t boundary_edges = 0;         ///< edges with one triangle
  size_t nonmanifold_edges = 0;      ///< edges with more than two triangles
  size_t inconsistent_edges = 0;     ///< both triangles run the same way along it
  size_t nonmanifold_vertices = 0;   ///< vertices whose triangles form more than one fan
  size_t unreferenced_vertices = 0;  ///< vertices without a triangle
  size_t components = 0;
  long euler_number = 0;        ///< V − E + F
  double signed_volume_m3 = 0;  ///< positive when triangles face outwards

  bool closed_manifold() const {
    return boundary_edges == 0 && nonmanifold_edges == 0 && inconsistent_edges == 0 && nonmanifold_vertices == 0;
  }
};

/// Counts by sorting half-edges; O(F log F).
MeshTopology topology(const Mesh& mesh);

/// Area-weighted unit normals, one a vertex, pointing outwards. Zero where a vertex has no area around it.
std::vector<Eigen::Vector3f> vertex_normals(const Mesh& mesh);

}  // namespace booth
