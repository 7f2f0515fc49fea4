#include "pipeline/surface/decimation.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <bit>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

namespace booth {
namespace {

constexpr uint32_t none = std::numeric_limits<uint32_t>::max();

// Half-edge 3 t + k of triangle t runs from its corner k to the next one.
constexpr uint32_t next(uint32_t half) { return half % 3 == 2 ? half - 2 : half + 1; }
constexpr uint32_t previous(uint32_t half) { return half % 3 == 0 ? half + 2 : half - 1; }

/// xᵀ A x + 2 bᵀ x + c: the sum of squared distances to planes, weighted by area (Garland and Heckbert, section 4).
struct Quadric {
  std::array<double, 6> a{};  ///< xx, xy, xz, yy, yz, zz
  Eigen::Vector3d b = Eigen::Vector3d::Zero();
  double c = 0;

  void add_plane(const Eigen::Vector3d& normal, double offset, double weight) {
    const Eigen::Vector3d weighted = weight * normal;
    a[0] += weighted.x() * normal.x();
    a[1] += weighted.x() * normal.y();
    a[2] += weighted.x() * normal.z();
    a[3] += weighted.y() * normal.y();
    a[4] += weighted.y() * normal.z();
    a[5] += weighted.z() * normal.z();
    b += offset * weighted;
    c += weight * offset * offset;
  }
  Quadric& operator+=(const Quadric& other) {
    for (size_t i = 0; i < a.size(); ++i) a[i] += other.a[i];
    b += other.b;
    c += other.c;
    return *this;
  }
  double trace() const { return a[0] + a[3] + a[5]; }
  /// Adds weight · |x − center|².
  void pull_to(const Eigen::Vector3d& center, double weight) {
    a[0] += weight;
    a[3] += weight;
    a[5] += weight;
    b -= weight * center;
    c += weight * center.squaredNorm();
  }
  Eigen::Vector3d times(const Eigen::Vector3d& x) const {
    return {a[0] * x.x() + a[1] * x.y() + a[2] * x.z(), a[1] * x.x() + a[3] * x.y() + a[4] * x.z(),
            a[2] * x.x() + a[4] * x.y() + a[5] * x.z()};
  }
  double at(const Eigen::Vector3d& x) const { return x.dot(times(x)) + 2 * b.dot(x) + c; }
};

/// A⁻¹ of a positive definite quadric by cofactors.
class Inverse {
 public:
  explicit Inverse(const Quadric& q) {
    const auto [xx, xy, xz, yy, yz, zz] = q.a;
    cofactors_ = {yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
                  xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy};
    const double determinant = xx * cofactors_[0] + xy * cofactors_[1] + xz * cofactors_[2];
    scale_ = determinant > 0 ? 1 / determinant : 0;
  }
  Eigen::Vector3d times(const Eigen::Vector3d& v) const {
    const auto& m = cofactors_;
    return scale_ * Eigen::Vector3d(m[0] * v.x() + m[1] * v.y() + m[2] * v.z(),
                                    m[1] * v.x() + m[3] * v.y() + m[4] * v.z(),
                                    m[2] * v.x() + m[4] * v.y() + m[5] * v.z());
  }

 private:
  std::array<double, 6> cofactors_;
  double scale_;
};

/// Edges by cost, in buckets that grow by a sixteenth: costs closer than that are as good as equal, and a push or a
/// pop touches one place in memory instead of a heap's path. First in, first out within a bucket.
class EdgeQueue {
 public:
  struct Entry {
    uint32_t half, stamp;
  };
  EdgeQueue() : buckets_(bucket_of(std::numeric_limits<float>::infinity()) + 1) {}

  static size_t bucket_of(float cost) {
    constexpr int dropped_bits = 19;  // of a float's 23 bits of mantissa
    return std::bit_cast<uint32_t>(cost > 0 ? cost : 0.0F) >> dropped_bits;
  }
  static constexpr size_t fourfold = 32;  ///< that many buckets on, costs are four times as large

