#include "pipeline/face/subdivision.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <unordered_map>

namespace booth {
namespace {

constexpr uint32_t none = std::numeric_limits<uint32_t>::max();

uint64_t directed(uint32_t from, uint32_t to) { return uint64_t{from} << 32 | to; }

/// The vertex opposite each directed edge, for the triangles around the marked ones.
class Neighbourhood {
 public:
  Neighbourhood(const Mesh& mesh, std::span<const uint8_t> marked) {
    std::vector<uint8_t> near(mesh.positions.size(), 0);
    // A butterfly's wings reach two triangles beyond a split edge.
    for (size_t t = 0; t < mesh.triangles.size(); ++t)
      if (marked[t] != 0)
        for (const uint32_t v : mesh.triangles[t]) near[v] = 1;
    const auto is_near = [&](const std::array<uint32_t, 3>& t) {
      return near[t[0]] != 0 || near[t[1]] != 0 || near[t[2]] != 0;
    };
    std::vector<size_t> ring;
    for (size_t t = 0; t < mesh.triangles.size(); ++t)
      if (is_near(mesh.triangles[t])) ring.push_back(t);
    for (const size_t t : ring)
      for (const uint32_t v : mesh.triangles[t]) near[v] = 1;
    for (const auto& triangle : mesh.triangles) {
      if (!is_near(triangle)) continue;
      for (size_t k = 0; k < 3; ++k) opposite_[directed(triangle[k], triangle[(k + 1) % 3])] = triangle[(k + 2) % 3];
    }
  }
  /// The third vertex of the triangle that runs from a to b, or none at a border.
  uint32_t opposite(uint32_t a, uint32_t b) const {
    const auto found = opposite_.find(directed(a, b));
    return found == opposite_.end() ? none : found->second;
  }
  /// The neighbours of `center`, counter-clockwise from `first`; empty where the fan is not closed.
  std::vector<uint32_t> ring(uint32_t center, uint32_t first) const {
    constexpr size_t most = 64;
    std::vector<uint32_t> around;
    for (uint32_t v = first;;) {
      around.push_back(v);
      v = opposite(center, v);
      if (v == first) return around;
      if (v == none || around.size() >= most) return {};
    }
  }

 private:
  std::unordered_map<uint64_t, uint32_t> opposite_;
};

/// Zorin's weights of the neighbours of an extraordinary vertex, the edge's other end first; its own is 3/4.
std::vector<float> extraordinary_weights(size_t valence) {
  if (valence == 3) return {5.0F / 12, -1.0F / 12, -1.0F / 12};
  if (valence == 4) return {3.0F / 8, 0, -1.0F / 8, 0};
  std::vector<float> weights(valence);
  const double n = static_cast<double>(valence);
  for (size_t j = 0; j < valence; ++j) {
    const double angle = 2 * std::numbers::pi * static_cast<double>(j) / n;
    weights[j] = static_cast<float>((0.25 + std::cos(angle) + 0.5 * std::cos(2 * angle)) / n);
  }
  return weights;
}

Eigen::Vector3f butterfly_point(const Mesh& mesh, const Neighbourhood& around, uint32_t a, uint32_t b) {
  const auto& p = mesh.positions;
  const Eigen::Vector3f middle = 0.5F * (p[a] + p[b]);
  const std::vector<uint32_t> ring_a = around.ring(a, b), ring_b = around.ring(b, a);
  if (ring_a.size() < 3 || ring_b.size() < 3) return middle;
  const auto extraordinary = [&](uint32_t center, const std::vector<uint32_t>& ring) {
    const std::vector<float> weights = extraordinary_weights(ring.size());
    Eigen::Vector3f point = 0.75F * p[center];
    for (size_t j = 0; j < ring.size(); ++j) point += weights[j] * p[ring[j]];
    return point;
  };
  constexpr size_t regular = 6;
  if (ring_a.size() == regular && ring_b.size() == regular)
    return middle + 0.125F * (p[ring_a[1]] + p[ring_a[5]]) -
           0.0625F * (p[ring_a[2]] + p[ring_a[4]] + p[ring_b[2]] + p[ring_b[4]]);
  if (ring_a.size() == regular) return extraordinary(b, ring_b);
  if (ring_b.size() == regular) return extraordinary(a, ring_a);
  return 0.5F * (extraordinary(a, ring_a) + extraordinary(b, ring_b));
}

}  // namespace

Subdivision subdivide(const Mesh& mesh, std::span<const uint8_t> marked, SubdivisionRule rule) {
  Subdivision out;
  out.mesh.positions = mesh.positions;
  const Neighbourhood around(mesh, marked);
  std::unordered_map<uint64_t, uint32_t> middles;  // by the edge's smaller vertex first
  const auto edge = [](uint32_t a, uint32_t b) { return directed(std::min(a, b), std::max(a, b)); };
  for (size_t t = 0; t < mesh.triangles.size(); ++t) {
    if (marked[t] == 0) continue;
    for (size_t k = 0; k < 3; ++k) {
      const uint32_t a = mesh.triangles[t][k], b = mesh.triangles[t][(k + 1) % 3];
      const auto [at, added] = middles.try_emplace(edge(a, b), static_cast<uint32_t>(out.mesh.positions.size()));
      if (!added) continue;
      out.mesh.positions.push_back(rule == SubdivisionRule::butterfly
                                       ? butterfly_point(mesh, around, std::min(a, b), std::max(a, b))
                                       : Eigen::Vector3f(0.5F * (mesh.positions[a] + mesh.positions[b])));
    }
  }
  const auto emit = [&](uint32_t a, uint32_t b, uint32_t c, uint8_t refined) {
    out.mesh.triangles.push_back({a, b, c});
    out.refined.push_back(refined);
  };
  for (size_t t = 0; t < mesh.triangles.size(); ++t) {
    const auto& corner = mesh.triangles[t];
    std::array<uint32_t, 3> middle{none, none, none};  // of the side after each corner
    size_t split = 0;
    for (size_t k = 0; k < 3; ++k)
      if (const auto found = middles.find(edge(corner[k], corner[(k + 1) % 3])); found != middles.end()) {
        middle[k] = found->second;
        ++split;
      }
    if (split == 0) {
      emit(corner[0], corner[1], corner[2], 0);
    } else if (split == 3) {
      for (size_t k = 0; k < 3; ++k) emit(corner[k], middle[k], middle[(k + 2) % 3], marked[t]);
      emit(middle[0], middle[1], middle[2], marked[t]);
    } else {
      // Turned so that side 0 is split and, of two, the sides 0 and 1.
      size_t turn = 0;
      while (middle[turn] == none || (split == 2 && middle[(turn + 1) % 3] == none)) ++turn;
      const uint32_t a = corner[turn], b = corner[(turn + 1) % 3], c = corner[(turn + 2) % 3];
      const uint32_t m = middle[turn], n = middle[(turn + 1) % 3];
      if (split == 1) {
        emit(a, m, c, 0);
        emit(m, b, c, 0);
      } else {
        emit(m, b, n, 0);
        emit(a, m, n, 0);
        emit(a, n, c, 0);
      }
    }
  }
  return out;
}

}  // namespace booth
