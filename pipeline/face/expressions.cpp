#include "pipeline/face/expressions.h"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <set>
#include <unordered_map>

namespace booth {
namespace {

/// The linear map that takes the neutral head's edges around each vertex to the fitted head's, by least squares; across
/// a flat neighbourhood, where edges say nothing, that of the similarity.
std::vector<Eigen::Matrix3f> gradients(const NeutralHead& neutral, const FittedHead& head) {
  struct Moments {
    Eigen::Matrix3f mixed = Eigen::Matrix3f::Zero(), own = Eigen::Matrix3f::Zero();
  };
  const size_t count = neutral.mesh.positions.size();
  std::vector<Moments> moments(count);
  for (const auto& t : neutral.mesh.triangles)
    for (size_t k = 0; k < 3; ++k) {
      const uint32_t a = t[k], b = t[(k + 1) % 3];
      const Eigen::Vector3f from = neutral.mesh.positions[b] - neutral.mesh.positions[a];
      const Eigen::Vector3f to = head.mesh.positions[b] - head.mesh.positions[a];
      for (const uint32_t v : {a, b}) {
        moments[v].mixed += to * from.transpose();
        moments[v].own += from * from.transpose();
      }
    }
  // Moments of ever wider neighbourhoods: a centimetre or so after these rounds.
  constexpr int rounds = 8;
  for (int round = 0; round < rounds; ++round) {
    std::vector<Moments> wider = moments;
    for (const auto& t : neutral.mesh.triangles)
      for (size_t k = 0; k < 3; ++k) {
        constexpr float share = 0.1F;
        const Moments& next = moments[t[(k + 1) % 3]];
        const Moments& before = moments[t[(k + 2) % 3]];
        wider[t[k]].mixed += share * (next.mixed + before.mixed);
        wider[t[k]].own += share * (next.own + before.own);
      }
    moments = std::move(wider);
  }
  const Eigen::Matrix3f whole = (head.scale * head.rotation).cast<float>();
  std::vector<Eigen::Matrix3f> gradient(count, whole);
  for (size_t v = 0; v < count; ++v) {
    constexpr float hold = 0.005F;
    const float weight = hold * moments[v].own.trace();
    if (weight > 0)
      gradient[v] =
          (moments[v].mixed + weight * whole) * (moments[v].own + weight * Eigen::Matrix3f::Identity()).inverse();
  }
  return gradient;
}

/// What lies between the lids, their edges included, which a mesh of another spacing cannot have.
class BetweenLids {
 public:
  explicit BetweenLids(const NeutralHead& neutral) {
    std::vector<uint8_t> within = neutral.eyeball;
    constexpr int edge = 3;  // rows of vertices: the lid's inside and its edge
    for (int row = 0; row < edge; ++row) {
      std::vector<uint8_t> wider = within;
      for (const auto& t : neutral.mesh.triangles)
        if (std::any_of(t.begin(), t.end(), [&](uint32_t v) { return within[v] != 0; }))
          for (const uint32_t v : t) wider[v] = 1;
      within = std::move(wider);
    }
    std::map<uint32_t, std::set<uint32_t>> next_to;
    for (uint32_t v = 0; v < within.size(); ++v)
      if (within[v] != 0) next_to[v];
    for (const auto& t : neutral.mesh.triangles)
      for (const uint32_t v : t)
        if (const auto found = next_to.find(v); found != next_to.end()) found->second.insert(t.begin(), t.end());
    for (auto& [v, others] : next_to) {
      others.erase(v);
      vertices_.push_back({v, {others.begin(), others.end()}});
    }
  }

  /// Moves it with the lids, by how near it is to each: every vertex as its neighbours do in the mean. An expression in
  /// which the lid's edge went farthest goes as far with what is next to it, so that eyes still close.
  void follow(std::vector<Eigen::Vector3f>& offset) const {
    const float farthest = largest(offset);
    constexpr int rounds = 200;  // an eye is some fifteen vertices across
    for (int round = 0; round < rounds; ++round)
      for (const Vertex& vertex : vertices_) {
        Eigen::Vector3f sum = Eigen::Vector3f::Zero();
        for (const uint32_t other : vertex.next_to) sum += offset[other];
        offset[vertex.index] = sum / static_cast<float>(vertex.next_to.size());
      }
    if (const float left = largest(offset); left > 0)
      for (Eigen::Vector3f& o : offset) o *= farthest / left;
  }

 private:
  struct Vertex {
    uint32_t index;
    std::vector<uint32_t> next_to;
  };
  static float largest(const std::vector<Eigen::Vector3f>& offset) {
    float most = 0;
    for (const Eigen::Vector3f& o : offset) most = std::max(most, o.norm());
    return most;
  }
  std::vector<Vertex> vertices_;
};

/// The point of a triangle nearest to p, as barycentric weights.
/// Source: C. Ericson, "Real-time collision detection", 2005, 5.1.5.
Eigen::Vector3f nearest_in_triangle(const Eigen::Vector3f& p, const Eigen::Vector3f& a, const Eigen::Vector3f& b,
                                    const Eigen::Vector3f& c) {
  const Eigen::Vector3f ab = b - a, ac = c - a;
  const float d1 = ab.dot(p - a), d2 = ac.dot(p - a);
  if (d1 <= 0 && d2 <= 0) return {1, 0, 0};
  const float d3 = ab.dot(p - b), d4 = ac.dot(p - b);
  if (d3 >= 0 && d4 <= d3) return {0, 1, 0};
  const float vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return {1 - d1 / (d1 - d3), d1 / (d1 - d3), 0};
  const float d5 = ab.dot(p - c), d6 = ac.dot(p - c);
  if (d6 >= 0 && d5 <= d6) return {0, 0, 1};
  const float vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return {1 - d2 / (d2 - d6), 0, d2 / (d2 - d6)};
  const float va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
    const float share = (d4 - d3) / ((d4 - d3) + (d5 - d6));
    return {0, 1 - share, share};
  }
  const float whole = va + vb + vc;
  return {va / whole, vb / whole, vc / whole};
}

/// Triangles by the cells of a grid that their boxes touch.
class TriangleGrid {
 public:
  TriangleGrid(const Mesh& mesh, float cell_m) : mesh_(mesh), cell_m_(cell_m), normals_(vertex_normals(mesh)) {
    for (uint32_t t = 0; t < mesh.triangles.size(); ++t) {
      Eigen::AlignedBox3f box;
      for (const uint32_t v : mesh.triangles[t]) box.extend(mesh.positions[v]);
      const Eigen::Vector3i low = cell(box.min()), high = cell(box.max());
      for (int z = low.z(); z <= high.z(); ++z)
        for (int y = low.y(); y <= high.y(); ++y)
          for (int x = low.x(); x <= high.x(); ++x) triangles_[key({x, y, z})].push_back(t);
    }
  }