  void push(size_t bucket, const Entry& entry) {
    bucket = std::min(bucket, buckets_.size() - 1);
    buckets_[bucket].entries.push_back(entry);
    lowest_ = std::min(lowest_, bucket);
  }
  /// The entry of least cost, and its bucket; false when there is none.
  bool pop(Entry& entry, size_t& bucket) {
    for (; lowest_ < buckets_.size(); ++lowest_) {
      Bucket& candidate = buckets_[lowest_];
      if (candidate.taken == candidate.entries.size()) {
        candidate = {};
        continue;
      }
      entry = candidate.entries[candidate.taken++];
      bucket = lowest_;
      return true;
    }
    return false;
  }
  size_t buckets() const { return buckets_.size(); }

 private:
  struct Bucket {
    std::vector<Entry> entries;
    size_t taken = 0;
  };
  std::vector<Bucket> buckets_;
  size_t lowest_ = 0;
};

class Decimation {
 public:
  Decimation(const Mesh& mesh, const Work& work) : work_(work), triangles_(mesh.triangles) {
    positions_.reserve(mesh.positions.size());
    for (const Eigen::Vector3f& p : mesh.positions) positions_.push_back(p.cast<double>());
    alive_ = triangles_.size();
    find_twins();
    lock_unsafe_vertices();
    sum_quadrics();
  }

  Mesh run(size_t budget) {
    // Where every collapse left is refused, what is asked of the triangles around it is lowered.
    for (const Guard& guard : {Guard{0.3, 0.02}, Guard{-0.3, 0.002}, Guard{-1, 1e-5}}) {
      guard_ = guard;
      while (alive_ > budget) {
        const size_t before = alive_;
        queue_all();
        collapse_until(budget);
        if (work_.stopped() || alive_ == before) break;
      }
    }
    return compact();
  }

 private:
  /// What a collapse may do to the triangles that it moves.
  struct Guard {
    double least_cosine;  ///< between a triangle's normals before and after
    double thinnest;      ///< twice the area over the longest side squared: 0.87 for equal sides, 0 for a needle
  };

  uint32_t from(uint32_t half) const { return triangles_[half / 3][half % 3]; }
  uint32_t to(uint32_t half) const { return from(next(half)); }
  bool dead(uint32_t half) const { return triangles_[half / 3][0] == none; }

  /// Calls `visit` with every half-edge that leaves where `half` leaves from, `half` first.
  template <class Visitor>
  void for_each_spoke(uint32_t half, const Visitor& visit) const {
    uint32_t spoke = half;
    do {
      visit(spoke);
      spoke = twin_[previous(spoke)];
    } while (spoke != half && spoke != none);
  }

  /// Pairs the half-edges by a counting sort over their smaller vertex.
  void find_twins() {
    const size_t halves = triangles_.size() * 3;
    twin_.assign(halves, none);
    std::vector<uint32_t> first(positions_.size() + 1, 0);
    const auto low = [&](uint32_t half) { return std::min(from(half), to(half)); };
    const auto high = [&](uint32_t half) { return std::max(from(half), to(half)); };
    for (uint32_t half = 0; half < halves; ++half) ++first[low(half) + 1];
    std::partial_sum(first.begin(), first.end(), first.begin());
    std::vector<uint32_t> sorted(halves), filled(first.begin(), first.end() - 1);
    for (uint32_t half = 0; half < halves; ++half) sorted[filled[low(half)]++] = half;
    locked_.assign(positions_.size(), false);
    for (size_t v = 0; v < positions_.size(); ++v) {
      const auto begin = sorted.begin() + first[v], end = sorted.begin() + first[v + 1];
      for (auto a = begin; a != end; ++a) {
        // An edge with other than two triangles, or with two that run the same way, keeps both its vertices.
        const auto same = [&](uint32_t half) { return high(half) == high(*a); };
        const auto count = std::count_if(begin, end, same);
        const auto b = std::find_if(begin, end, [&](uint32_t half) { return half != *a && same(half); });
        if (count == 2 && from(*a) != from(*b))
          twin_[*a] = *b;
        else
          locked_[v] = locked_[high(*a)] = true;
      }
    }
  }

  /// A vertex whose triangles form more than one fan must stay: its spokes cannot all be visited.
  void lock_unsafe_vertices() {
    std::vector<uint32_t> corners(positions_.size(), 0);
    std::vector<uint32_t> spoke(positions_.size(), none);
    for (uint32_t half = 0; half < twin_.size(); ++half) {
      ++corners[from(half)];
      spoke[from(half)] = half;
    }
    for (size_t v = 0; v < positions_.size(); ++v) {
      if (locked_[v] || spoke[v] == none) continue;
      uint32_t visited = 0;
      for_each_spoke(spoke[v], [&](uint32_t) { ++visited; });
      if (visited != corners[v]) locked_[v] = true;
    }
  }

