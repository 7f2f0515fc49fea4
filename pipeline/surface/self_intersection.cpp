#include "pipeline/surface/self_intersection.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <numeric>

namespace booth {
namespace {

/// Six times the volume of a tetrahedron. Differences of floats are exact in double.
double volume(const Eigen::Vector3d& a, const Eigen::Vector3d& b, const Eigen::Vector3d& c, const Eigen::Vector3d& d) {
  return (a - d).dot((b - d).cross(c - d));
}

bool pierces(const Mesh& mesh, const std::array<uint32_t, 2>& edge, const std::array<uint32_t, 3>& triangle) {
  for (const uint32_t v : triangle)
    if (v == edge[0] || v == edge[1]) return false;
  const auto at = [&](uint32_t v) { return Eigen::Vector3d(mesh.positions[v].cast<double>()); };
  const Eigen::Vector3d p = at(edge[0]), q = at(edge[1]);
  const Eigen::Vector3d a = at(triangle[0]), b = at(triangle[1]), c = at(triangle[2]);
  const double from = volume(a, b, c, p), to = volume(a, b, c, q);
  if (!(from * to < 0)) return false;
  const double ab = volume(p, q, a, b), bc = volume(p, q, b, c), ca = volume(p, q, c, a);
  return (ab > 0 && bc > 0 && ca > 0) || (ab < 0 && bc < 0 && ca < 0);
}

}  // namespace

std::vector<SelfIntersection> find_self_intersections(const Mesh& mesh) {
  const size_t count = mesh.triangles.size();
  std::vector<Eigen::AlignedBox3f> boxes(count);
  for (size_t t = 0; t < count; ++t)
    for (const uint32_t v : mesh.triangles[t]) boxes[t].extend(mesh.positions[v]);
  std::vector<uint32_t> upwards(count);
  std::iota(upwards.begin(), upwards.end(), 0U);
  std::sort(upwards.begin(), upwards.end(), [&](uint32_t s, uint32_t t) {
    return std::pair(boxes[s].min().y(), s) < std::pair(boxes[t].min().y(), t);
  });
  std::vector<SelfIntersection> found;
  const auto test = [&](uint32_t of_edges, uint32_t triangle) {
    const auto& corner = mesh.triangles[of_edges];
    for (size_t k = 0; k < 3; ++k) {
      const std::array<uint32_t, 2> edge{corner[k], corner[(k + 1) % 3]};
      // On a closed mesh each edge runs once upwards.
      if (edge[0] < edge[1] && pierces(mesh, edge, mesh.triangles[triangle])) found.push_back({edge, triangle});
    }
  };
  for (size_t i = 0; i < count; ++i) {
    const Eigen::AlignedBox3f& box = boxes[upwards[i]];
    for (size_t j = i + 1; j < count && boxes[upwards[j]].min().y() <= box.max().y(); ++j) {
      const Eigen::AlignedBox3f& other = boxes[upwards[j]];
      if (other.min().x() > box.max().x() || other.max().x() < box.min().x() || other.min().z() > box.max().z() ||
          other.max().z() < box.min().z())
        continue;
      test(upwards[i], upwards[j]);
      test(upwards[j], upwards[i]);
    }
  }
  std::sort(found.begin(), found.end(), [](const SelfIntersection& a, const SelfIntersection& b) {
    return std::pair(a.triangle, a.edge) < std::pair(b.triangle, b.edge);
  });
  return found;
}

size_t remove_self_intersections(Mesh* mesh, const Work& work) {
  constexpr int rounds = 40, rounds_per_ring = 5;
  std::vector<SelfIntersection> found = find_self_intersections(*mesh);
  for (int round = 0; round < rounds && !found.empty() && !work.stopped(); ++round) {
    std::vector<uint8_t> tangled(mesh->positions.size(), 0);
    for (const SelfIntersection& at : found) {
      for (const uint32_t v : at.edge) tangled[v] = 1;
      for (const uint32_t v : mesh->triangles[at.triangle]) tangled[v] = 1;
    }
    for (int ring = 0; ring < round / rounds_per_ring; ++ring) {
      const std::vector<uint8_t> before = tangled;
      for (const auto& triangle : mesh->triangles)
        if (std::any_of(triangle.begin(), triangle.end(), [&](uint32_t v) { return before[v] != 0; }))
          for (const uint32_t v : triangle) tangled[v] = 1;
    }
    std::vector<Eigen::Vector3d> sum(mesh->positions.size(), Eigen::Vector3d::Zero());
    std::vector<int> neighbours(mesh->positions.size(), 0);
    for (const auto& triangle : mesh->triangles)
      for (size_t k = 0; k < 3; ++k) {
        const uint32_t v = triangle[k];
        if (tangled[v] == 0) continue;
        sum[v] += mesh->positions[triangle[(k + 1) % 3]].cast<double>();  // each neighbour once on a closed mesh
        ++neighbours[v];
      }
    for (size_t v = 0; v < tangled.size(); ++v)
      if (neighbours[v] > 0)
        mesh->positions[v] = 0.5F * (mesh->positions[v] + (sum[v] / static_cast<double>(neighbours[v])).cast<float>());
    found = find_self_intersections(*mesh);
  }
  return found.size();
}

}  // namespace booth
