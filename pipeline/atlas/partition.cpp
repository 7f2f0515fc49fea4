#include "pipeline/atlas/partition.h"

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <queue>
#include <tuple>

namespace booth {
namespace {

constexpr int32_t nobody = -1;

struct Facet {
  Eigen::Vector3d normal = Eigen::Vector3d::Zero(), middle = Eigen::Vector3d::Zero();
  double area = 0;
};

/// What a region is compared with: where it is and which way it faces.
struct Proxy {
  Eigen::Vector3d normal = Eigen::Vector3d::Zero(), middle = Eigen::Vector3d::Zero();
  uint32_t seed = 0;
};

class Partitioner {
 public:
  Partitioner(const Mesh& mesh, std::span<const std::array<int32_t, 3>> neighbours, int regions)
      : neighbours_(neighbours), facets_(mesh.triangles.size()), region_(mesh.triangles.size(), nobody) {
    double total = 0;
    for (size_t t = 0; t < facets_.size(); ++t) {
      const auto p = [&](size_t k) { return mesh.positions[mesh.triangles[t][k]].cast<double>(); };
      const Eigen::Vector3d twice = (p(1) - p(0)).cross(p(2) - p(0));
      facets_[t] = {twice.normalized(), (p(0) + p(1) + p(2)) / 3, 0.5 * twice.norm()};
      total += facets_[t].area;
    }
    radius2_ = std::max(total / regions, 1e-12);
    place_seeds(static_cast<size_t>(regions));
  }

  std::vector<std::vector<uint32_t>> run() {
    constexpr int rounds = 8;
    for (int round = 0; round < rounds; ++round) {
      grow(false);
      if (round + 1 < rounds) recentre();
    }
    refit_normals();
    grow(true);
    smooth_borders();
    return connected_regions();
  }

 private:
  /// Far from each other, in space and in direction.
  void place_seeds(size_t count) {
    std::vector<double> nearest(facets_.size(), std::numeric_limits<double>::infinity());
    uint32_t seed = 0;
    while (proxies_.size() < std::min(count, facets_.size())) {
      proxies_.push_back({facets_[seed].normal, facets_[seed].middle, seed});
      uint32_t farthest = 0;
      for (uint32_t t = 0; t < facets_.size(); ++t) {
        nearest[t] = std::min(nearest[t], error(t, proxies_.back()));
        if (nearest[t] > nearest[farthest]) farthest = t;
      }
      if (!(nearest[farthest] > 0)) break;
      seed = farthest;
    }
  }

  double error(uint32_t t, const Proxy& proxy) const {
    constexpr double compactness = 0.6;  // one region's radius away counts like a turn by 45°
    return (facets_[t].normal - proxy.normal).squaredNorm() +
           compactness * (facets_[t].middle - proxy.middle).squaredNorm() / radius2_;
  }
  bool faces(uint32_t t, const Proxy& proxy) const {
    constexpr double least_cosine = 0.26;  // 75°
    return facets_[t].normal.dot(proxy.normal) >= least_cosine || !(facets_[t].area > 0);
  }

  /// Floods all regions from their seeds at once, the best fitting triangle first. Bounded, triangles that turn too
  /// far from a region's normal are refused; those that nobody takes seed regions of their own.
  void grow(bool bounded) {
    std::fill(region_.begin(), region_.end(), nobody);
    open_ = {};
    for (size_t r = 0; r < proxies_.size(); ++r) take(proxies_[r].seed, static_cast<int32_t>(r));
    flood(bounded);
    for (uint32_t t = 0; t < region_.size(); ++t) {
      if (region_[t] != nobody) continue;
      proxies_.push_back({facets_[t].normal, facets_[t].middle, t});
      take(t, static_cast<int32_t>(proxies_.size()) - 1);
      flood(bounded);
    }
  }
  void take(uint32_t t, int32_t r) {
    if (region_[t] != nobody) return;
    region_[t] = r;
    for (const int32_t n : neighbours_[t])
      if (n >= 0 && region_[static_cast<size_t>(n)] == nobody)
        open_.push({error(static_cast<uint32_t>(n), proxies_[static_cast<size_t>(r)]), static_cast<uint32_t>(n), r});
  }
  void flood(bool bounded) {
    while (!open_.empty()) {
      const auto [cost, t, r] = open_.top();
      open_.pop();
      if (!bounded || faces(t, proxies_[static_cast<size_t>(r)])) take(t, r);
    }
  }