  void sum_quadrics() {
    quadrics_.resize(positions_.size());
    for (const auto& [a, b, c] : triangles_) {
      const Eigen::Vector3d cross = (positions_[b] - positions_[a]).cross(positions_[c] - positions_[a]);
      const double length = cross.norm();
      if (!(length > 0)) continue;
      const Eigen::Vector3d normal = cross / length;
      const double offset = -normal.dot(positions_[a]);
      for (const uint32_t v : {a, b, c}) quadrics_[v].add_plane(normal, offset, length);
    }
    stamp_.assign(twin_.size(), 0);
  }

  /// The quadric of both ends of an edge. Where it says little about a direction (flat places, straight creases) a
  /// small pull to the edge's middle decides, which also gives well-shaped triangles.
  Quadric edge_quadric(uint32_t half) const {
    constexpr double pull = 1e-3;
    Quadric q = quadrics_[from(half)];
    q += quadrics_[to(half)];
    q.pull_to(0.5 * (positions_[from(half)] + positions_[to(half)]),
              pull * q.trace() + std::numeric_limits<double>::min());
    return q;
  }

  /// The least error of a vertex that takes the place of both ends.
  static float cost(const Quadric& q, const Eigen::Vector3d& target) { return static_cast<float>(q.at(target)); }

  void queue(uint32_t half) {
    const uint32_t twin = twin_[half];
    if (twin == none || locked_[from(half)] || locked_[to(half)]) return;
    ++stamp_[half];
    ++stamp_[twin];
    const Quadric q = edge_quadric(half);
    queue_.push(EdgeQueue::bucket_of(cost(q, -Inverse(q).times(q.b))), {half, stamp_[half]});
  }

  void queue_all() {
    queue_ = {};
    for (uint32_t half = 0; half < twin_.size(); ++half)
      if (!dead(half) && half < twin_[half]) queue(half);
  }

  void collapse_until(size_t budget) {
    EdgeQueue::Entry entry{};
    size_t bucket = 0;
    constexpr size_t between_looks = 4096;  // edges between two looks at the stop token
    for (size_t pops = 0; alive_ > budget && queue_.pop(entry, bucket); ++pops) {
      if (pops % between_looks == 0 && work_.stopped()) return;
      if (dead(entry.half) || stamp_[entry.half] != entry.stamp) continue;
      // A collapse only raises the costs around it, so that they need not be known before their old value is up.
      const Quadric q = edge_quadric(entry.half);
      const Inverse inverse(q);
      Eigen::Vector3d target = -inverse.times(q.b);
      if (const size_t now = EdgeQueue::bucket_of(cost(q, target)); now > bucket) {
        queue_.push(now, entry);
        continue;
      }
      if (may_collapse(entry.half, inverse, target))
        collapse(entry.half, target);
      else if (bucket + EdgeQueue::fourfold < queue_.buckets())
        queue_.push(bucket + EdgeQueue::fourfold, entry);  // tried again when the mesh around it has changed
    }
  }

