#include "pipeline/types/mesh.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <numeric>
#include <string>

namespace booth {
namespace {

/// A triangle's side from `low` to `high` (vertex indices) or, when not forward, the other way round.
struct Side {
  uint32_t low, high;
  uint32_t triangle;
  bool forward;
  bool same_edge(const Side& other) const { return low == other.low && high == other.high; }
};

class DisjointSets {
 public:
  explicit DisjointSets(size_t count) : parent_(count) { std::iota(parent_.begin(), parent_.end(), size_t{0}); }
  size_t find(size_t i) {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }
  void join(size_t a, size_t b) { parent_[find(a)] = find(b); }

 private:
  std::vector<size_t> parent_;
};

}  // namespace

Result<void> check(const Mesh& mesh) {
  for (size_t v = 0; v < mesh.positions.size(); ++v)
    if (!mesh.positions[v].allFinite())
      return Error{ErrorCode::invalid_argument, "mesh: vertex " + std::to_string(v) + " is not finite"};
  for (size_t t = 0; t < mesh.triangles.size(); ++t) {
    const auto& [a, b, c] = mesh.triangles[t];
    if (std::max({a, b, c}) >= mesh.positions.size())
      return Error{ErrorCode::invalid_argument,
                   "mesh: triangle " + std::to_string(t) + " names a vertex that is not there"};
    if (a == b || b == c || c == a)
      return Error{ErrorCode::invalid_argument, "mesh: triangle " + std::to_string(t) + " repeats a vertex"};
  }
  return {};
}

MeshTopology topology(const Mesh& mesh) {
  MeshTopology found;
  std::vector<Side> sides;
  sides.reserve(mesh.triangles.size() * 3);
  // A fan at a vertex is a run of its triangles joined over shared edges, so corners are joined across edges.
  DisjointSets corners(mesh.triangles.size() * 3);
  DisjointSets bodies(mesh.triangles.size());
  const auto corner_of = [&](uint32_t triangle, uint32_t vertex) {
    const auto& t = mesh.triangles[triangle];
    return size_t{triangle} * 3 + static_cast<size_t>(std::find(t.begin(), t.end(), vertex) - t.begin());
  };
  for (uint32_t t = 0; t < mesh.triangles.size(); ++t) {
    for (size_t k = 0; k < 3; ++k) {
      const uint32_t from = mesh.triangles[t][k], to = mesh.triangles[t][(k + 1) % 3];
      sides.push_back({std::min(from, to), std::max(from, to), t, from < to});
    }
    const Eigen::Vector3d a = mesh.positions[mesh.triangles[t][0]].cast<double>();
    const Eigen::Vector3d b = mesh.positions[mesh.triangles[t][1]].cast<double>();
    const Eigen::Vector3d c = mesh.positions[mesh.triangles[t][2]].cast<double>();
    found.signed_volume_m3 += a.dot(b.cross(c)) / 6;
  }
  std::sort(sides.begin(), sides.end(), [](const Side& l, const Side& r) {
    return std::tie(l.low, l.high, l.triangle) < std::tie(r.low, r.high, r.triangle);
  });
  long edges = 0;
  for (size_t begin = 0, end = 0; begin < sides.size(); begin = end) {
    while (end < sides.size() && sides[end].same_edge(sides[begin])) ++end;
    ++edges;
    const size_t count = end - begin;
    if (count == 1) ++found.boundary_edges;
    if (count > 2) ++found.nonmanifold_edges;
    if (count == 2 && sides[begin].forward == sides[begin + 1].forward) ++found.inconsistent_edges;
    for (size_t i = begin + 1; i < end; ++i) {
      bodies.join(sides[begin].triangle, sides[i].triangle);
      corners.join(corner_of(sides[begin].triangle, sides[begin].low), corner_of(sides[i].triangle, sides[i].low));
      corners.join(corner_of(sides[begin].triangle, sides[begin].high), corner_of(sides[i].triangle, sides[i].high));
    }
  }
  std::vector<uint32_t> fans(mesh.positions.size(), 0);
  for (size_t corner = 0; corner < mesh.triangles.size() * 3; ++corner)
    if (corners.find(corner) == corner) ++fans[mesh.triangles[corner / 3][corner % 3]];
  long vertices = 0;
  for (const uint32_t count : fans) {
    if (count == 0) ++found.unreferenced_vertices;
    if (count > 1) ++found.nonmanifold_vertices;
    if (count > 0) ++vertices;
  }
  for (size_t t = 0; t < mesh.triangles.size(); ++t)
    if (bodies.find(t) == t) ++found.components;
  found.euler_number = vertices - edges + static_cast<long>(mesh.triangles.size());
  return found;
}

std::vector<Eigen::Vector3f> vertex_normals(const Mesh& mesh) {
  std::vector<Eigen::Vector3f> normals(mesh.positions.size(), Eigen::Vector3f::Zero());
  for (const auto& [a, b, c] : mesh.triangles) {
    const Eigen::Vector3f twice_area =
        (mesh.positions[b] - mesh.positions[a]).cross(mesh.positions[c] - mesh.positions[a]);
    for (const uint32_t v : {a, b, c}) normals[v] += twice_area;
  }
  for (Eigen::Vector3f& normal : normals)
    if (const float length = normal.norm(); length > 0) normal /= length;
  return normals;
}

}  // namespace booth
