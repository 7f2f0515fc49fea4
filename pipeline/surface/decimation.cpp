#include "pipeline/surface/decimation.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <bit>
#include <cstdint>
#include <limits>
#include <numeric>
#include <span>
#include <utility>
#include <vector>

namespace booth {
namespace {

constexpr uint32_t none = std::numeric_limits<uint32_t>::max();

// Half-edge 3 t + k of triangle t runs from its corner k to the next one.
constexpr uint32_t next(uint32_t half) { return half % 3 == 2 ? half - 2 : half + 1; }
constexpr uint32_t previous(uint32_t half) { return half % 3 == 0 ? half + 2 : half - 1; }

/// xᵀ A x + 2 bᵀ x + c: the sum of squared distances to planes, weighted by area (Garland and Heckbert, section 4).
/// x counts from the vertex that the quadric belongs to, so that single precision does.
struct Quadric {
  std::array<float, 6> a{};  ///< xx, xy, xz, yy, yz, zz
  Eigen::Vector3f b = Eigen::Vector3f::Zero();
  float c = 0;

  /// A plane through the origin.
  void add_plane(const Eigen::Vector3f& normal, float weight) {
    const Eigen::Vector3f weighted = weight * normal;
    a[0] += weighted.x() * normal.x();
    a[1] += weighted.x() * normal.y();
    a[2] += weighted.x() * normal.z();
    a[3] += weighted.y() * normal.y();
    a[4] += weighted.y() * normal.z();
    a[5] += weighted.z() * normal.z();
  }
  void add(const Quadric& other) {
    for (size_t i = 0; i < a.size(); ++i) a[i] += other.a[i];
    b += other.b;
    c += other.c;
  }
  float trace() const { return a[0] + a[3] + a[5]; }
  /// Adds weight · |x − center|².
  void pull_to(const Eigen::Vector3f& center, float weight) {
    a[0] += weight;
    a[3] += weight;
    a[5] += weight;
    b -= weight * center;
    c += weight * center.squaredNorm();
  }
  /// Lets x count from another point, given from the old one.
  void move_origin(const Eigen::Vector3f& to) {
    c = at(to);
    b += times(to);
  }
  Eigen::Vector3f times(const Eigen::Vector3f& x) const {
    return {a[0] * x.x() + a[1] * x.y() + a[2] * x.z(), a[1] * x.x() + a[3] * x.y() + a[4] * x.z(),
            a[2] * x.x() + a[4] * x.y() + a[5] * x.z()};
  }
  float at(const Eigen::Vector3f& x) const { return x.dot(times(x)) + 2 * b.dot(x) + c; }
};

/// A⁻¹ of a positive definite quadric by cofactors, in double precision: they cancel.
class Inverse {
 public:
  explicit Inverse(const Quadric& q) {
    std::array<double, 6> m;
    std::copy(q.a.begin(), q.a.end(), m.begin());
    const auto [xx, xy, xz, yy, yz, zz] = m;
    cofactors_ = {yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy,
                  xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy};
    const double determinant = xx * cofactors_[0] + xy * cofactors_[1] + xz * cofactors_[2];
    scale_ = determinant > 0 ? 1 / determinant : 0;
  }
  Eigen::Vector3f times(const Eigen::Vector3f& f) const {
    const Eigen::Vector3d v = f.cast<double>();
    const auto& m = cofactors_;
    const Eigen::Vector3d product(m[0] * v.x() + m[1] * v.y() + m[2] * v.z(),
                                  m[1] * v.x() + m[3] * v.y() + m[4] * v.z(),
                                  m[2] * v.x() + m[4] * v.y() + m[5] * v.z());
    return (scale_ * product).cast<float>();
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
    uint32_t half;
    uint16_t stamp;
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
    bucket = lowest();
    if (bucket == buckets_.size()) return false;
    entry = buckets_[bucket].entries[buckets_[bucket].taken++];
    return true;
  }
  /// The bucket of the entry of least cost; buckets() when there is none.
  size_t lowest() {
    while (lowest_ < buckets_.size() && buckets_[lowest_].taken == buckets_[lowest_].entries.size())
      buckets_[lowest_++] = {};
    return lowest_;
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
  /// @param detail  per vertex, or empty: triangles whose corners all have 1 are counted by themselves
  Decimation(const Mesh& mesh, std::span<const uint8_t> detail, const Work& work)
      : work_(work), triangles_(mesh.triangles.size()) {
    for (size_t t = 0; t < triangles_.size(); ++t) {
      const auto& corner = mesh.triangles[t];
      triangles_[t].corner = corner;
      const bool inside = !detail.empty() && detail[corner[0]] != 0 && detail[corner[1]] != 0 && detail[corner[2]] != 0;
      triangles_[t].region = inside ? 1 : 0;
      ++alive_[triangles_[t].region];
    }
    vertices_.reserve(mesh.positions.size());
    for (const Eigen::Vector3f& p : mesh.positions) vertices_.push_back({p, {}, false});
    find_twins();
    lock_unsafe_vertices();
    sum_quadrics();
  }

  /// In so many parts a mesh is thinned side by side, however many threads there are.
  static constexpr size_t slabs = 8;
  using Budget = std::array<size_t, 2>;  ///< of the triangles outside and inside the detail

  /// @param detail_share  of the budget; what the detail cannot use goes to the rest
  Mesh run(size_t total, double detail_share) {
    const size_t share = std::min(alive_[1], static_cast<size_t>(detail_share * static_cast<double>(total)));
    const Budget budget{total - share, share};
    guard_ = careful;
    thin(budget);
    // Where every collapse left is refused, what is asked of the triangles around it is lowered.
    for (const Guard& guard : {careful, Guard{-0.3F, 0.002F}, Guard{-1, 1e-5F}}) {
      guard_ = guard;
      while (alive_[0] > budget[0] || alive_[1] > budget[1]) {
        const Budget before = alive_;
        collapse_until(budget);
        if (work_.stopped() || alive_ == before) break;
      }
    }
    return compact();
  }

 private:
  /// What a collapse may do to the triangles that it moves.
  struct Guard {
    float least_cosine;  ///< between a triangle's normals before and after
    float thinnest;      ///< twice the area over the longest side squared: 0.87 for equal sides, 0 for a needle
  };
  struct Spanned {
    Eigen::Vector3f normal;  ///< twice the area long
    Eigen::Vector3f p, r;    ///< the two corners that stay, counter-clockwise
  };
  static constexpr Guard careful{0.3F, 0.02F};

  /// Who collapses edges: their queue, and what a collapse needs to remember.
  struct Collapser {
    EdgeQueue queue;
    const std::vector<uint8_t>* slab = nullptr;  ///< per vertex, see assign_slabs; null: may touch the whole mesh
    Budget gone{0, 0};                           ///< triangles that its collapses took away
    std::vector<uint32_t> ring, moved;
    std::vector<Spanned> fan;
  };

  // Collapses jump about in memory: what one needs of a vertex or a triangle is together, within a cache line.
  struct alignas(64) Vertex {
    Eigen::Vector3f position;
    Quadric quadric;
    bool locked;
  };
  struct alignas(32) Triangle {
    std::array<uint32_t, 3> corner;                  ///< {none, …} once it is gone
    std::array<uint32_t, 3> twin{none, none, none};  ///< of its half-edges
    std::array<uint16_t, 3> stamp{};  ///< of its half-edges: entries of the queue with another are out of date
    uint8_t region = 0;               ///< which budget it counts against
  };

  uint32_t from(uint32_t half) const { return triangles_[half / 3].corner[half % 3]; }
  uint32_t to(uint32_t half) const { return from(next(half)); }
  uint32_t twin(uint32_t half) const { return triangles_[half / 3].twin[half % 3]; }
  bool dead(uint32_t half) const { return triangles_[half / 3].corner[0] == none; }
  const Eigen::Vector3f& at(uint32_t vertex) const { return vertices_[vertex].position; }
  Eigen::Vector3f twice_area(const Triangle& t) const {
    return (at(t.corner[1]) - at(t.corner[0])).cross(at(t.corner[2]) - at(t.corner[0]));
  }

  /// Calls `visit` with every half-edge that leaves where `half` leaves from, `half` first.
  template <class Visitor>
  void for_each_spoke(uint32_t half, const Visitor& visit) const {
    uint32_t spoke = half;
    do {
      visit(spoke);
      spoke = twin(previous(spoke));
    } while (spoke != half && spoke != none);
  }

  /// Pairs the half-edges by a counting sort over their smaller vertex.
  void find_twins() {
    const auto halves = static_cast<uint32_t>(triangles_.size() * 3);
    std::vector<uint32_t> first(vertices_.size() + 1, 0);
    const auto low = [&](uint32_t half) { return std::min(from(half), to(half)); };
    const auto high = [&](uint32_t half) { return std::max(from(half), to(half)); };
    for (uint32_t half = 0; half < halves; ++half) ++first[low(half) + 1];
    std::partial_sum(first.begin(), first.end(), first.begin());
    std::vector<uint32_t> sorted(halves), filled(first.begin(), first.end() - 1);
    for (uint32_t half = 0; half < halves; ++half) sorted[filled[low(half)]++] = half;
    for (size_t v = 0; v < vertices_.size(); ++v) {
      const auto begin = sorted.begin() + first[v], end = sorted.begin() + first[v + 1];
      for (auto a = begin; a != end; ++a) {
        // An edge with other than two triangles, or with two that run the same way, keeps both its vertices.
        const auto same = [&](uint32_t half) { return high(half) == high(*a); };
        const auto count = std::count_if(begin, end, same);
        const auto b = std::find_if(begin, end, [&](uint32_t half) { return half != *a && same(half); });
        if (count == 2 && from(*a) != from(*b))
          triangles_[*a / 3].twin[*a % 3] = *b;
        else
          vertices_[v].locked = vertices_[high(*a)].locked = true;
      }
    }
  }

  /// A vertex whose triangles form more than one fan must stay: its spokes cannot all be visited.
  void lock_unsafe_vertices() {
    std::vector<uint32_t> corners(vertices_.size(), 0);
    std::vector<uint32_t> spoke(vertices_.size(), none);
    for (uint32_t half = 0; half < triangles_.size() * 3; ++half) {
      ++corners[from(half)];
      spoke[from(half)] = half;
    }
    for (size_t v = 0; v < vertices_.size(); ++v) {
      if (vertices_[v].locked || spoke[v] == none) continue;
      uint32_t visited = 0;
      for_each_spoke(spoke[v], [&](uint32_t) { ++visited; });
      if (visited != corners[v]) vertices_[v].locked = true;
    }
  }

  void sum_quadrics() {
    for (const Triangle& triangle : triangles_) {
      const Eigen::Vector3f cross = twice_area(triangle);
      const float length = cross.norm();
      if (!(length > 0)) continue;
      for (const uint32_t v : triangle.corner) vertices_[v].quadric.add_plane(cross / length, length);
    }
  }

  /// The quadric of both ends of an edge, from its start. Where it says little about a direction (flat places, straight
  /// creases) a small pull to the edge's middle decides, which also gives well-shaped triangles.
  Quadric edge_quadric(uint32_t half) const {
    constexpr float pull = 1e-3F;
    const Vertex& u = vertices_[from(half)];
    const Vertex& v = vertices_[to(half)];
    const Eigen::Vector3f way = v.position - u.position;
    Quadric q = v.quadric;
    q.move_origin(-way);
    q.add(u.quadric);
    q.pull_to(0.5F * way, pull * q.trace() + std::numeric_limits<float>::min());
    return q;
  }

  void queue(uint32_t half, Collapser& by) {
    const uint32_t other = twin(half), u = from(half), v = to(half);
    if (other == none || vertices_[u].locked || vertices_[v].locked) return;
    if (by.slab != nullptr && ((*by.slab)[u] == slabs || (*by.slab)[v] == slabs)) return;
    ++triangles_[other / 3].stamp[other % 3];
    const uint16_t stamp = ++triangles_[half / 3].stamp[half % 3];
    const Quadric q = edge_quadric(half);
    by.queue.push(EdgeQueue::bucket_of(q.at(-Inverse(q).times(q.b))), {half, stamp});
  }

  /// One of the slabs for each vertex, of about as many vertices along the longest side of the mesh; for one that has a
  /// neighbour in another, and may not be moved while these are at work, `slabs`.
  std::vector<uint8_t> assign_slabs() const {
    Eigen::AlignedBox3f box;
    for (const Vertex& vertex : vertices_) box.extend(vertex.position);
    Eigen::Index axis = 0;
    box.sizes().maxCoeff(&axis);
    std::vector<float> places;
    for (const Vertex& vertex : vertices_) places.push_back(vertex.position[axis]);
    std::array<float, slabs - 1> cuts{};
    for (size_t n = 0; n < cuts.size(); ++n) {
      const auto cut = places.begin() + static_cast<std::ptrdiff_t>((n + 1) * places.size() / slabs);
      std::nth_element(places.begin(), cut, places.end());
      cuts[n] = *cut;
    }
    std::vector<uint8_t> own, slab;
    for (const Vertex& vertex : vertices_)
      own.push_back(
          static_cast<uint8_t>(std::upper_bound(cuts.begin(), cuts.end(), vertex.position[axis]) - cuts.begin()));
    slab = own;
    for (const Triangle& triangle : triangles_) {
      const auto& [a, b, c] = triangle.corner;
      if (own[a] != own[b] || own[b] != own[c]) slab[a] = slab[b] = slab[c] = slabs;
    }
    return slab;
  }

  /// Takes away what costs least, in parallel: the slabs are thinned side by side, each where it touches nothing of
  /// another, all up to one cost, which is raised until so many triangles are left that the order among the last ones,
  /// and the seams between the slabs, are decided in the whole mesh.
  void thin(const Budget& budget) {
    constexpr size_t left_over_percent = 160;  // of the budget, besides the seams
    if (triangles_.size() * 100 < (budget[0] + budget[1]) * left_over_percent) return;
    const std::vector<uint8_t> slab = assign_slabs();
    Budget enough{budget[0] * left_over_percent / 100, budget[1] * left_over_percent / 100};
    for (const Triangle& triangle : triangles_)
      if (std::any_of(triangle.corner.begin(), triangle.corner.end(), [&](uint32_t v) { return slab[v] == slabs; }))
        ++enough[triangle.region];
    const auto spare = [&](size_t region) { return alive_[region] - std::min(alive_[region], enough[region]); };
    std::vector<Collapser> collapsers(slabs);
    std::array<std::vector<uint32_t>, slabs> edges;
    for (uint32_t half = 0; half < triangles_.size() * 3; ++half)
      if (const uint8_t own = slab[from(half)]; own != slabs && half < twin(half)) edges[own].push_back(half);
    work_.parallel_for(slabs, 1, [&](size_t begin, size_t end) {
      for (size_t n = begin; n < end; ++n) {
        collapsers[n].slab = &slab;
        for (const uint32_t half : edges[n]) queue(half, collapsers[n]);
      }
    });
    constexpr size_t stride = EdgeQueue::fourfold / 4;
    const size_t buckets = collapsers[0].queue.buckets();
    size_t bound = buckets;
    for (Collapser& collapser : collapsers) bound = std::min(bound, collapser.queue.lowest());
    while (bound < buckets && !work_.stopped()) {
      // So much each slab may take away, lest all together take too much where much costs the same.
      const Budget most{spare(0) / slabs, spare(1) / slabs};
      if (most[0] + most[1] == 0) return;
      bound += stride;
      work_.parallel_for(slabs, 1, [&](size_t begin, size_t end) {
        for (size_t n = begin; n < end; ++n) {
          Collapser& by = collapsers[n];
          const auto wanted = [&](uint32_t half) {
            const uint8_t region = triangles_[half / 3].region;
            return by.gone[region] < most[region];
          };
          collapse_while([&] { return by.queue.lowest() < bound; }, wanted, by);
        }
      });
      for (Collapser& collapser : collapsers) count_gone(collapser);
    }
  }

  void count_gone(Collapser& by) {
    for (size_t region = 0; region < alive_.size(); ++region) alive_[region] -= std::exchange(by.gone[region], 0);
  }

  void collapse_until(const Budget& budget) {
    Collapser all;
    for (uint32_t half = 0; half < triangles_.size() * 3; ++half)
      if (!dead(half) && half < twin(half)) queue(half, all);
    const auto is_over = [&](size_t region) { return alive_[region] - all.gone[region] > budget[region]; };
    collapse_while([&] { return is_over(0) || is_over(1); },
                   [&](uint32_t half) { return is_over(triangles_[half / 3].region); }, all);
    count_gone(all);
  }

  /// Collapses the edges of the queue, the cheapest first, while there is one and `goes_on()`.
  /// @param wanted  by half-edge: whether its triangle may go
  template <class GoesOn, class Wanted>
  void collapse_while(const GoesOn& goes_on, const Wanted& wanted, Collapser& by) {
    EdgeQueue::Entry entry{};
    size_t bucket = 0;
    constexpr size_t between_looks = 4096;  // edges between two looks at the stop token
    for (size_t pops = 0; goes_on() && by.queue.pop(entry, bucket); ++pops) {
      if (pops % between_looks == 0 && work_.stopped()) return;
      const uint32_t half = entry.half;
      if (dead(half) || triangles_[half / 3].stamp[half % 3] != entry.stamp) continue;
      if (!wanted(half) || !wanted(twin(half))) continue;  // its region has reached its budget
      // A collapse only raises the costs around it, so that they need not be known before their old value is up.
      const Quadric q = edge_quadric(half);
      const Inverse inverse(q);
      Eigen::Vector3f offset = -inverse.times(q.b);
      if (const size_t now = EdgeQueue::bucket_of(q.at(offset)); now > bucket) {
        by.queue.push(now, entry);
        continue;
      }
      if (may_collapse(half, inverse, offset, by))
        collapse(half, offset, by);
      else if (bucket + EdgeQueue::fourfold < by.queue.buckets())
        by.queue.push(bucket + EdgeQueue::fourfold, entry);  // tried again when the mesh around it has changed
    }
  }

  /// Moves the new vertex (its offset from the edge's start) to where it keeps the volume, and says whether the surface
  /// stays a manifold there and does not fold.
  bool may_collapse(uint32_t half, const Inverse& inverse, Eigen::Vector3f& offset, Collapser& by) const {
    const uint32_t u = from(half), v = to(half), back = twin(half);
    // Link condition (Dey et al.): the ends share no neighbour but the two that lie opposite the edge.
    by.ring.clear();
    for_each_spoke(half, [&](uint32_t spoke) { by.ring.push_back(to(spoke)); });
    const size_t degree_u = by.ring.size();
    size_t degree_v = 0;
    std::ptrdiff_t shared = 0;
    for_each_spoke(back, [&](uint32_t spoke) {
      ++degree_v;
      shared += std::count(by.ring.begin(), by.ring.end(), to(spoke));
    });
    if (shared != 2 || (degree_u == 3 && degree_v == 3)) return false;

    // The target keeps the enclosed volume (Lindstrom and Turk, 1998, section 4.2): Σ n·x = Σ n·p over the triangles.
    // All points count from u, where the triangles of u have no volume of their own.
    const Eigen::Vector3f& origin = at(u);
    const Eigen::Vector3f way = at(v) - origin;
    by.fan.clear();
    Eigen::Vector3f gradient = Eigen::Vector3f::Zero();
    float volume = 0;
    for_each_spoke(half, [&](uint32_t spoke) {
      const Eigen::Vector3f p = at(to(spoke)) - origin, r = at(from(previous(spoke))) - origin;
      const Eigen::Vector3f normal = p.cross(r);
      gradient += normal;
      if (spoke != half && spoke / 3 != back / 3) by.fan.push_back({normal, p, r});
    });
    for_each_spoke(back, [&](uint32_t spoke) {
      if (spoke == back || spoke / 3 == half / 3) return;
      const Eigen::Vector3f p = at(to(spoke)) - origin, r = at(from(previous(spoke))) - origin;
      const Eigen::Vector3f normal = (p - way).cross(r - way);
      gradient += normal;
      volume += normal.dot(way);
      by.fan.push_back({normal, p, r});
    });
    const Eigen::Vector3f steepest = inverse.times(gradient);
    const float per_step = gradient.dot(steepest);
    const Eigen::Vector3f correction = steepest * ((volume - gradient.dot(offset)) / per_step);
    if (per_step > 0 && correction.squaredNorm() < way.squaredNorm()) offset += correction;

    for (const auto& [normal, p, r] : by.fan) {
      const Eigen::Vector3f to_p = p - offset, to_r = r - offset;
      const Eigen::Vector3f turned = to_p.cross(to_r);
      const float area = turned.norm();
      const float longest2 = std::max({to_p.squaredNorm(), to_r.squaredNorm(), (p - r).squaredNorm()});
      if (!(area > guard_.thinnest * longest2) || turned.dot(normal) < guard_.least_cosine * area * normal.norm())
        return false;
    }
    return true;
  }

  /// Moves the edge's start by `offset`, gives it all triangles of the end, and drops the edge's own two.
  void collapse(uint32_t half, const Eigen::Vector3f& offset, Collapser& by) {
    const uint32_t u = from(half), v = to(half), back = twin(half);
    by.moved.clear();
    for_each_spoke(back, [&](uint32_t spoke) { by.moved.push_back(spoke); });
    for (const uint32_t spoke : by.moved) triangles_[spoke / 3].corner[spoke % 3] = u;
    std::array<uint32_t, 2> joined{};  // of the two edges that become one, on each side
    size_t count = 0;
    for (const uint32_t edge : {half, back}) {
      const uint32_t a = twin(next(edge)), b = twin(previous(edge));
      triangles_[a / 3].twin[a % 3] = b;
      triangles_[b / 3].twin[b % 3] = a;
      triangles_[edge / 3].corner = {none, none, none};
      ++by.gone[triangles_[edge / 3].region];
      joined[count++] = a;
    }
    Quadric q = vertices_[v].quadric;
    q.move_origin(vertices_[u].position - vertices_[v].position);
    q.add(vertices_[u].quadric);
    q.move_origin(offset);
    vertices_[u].quadric = q;
    vertices_[u].position += offset;
    for (const uint32_t edge : joined) queue(edge, by);
  }

  Mesh compact() const {
    Mesh mesh;
    std::vector<uint32_t> renamed(vertices_.size(), none);
    for (const Triangle& triangle : triangles_)
      if (triangle.corner[0] != none)
        for (const uint32_t v : triangle.corner) renamed[v] = 0;
    for (uint32_t v = 0; v < vertices_.size(); ++v) {
      if (renamed[v] == none) continue;
      renamed[v] = static_cast<uint32_t>(mesh.positions.size());
      mesh.positions.push_back(at(v));
    }
    for (const Triangle& triangle : triangles_)
      if (const auto& [a, b, c] = triangle.corner; a != none)
        mesh.triangles.push_back({renamed[a], renamed[b], renamed[c]});
    return mesh;
  }

  const Work& work_;
  std::vector<Triangle> triangles_;
  std::vector<Vertex> vertices_;
  Budget alive_{0, 0};
  Guard guard_{};
};

}  // namespace

Mesh decimate(const Mesh& mesh, const DecimationOptions& options, const Work& work) {
  if (mesh.triangles.size() <= options.triangles) return mesh;
  return Decimation(mesh, {}, work).run(options.triangles, 0);
}

Mesh decimate(const Mesh& mesh, std::span<const uint8_t> detail, double detail_share, const DecimationOptions& options,
              const Work& work) {
  if (mesh.triangles.size() <= options.triangles) return mesh;
  return Decimation(mesh, detail, work).run(options.triangles, detail_share);
}

}  // namespace booth