  /// Moves the target to where it keeps the volume, and says whether the surface stays a manifold and does not fold.
  bool may_collapse(uint32_t half, const Inverse& inverse, Eigen::Vector3d& target) {
    const uint32_t u = from(half), v = to(half), back = twin_[half];
    // Link condition (Dey et al.): the ends share no neighbour but the two that lie opposite the edge.
    ring_.clear();
    for_each_spoke(half, [&](uint32_t spoke) { ring_.push_back(to(spoke)); });
    const size_t degree_u = ring_.size();
    size_t degree_v = 0, shared = 0;
    for_each_spoke(back, [&](uint32_t spoke) {
      ++degree_v;
      shared += static_cast<size_t>(std::count(ring_.begin(), ring_.end(), to(spoke)));
    });
    if (shared != 2 || (degree_u == 3 && degree_v == 3)) return false;

    // The target keeps the enclosed volume (Lindstrom and Turk, 1998, section 4.2): Σ n·x = Σ n·p over the triangles.
    fan_.clear();
    Eigen::Vector3d gradient = Eigen::Vector3d::Zero();
    double volume = 0;
    const auto add = [&](uint32_t spoke) {
      const uint32_t triangle = spoke / 3;
      const auto& [a, b, c] = triangles_[triangle];
      const Eigen::Vector3d cross = (positions_[b] - positions_[a]).cross(positions_[c] - positions_[a]);
      gradient += cross;
      volume += cross.dot(positions_[a]);
      if (triangle != half / 3 && triangle != back / 3)
        fan_.push_back({cross, positions_[to(spoke)], positions_[from(previous(spoke))]});
    };
    for_each_spoke(half, add);
    for_each_spoke(back, [&](uint32_t spoke) {
      if (spoke / 3 != half / 3 && spoke / 3 != back / 3) add(spoke);
    });
    const Eigen::Vector3d way = inverse.times(gradient);
    const double per_way = gradient.dot(way);
    const Eigen::Vector3d correction = way * ((volume - gradient.dot(target)) / per_way);
    if (per_way > 0 && correction.squaredNorm() < (positions_[u] - positions_[v]).squaredNorm()) target += correction;

    for (const auto& [normal, p, r] : fan_) {
      const Eigen::Vector3d to_p = p - target, to_r = r - target;
      const Eigen::Vector3d turned = to_p.cross(to_r);
      const double area = turned.norm();
      const double longest2 = std::max({to_p.squaredNorm(), to_r.squaredNorm(), (p - r).squaredNorm()});
      if (!(area > guard_.thinnest * longest2) || turned.dot(normal) < guard_.least_cosine * area * normal.norm())
        return false;
    }
    return true;
  }

  /// Moves the edge's start to `target`, gives it all triangles of the end, and drops the edge's own two.
  void collapse(uint32_t half, const Eigen::Vector3d& target) {
    const uint32_t u = from(half), v = to(half), back = twin_[half];
    moved_.clear();
    for_each_spoke(back, [&](uint32_t spoke) { moved_.push_back(spoke); });
    for (const uint32_t spoke : moved_) triangles_[spoke / 3][spoke % 3] = u;
    std::array<uint32_t, 2> joined{};  // the two edges that each pair of edges beside the collapsed one became
    size_t count = 0;
    for (const uint32_t edge : {half, back}) {
      const uint32_t a = twin_[next(edge)], b = twin_[previous(edge)];
      twin_[a] = b;
      twin_[b] = a;
      triangles_[edge / 3] = {none, none, none};
      joined[count++] = a;
    }
    alive_ -= 2;
    positions_[u] = target;
    quadrics_[u] += quadrics_[v];
    for (const uint32_t edge : joined) queue(edge);
  }

  Mesh compact() const {
    Mesh mesh;
    std::vector<uint32_t> renamed(positions_.size(), none);
    for (const auto& triangle : triangles_)
      if (triangle[0] != none)
        for (const uint32_t v : triangle) renamed[v] = 0;
    for (size_t v = 0; v < positions_.size(); ++v) {
      if (renamed[v] == none) continue;
      renamed[v] = static_cast<uint32_t>(mesh.positions.size());
      mesh.positions.push_back(positions_[v].cast<float>());
    }
    for (const auto& [a, b, c] : triangles_)
      if (a != none) mesh.triangles.push_back({renamed[a], renamed[b], renamed[c]});
    return mesh;
  }

  struct Spanned {
    Eigen::Vector3d normal;  ///< twice the area long
    Eigen::Vector3d p, r;    ///< the two corners that stay, counter-clockwise
  };

  const Work& work_;
  std::vector<std::array<uint32_t, 3>> triangles_;
  std::vector<Eigen::Vector3d> positions_;
  std::vector<Quadric> quadrics_;
  std::vector<uint32_t> twin_;
  std::vector<uint32_t> stamp_;  ///< by half-edge: an entry of the queue with another stamp is out of date
  std::vector<bool> locked_;
  EdgeQueue queue_;
  size_t alive_ = 0;
  Guard guard_{};
  std::vector<uint32_t> ring_, moved_;
  std::vector<Spanned> fan_;
};

}  // namespace

Mesh decimate(const Mesh& mesh, const DecimationOptions& options, const Work& work) {
  if (mesh.triangles.size() <= options.triangles) return mesh;
  return Decimation(mesh, work).run(options.triangles);
}

}  // namespace booth