  void refit_normals() {
    for (Proxy& proxy : proxies_) proxy.normal = proxy.middle = Eigen::Vector3d::Zero();
    std::vector<double> area(proxies_.size(), 0);
    for (size_t t = 0; t < facets_.size(); ++t) {
      const auto r = static_cast<size_t>(region_[t]);
      proxies_[r].normal += facets_[t].area * facets_[t].normal;
      proxies_[r].middle += facets_[t].area * facets_[t].middle;
      area[r] += facets_[t].area;
    }
    for (size_t r = 0; r < proxies_.size(); ++r) {
      if (area[r] > 0) proxies_[r].middle /= area[r];
      proxies_[r].normal.normalize();
    }
  }
  /// The next seeds: the triangle that fits its region best.
  void recentre() {
    refit_normals();
    std::vector<double> best(proxies_.size(), std::numeric_limits<double>::infinity());
    for (uint32_t t = 0; t < facets_.size(); ++t) {
      const auto r = static_cast<size_t>(region_[t]);
      if (const double e = error(t, proxies_[r]); e < best[r]) {
        best[r] = e;
        proxies_[r].seed = t;
      }
    }
  }

  /// A triangle that has two neighbours in another region makes a ragged border: it changes over where it may.
  void smooth_borders() {
    constexpr int rounds = 4;
    for (int round = 0; round < rounds; ++round)
      for (uint32_t t = 0; t < region_.size(); ++t) {
        const auto of = [&](size_t k) {
          return neighbours_[t][k] < 0 ? region_[t] : region_[static_cast<size_t>(neighbours_[t][k])];
        };
        for (size_t k = 0; k < 3; ++k)
          if (of(k) != region_[t] && of(k) == of((k + 1) % 3) && faces(t, proxies_[static_cast<size_t>(of(k))])) {
            region_[t] = of(k);
            break;
          }
      }
  }

  /// Smoothing can tear a region: its pieces become regions.
  std::vector<std::vector<uint32_t>> connected_regions() const {
    std::vector<std::vector<uint32_t>> regions;
    std::vector<bool> done(region_.size(), false);
    for (uint32_t start = 0; start < region_.size(); ++start) {
      if (done[start]) continue;
      std::vector<uint32_t> members{start};
      done[start] = true;
      for (size_t i = 0; i < members.size(); ++i)
        for (const int32_t n : neighbours_[members[i]]) {
          if (n < 0 || done[static_cast<size_t>(n)] || region_[static_cast<size_t>(n)] != region_[start]) continue;
          done[static_cast<size_t>(n)] = true;
          members.push_back(static_cast<uint32_t>(n));
        }
      std::sort(members.begin(), members.end());
      regions.push_back(std::move(members));
    }
    return regions;
  }

  using Candidate = std::tuple<double, uint32_t, int32_t>;  ///< error, triangle, region

  std::span<const std::array<int32_t, 3>> neighbours_;
  std::vector<Facet> facets_;
  std::vector<int32_t> region_;
  std::vector<Proxy> proxies_;
  double radius2_ = 1;
  std::priority_queue<Candidate, std::vector<Candidate>, std::greater<>> open_;
};

}  // namespace

std::vector<std::vector<uint32_t>> partition_surface(const Mesh& mesh,
                                                     std::span<const std::array<int32_t, 3>> neighbours, int regions) {
  if (mesh.triangles.empty()) return {};
  return Partitioner(mesh, neighbours, std::max(1, regions)).run();
}

}  // namespace booth
