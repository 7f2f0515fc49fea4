#include "pipeline/face/face_patch.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <functional>
#include <limits>
#include <numeric>
#include <queue>
#include <utility>

namespace booth {
namespace {

using Neighbours = std::vector<std::vector<uint32_t>>;

/// Triangles of the head with all corners in its face.
std::vector<std::array<uint32_t, 3>> face_triangles(const FittedHead& head) {
  std::vector<std::array<uint32_t, 3>> triangles;
  for (const auto& t : head.mesh.triangles)
    if (std::all_of(t.begin(), t.end(), [&](uint32_t v) { return head.face[v] != 0; })) triangles.push_back(t);
  return triangles;
}

/// Of vertices that `doubted` marks, those in connected groups that cover at least `smallest_m2`.
std::vector<uint8_t> large_groups(const std::vector<uint8_t>& doubted, const Neighbours& neighbours,
                                  const std::vector<double>& area, double smallest_m2) {
  std::vector<uint8_t> large(doubted.size(), 0), seen(doubted.size(), 0);
  for (uint32_t start = 0; start < doubted.size(); ++start) {
    if (doubted[start] == 0 || seen[start] != 0) continue;
    std::vector<uint32_t> group{start};
    seen[start] = 1;
    double sum = 0;
    for (size_t n = 0; n < group.size(); ++n) {
      sum += area[group[n]];
      for (const uint32_t next : neighbours[group[n]])
        if (doubted[next] != 0 && seen[next] == 0) {
          seen[next] = 1;
          group.push_back(next);
        }
    }
    if (sum >= smallest_m2)
      for (const uint32_t v : group) large[v] = 1;
  }
  return large;
}

/// Lengths of shortest paths along edges from the sources.
std::vector<float> distances_from(const std::vector<uint8_t>& source, const Neighbours& neighbours,
                                  const std::vector<Eigen::Vector3f>& positions) {
  using Reached = std::pair<float, uint32_t>;
  std::vector<float> distance(positions.size(), std::numeric_limits<float>::infinity());
  std::priority_queue<Reached, std::vector<Reached>, std::greater<>> queue;
  for (uint32_t v = 0; v < source.size(); ++v)
    if (source[v] != 0) queue.emplace(distance[v] = 0, v);
  while (!queue.empty()) {
    const auto [so_far, v] = queue.top();
    queue.pop();
    if (so_far > distance[v]) continue;
    for (const uint32_t next : neighbours[v]) {
      const float there = so_far + (positions[next] - positions[v]).norm();
      if (there >= distance[next]) continue;
      distance[next] = there;
      queue.emplace(there, next);
    }
  }
  return distance;
}

float smooth_step(float t) {
  t = std::clamp(t, 0.0F, 1.0F);
  constexpr float two = 2, three = 3;
  return t * t * (three - two * t);
}

}  // namespace

FacePatch face_patch(const FittedHead& head, const FacePatchOptions& options) {
  const std::vector<Eigen::Vector3f>& positions = head.mesh.positions;
  const auto triangles = face_triangles(head);
  Neighbours neighbours(positions.size());
  std::vector<double> area(positions.size(), 0);
  std::vector<std::array<uint32_t, 2>> edges;
  for (const auto& t : triangles) {
    const double third =
        static_cast<double>((positions[t[1]] - positions[t[0]]).cross(positions[t[2]] - positions[t[0]]).norm()) / 6;
    for (size_t k = 0; k < 3; ++k) {
      area[t[k]] += third;
      edges.push_back({t[k], t[(k + 1) % 3]});
    }
  }
  // An edge that is not there the other way round belongs to the rim.
  std::sort(edges.begin(), edges.end());
  std::vector<uint8_t> ends(positions.size(), 0), doubted(positions.size(), 0);
  for (const auto& [a, b] : edges) {
    neighbours[a].push_back(b);
    if (std::binary_search(edges.begin(), edges.end(), std::array<uint32_t, 2>{b, a})) continue;
    neighbours[b].push_back(a);
    ends[a] = ends[b] = 1;
  }
  constexpr float bare_enough = 0.5F;
  for (size_t v = 0; v < positions.size(); ++v) doubted[v] = head.face[v] != 0 && head.bare[v] < bare_enough ? 1 : 0;
  const std::vector<uint8_t> covered = large_groups(doubted, neighbours, area, options.smallest_cover_m2);
  for (size_t v = 0; v < positions.size(); ++v) ends[v] |= covered[v];
  const std::vector<float> from_end = distances_from(ends, neighbours, positions);

  FacePatch patch;
  const auto add = [&](Mesh* mesh, std::vector<uint32_t>* name, const std::array<uint32_t, 3>& t, auto&& on_vertex) {
    constexpr uint32_t none = std::numeric_limits<uint32_t>::max();
    if (name->empty()) name->assign(positions.size(), none);
    std::array<uint32_t, 3> renamed{};
    for (size_t k = 0; k < 3; ++k) {
      uint32_t& place = (*name)[t[k]];
      if (place == none) {
        place = static_cast<uint32_t>(mesh->positions.size());
        mesh->positions.push_back(positions[t[k]]);
        on_vertex(t[k]);
      }
      renamed[k] = place;
    }
    mesh->triangles.push_back(renamed);
  };
  const auto blend = static_cast<float>(options.blend_m);
  constexpr float nearly = 0.85F;
  std::vector<uint32_t> in_patch, in_core;
  for (const auto& t : triangles) {
    add(&patch.mesh, &in_patch, t, [&](uint32_t v) {
      patch.head_vertex.push_back(v);
      patch.weight.push_back(smooth_step(from_end[v] / blend));
    });
    if (std::min({from_end[t[0]], from_end[t[1]], from_end[t[2]]}) < nearly * blend) continue;
    add(&patch.core.mesh, &in_core, t, [&](uint32_t v) {
      constexpr float farthest_m = 0.05F;
      patch.core.rim_m.push_back(std::min(from_end[v], farthest_m));
      patch.core.confidence.push_back(1);
    });
  }
  const Eigen::Vector3d before_neutral(0, -0.1, 0.9);
  patch.eye = (head.scale * (head.rotation * before_neutral) + head.translation).cast<float>();
  return patch;
}

}  // namespace booth