  struct Place {
    uint32_t triangle = 0;
    Eigen::Vector3f weights = Eigen::Vector3f::Zero();
    float distance_m = std::numeric_limits<float>::infinity();
  };
  /// The nearest place within a cell's size whose normal is less than a right angle away from the given one.
  Place nearest(const Eigen::Vector3f& p, const Eigen::Vector3f& normal) const {
    Place best;
    const Eigen::Vector3i middle = cell(p);
    for (int z = -1; z <= 1; ++z)
      for (int y = -1; y <= 1; ++y)
        for (int x = -1; x <= 1; ++x) {
          const auto found = triangles_.find(key(middle + Eigen::Vector3i(x, y, z)));
          if (found == triangles_.end()) continue;
          for (const uint32_t t : found->second) {
            const auto& [a, b, c] = mesh_.triangles[t];
            const Eigen::Vector3f weights =
                nearest_in_triangle(p, mesh_.positions[a], mesh_.positions[b], mesh_.positions[c]);
            const Eigen::Vector3f at =
                weights.x() * mesh_.positions[a] + weights.y() * mesh_.positions[b] + weights.z() * mesh_.positions[c];
            const float distance = (at - p).norm();
            if (distance >= best.distance_m || distance > cell_m_) continue;
            if ((weights.x() * normals_[a] + weights.y() * normals_[b] + weights.z() * normals_[c]).dot(normal) <= 0)
              continue;
            best = {t, weights, distance};
          }
        }
    return best;
  }

 private:
  Eigen::Vector3i cell(const Eigen::Vector3f& p) const { return (p / cell_m_).array().floor().cast<int>(); }
  static uint64_t key(const Eigen::Vector3i& c) {
    constexpr int half = 1 << 20;
    constexpr int bits = 21;
    const auto part = [](int i) { return static_cast<uint64_t>(i + half) & ((uint64_t{1} << bits) - 1); };
    return part(c.x()) | part(c.y()) << bits | part(c.z()) << 2 * bits;
  }

  const Mesh& mesh_;
  float cell_m_;
  std::vector<Eigen::Vector3f> normals_;
  std::unordered_map<uint64_t, std::vector<uint32_t>> triangles_;
};

}  // namespace

std::vector<MorphTarget> carry_expressions(const NeutralHead& neutral, const FittedHead& head, const FacePatch& patch,
                                           const Mesh& mesh, const Work& work) {
  // Every vertex's place on the patch and how much of the expressions it takes.
  constexpr float close_m = 0.004F, far_m = 0.01F;
  const TriangleGrid grid(patch.mesh, far_m);
  Eigen::AlignedBox3f box;
  for (const Eigen::Vector3f& p : patch.mesh.positions) box.extend(p);
  const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
  std::vector<TriangleGrid::Place> places(mesh.positions.size());
  constexpr size_t grain = 256;
  work.parallel_for(places.size(), grain, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v)
      if (box.exteriorDistance(mesh.positions[v]) < far_m) places[v] = grid.nearest(mesh.positions[v], normals[v]);
  });

  const std::vector<Eigen::Matrix3f> gradient = gradients(neutral, head);
  const BetweenLids between_lids(neutral);
  std::vector<MorphTarget> morphs;
  for (const Expression& expression : neutral.expressions) {
    std::vector<Eigen::Vector3f> offset(neutral.mesh.positions.size(), Eigen::Vector3f::Zero());
    for (size_t i = 0; i < expression.vertices.size(); ++i)
      offset[expression.vertices[i]] = gradient[expression.vertices[i]] * expression.offsets[i];
    between_lids.follow(offset);
    MorphTarget morph{expression.name, {}, {}};
    for (uint32_t v = 0; v < places.size(); ++v) {
      const TriangleGrid::Place& place = places[v];
      if (!(place.distance_m < far_m)) continue;
      Eigen::Vector3f moved = Eigen::Vector3f::Zero();
      const float near = std::clamp((far_m - place.distance_m) / (far_m - close_m), 0.0F, 1.0F);
      for (size_t k = 0; k < 3; ++k) {
        const uint32_t corner = patch.mesh.triangles[place.triangle][k];
        moved += near * place.weights[static_cast<Eigen::Index>(k)] * patch.weight[corner] *
                 offset[patch.head_vertex[corner]];
      }
      constexpr float visible_m = 2e-5F;
      if (moved.norm() < visible_m) continue;
      morph.vertices.push_back(v);
      morph.offsets.push_back(moved);
    }
    if (!morph.vertices.empty()) morphs.push_back(std::move(morph));
  }
  return morphs;
}

}  // namespace booth
