#include "pipeline/face/face_sewing.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <utility>

#include "pipeline/face/ray_caster.h"

namespace booth {
namespace {

using Triangle = std::array<uint32_t, 3>;
using Edge = std::array<uint32_t, 2>;

Edge undirected(uint32_t a, uint32_t b) { return {std::min(a, b), std::max(a, b)}; }

Eigen::Vector3f normal_of(std::span<const Eigen::Vector3f> p, const Triangle& t) {
  return (p[t[1]] - p[t[0]]).cross(p[t[2]] - p[t[0]]);
}

/// What a triangulation costs: compared by its sharpest fold first, then by its area.
struct Cost {
  float fold = 0;  ///< 1 − cosine of the angle between normals
  float area = 0;

  bool operator<(const Cost& other) const { return fold != other.fold ? fold < other.fold : area < other.area; }
  Cost operator+(const Cost& other) const { return {std::max(fold, other.fold), area + other.area}; }
};
constexpr Cost impossible{std::numeric_limits<float>::infinity(), std::numeric_limits<float>::infinity()};

float fold_between(const Eigen::Vector3f& a, const Eigen::Vector3f& b) {
  const float lengths = a.norm() * b.norm();
  return lengths > 0 ? 1 - a.dot(b) / lengths : 0;
}

/// Borders of an open mesh as directed edges: from where each goes on to. Nothing when a vertex has two.
bool border_of(const std::vector<Triangle>& triangles, std::map<uint32_t, uint32_t>* next,
               std::vector<uint32_t>* twice) {
  std::vector<Edge> edges;
  for (const Triangle& t : triangles)
    for (size_t k = 0; k < 3; ++k) edges.push_back({t[k], t[(k + 1) % 3]});
  std::sort(edges.begin(), edges.end());
  next->clear();
  twice->clear();
  for (const auto& [a, b] : edges)
    if (!std::binary_search(edges.begin(), edges.end(), Edge{b, a}) && !next->emplace(a, b).second) twice->push_back(a);
  return twice->empty();
}

/// The only loop of a border, against its direction; empty when there are several.
std::vector<uint32_t> only_loop(const std::map<uint32_t, uint32_t>& next) {
  std::vector<uint32_t> loop;
  if (next.empty()) return loop;
  uint32_t at = next.begin()->first;
  do {
    loop.push_back(at);
    const auto found = next.find(at);
    if (found == next.end() || loop.size() > next.size()) return {};
    at = found->second;
  } while (at != loop.front());
  if (loop.size() != next.size()) return {};
  std::reverse(loop.begin(), loop.end());
  return loop;
}

/// Groups of triangles that hang together over edges' ends: per triangle the group's number; and the largest group.
std::vector<uint32_t> groups_of(const std::vector<Triangle>& triangles, size_t vertices, uint32_t* largest) {
  std::vector<uint32_t> parent(vertices);
  std::iota(parent.begin(), parent.end(), 0U);
  const auto find = [&](uint32_t v) {
    while (parent[v] != v) v = parent[v] = parent[parent[v]];
    return v;
  };
  for (const auto& [a, b, c] : triangles) {
    parent[find(b)] = find(a);
    parent[find(c)] = find(a);
  }
  std::vector<size_t> size(vertices, 0);
  std::vector<uint32_t> group;
  for (const Triangle& t : triangles) ++size[group.emplace_back(find(t[0]))];
  *largest = static_cast<uint32_t>(std::max_element(size.begin(), size.end()) - size.begin());
  return group;
}

std::vector<Triangle> largest_group(const std::vector<Triangle>& triangles, size_t vertices) {
  uint32_t largest = 0;
  const std::vector<uint32_t> group = groups_of(triangles, vertices, &largest);
  std::vector<Triangle> kept;
  for (size_t t = 0; t < triangles.size(); ++t)
    if (group[t] == largest) kept.push_back(triangles[t]);
  return kept;
}

/// The hull's triangles without those that the patch, seen from its eye, covers or nearly touches.
/// @return nothing when what is left has not one simple border
std::vector<Triangle> cut_out(const Mesh& hull, const FacePatch& patch) {
  const RayCaster rays(patch.mesh);
  std::vector<uint8_t> covered(hull.positions.size(), 0);
  constexpr float depth_m = 0.04F;
  for (size_t v = 0; v < covered.size(); ++v) {
    const float far = (hull.positions[v] - patch.eye).norm();
    const auto hit = rays.cast(patch.eye, (hull.positions[v] - patch.eye) / far, far - depth_m, far + depth_m);
    covered[v] = hit ? 1 : 0;
  }
  // One ring more leaves room for the rim.
  std::vector<uint8_t> cut = covered;
  for (const Triangle& t : hull.triangles)
    if (covered[t[0]] + covered[t[1]] + covered[t[2]] > 0)
      for (const uint32_t v : t) cut[v] = 1;
  std::vector<Triangle> removed, kept;
  for (const Triangle& t : hull.triangles) (cut[t[0]] + cut[t[1]] + cut[t[2]] > 0 ? removed : kept).push_back(t);
  if (removed.empty() || kept.empty()) return {};
  // Only where the face is; islands within it go, too.
  uint32_t face = 0;
  const std::vector<uint32_t> group = groups_of(removed, hull.positions.size(), &face);
  for (size_t t = 0; t < removed.size(); ++t)
    if (group[t] != face) kept.push_back(removed[t]);
  std::map<uint32_t, uint32_t> next;
  std::vector<uint32_t> twice;
  constexpr int most_rounds = 20;
  for (int round = 0; round < most_rounds; ++round) {
    kept = largest_group(kept, hull.positions.size());
    if (border_of(kept, &next, &twice)) return kept;
    std::erase_if(kept, [&](const Triangle& t) {
      return std::any_of(t.begin(), t.end(),
                         [&](uint32_t v) { return std::find(twice.begin(), twice.end(), v) != twice.end(); });
    });
  }
  return {};
}

/// The patch's vertices, those of less weight drawn to the hull along the rays from its eye.
std::vector<Eigen::Vector3f> bend_to(const Mesh& hull, const FacePatch& patch) {
  const RayCaster rays(hull);
  std::vector<Eigen::Vector3f> bent = patch.mesh.positions;
  constexpr float reach_m = 0.015F;
  for (size_t v = 0; v < bent.size(); ++v) {
    if (patch.weight[v] >= 1) continue;
    const Eigen::Vector3f from_eye = bent[v] - patch.eye;
    const float far = from_eye.norm();
    if (const auto hit = rays.cast(patch.eye, from_eye / far, far - reach_m, far + reach_m))
      bent[v] += (1 - patch.weight[v]) * (hit->distance_m - far) * from_eye / far;
  }
  return bent;
}

}  // namespace

std::vector<Triangle> span_polygon(std::span<const Eigen::Vector3f> positions, std::span<const uint32_t> polygon,
                                   std::span<const Eigen::Vector3f> beyond, std::span<const Edge> taken) {
  const size_t n = polygon.size();
  if (n < 3) return {};
  // For i < k: the best triangulation of polygon[i … k], and the third corner of its triangle at the chord i – k.
  std::vector<Cost> best(n * n);
  std::vector<uint32_t> corner(n * n, 0);
  std::vector<uint8_t> allowed(n * n, 1);
  for (size_t i = 0; i < n; ++i)
    for (size_t k = i + 2; k < n; ++k) {
      const bool around = i == 0 && k == n - 1;
      allowed[i * n + k] =
          polygon[i] != polygon[k] &&
          (around || !std::binary_search(taken.begin(), taken.end(), undirected(polygon[i], polygon[k])));
    }
  const auto triangle = [&](size_t i, size_t m, size_t k) { return Triangle{polygon[i], polygon[m], polygon[k]}; };
  const auto across = [&](size_t i, size_t k) {
    return k == i + 1 ? beyond[i] : normal_of(positions, triangle(i, corner[i * n + k], k));
  };
  for (size_t length = 2; length < n; ++length)
    for (size_t i = 0; i + length < n; ++i) {
      const size_t k = i + length;
      Cost& least = best[i * n + k] = impossible;
      if (allowed[i * n + k] == 0) continue;
      for (size_t m = i + 1; m < k; ++m) {
        const Cost parts = best[i * n + m] + best[m * n + k];
        if (!(parts < least) || polygon[m] == polygon[i] || polygon[m] == polygon[k]) continue;
        const Eigen::Vector3f normal = normal_of(positions, triangle(i, m, k));
        Cost cost{std::max(fold_between(normal, across(i, m)), fold_between(normal, across(m, k))), normal.norm() / 2};
        if (i == 0 && k == n - 1) cost.fold = std::max(cost.fold, fold_between(normal, beyond[n - 1]));
        cost = cost + parts;
        if (!(cost < least)) continue;
        least = cost;
        corner[i * n + k] = static_cast<uint32_t>(m);
      }
    }
  std::vector<Triangle> triangles;
  if (std::isinf(best[n - 1].fold)) return triangles;
  std::vector<std::pair<size_t, size_t>> open{{0, n - 1}};
  while (!open.empty()) {
    const auto [i, k] = open.back();
    open.pop_back();
    if (k == i + 1) continue;
    const size_t m = corner[i * n + k];
    triangles.push_back(triangle(i, m, k));
    open.emplace_back(i, m);
    open.emplace_back(m, k);
  }
  return triangles;
}

Result<SewnFace> sew_face(const Mesh& hull, const FacePatch& patch) {
  const auto fault = [](const char* what) {
    return Error{ErrorCode::no_subject, std::string("the face could not be sewn to the hull: ") + what};
  };
  if (patch.mesh.triangles.empty()) return fault("there is nothing of it left");
  std::vector<Triangle> triangles = cut_out(hull, patch);
  std::map<uint32_t, uint32_t> next;
  std::vector<uint32_t> twice;
  border_of(triangles, &next, &twice);
  std::vector<uint32_t> outer = only_loop(next);
  if (outer.empty()) return fault("the hull cannot be cut along one loop around it");
  border_of(patch.mesh.triangles, &next, &twice);
  std::vector<uint32_t> inner = only_loop(next);
  if (inner.empty()) return fault("it has not one border");

  Mesh sewn{hull.positions, std::move(triangles)};
  const auto first = static_cast<uint32_t>(hull.positions.size());
  const std::vector<Eigen::Vector3f> bent = bend_to(hull, patch);
  sewn.positions.insert(sewn.positions.end(), bent.begin(), bent.end());
  for (const auto& [a, b, c] : patch.mesh.triangles) sewn.triangles.push_back({a + first, b + first, c + first});
  for (uint32_t& v : inner) v += first;

  // Both loops become one polygon by a bridge where they are closest.
  float closest = std::numeric_limits<float>::infinity();
  size_t from = 0, to = 0;
  for (size_t i = 0; i < outer.size(); ++i)
    for (size_t k = 0; k < inner.size(); ++k) {
      const float distance = (sewn.positions[outer[i]] - sewn.positions[inner[k]]).norm();
      if (distance >= closest) continue;
      closest = distance;
      from = i, to = k;
    }
  std::rotate(outer.begin(), outer.begin() + static_cast<std::ptrdiff_t>(from), outer.end());
  std::rotate(inner.begin(), inner.begin() + static_cast<std::ptrdiff_t>(to), inner.end());
  std::vector<uint32_t> polygon = outer;
  polygon.push_back(outer.front());
  polygon.insert(polygon.end(), inner.begin(), inner.end());
  polygon.push_back(inner.front());

  std::map<Edge, Eigen::Vector3f> normal_at;
  std::vector<Edge> taken;
  for (const Triangle& t : sewn.triangles)
    for (size_t k = 0; k < 3; ++k) {
      normal_at[{t[k], t[(k + 1) % 3]}] = normal_of(sewn.positions, t);
      taken.push_back(undirected(t[k], t[(k + 1) % 3]));
    }
  std::sort(taken.begin(), taken.end());
  std::vector<Eigen::Vector3f> beyond;
  for (size_t i = 0; i < polygon.size(); ++i) {
    const auto found = normal_at.find({polygon[(i + 1) % polygon.size()], polygon[i]});
    beyond.push_back(found == normal_at.end() ? Eigen::Vector3f(Eigen::Vector3f::Zero()) : found->second);
  }
  const std::vector<Triangle> span = span_polygon(sewn.positions, polygon, beyond, taken);
  if (span.empty()) return fault("the gap around it cannot be spanned");
  sewn.triangles.insert(sewn.triangles.end(), span.begin(), span.end());

  // Vertices that were cut away leave no trace.
  SewnFace result;
  constexpr uint32_t none = std::numeric_limits<uint32_t>::max();
  std::vector<uint32_t> renamed(sewn.positions.size(), none);
  for (const Triangle& t : sewn.triangles) {
    Triangle& triangle = result.mesh.triangles.emplace_back();
    for (size_t k = 0; k < 3; ++k) {
      uint32_t& name = renamed[t[k]];
      if (name == none) {
        name = static_cast<uint32_t>(result.mesh.positions.size());
        result.mesh.positions.push_back(sewn.positions[t[k]]);
        result.face.push_back(t[k] >= first ? 1 : 0);
      }
      triangle[k] = name;
    }
  }
  if (!topology(result.mesh).closed_manifold()) return fault("the mesh would not be closed");
  return result;
}

}  // namespace booth
