#include "pipeline/face/face_merge.h"

#include <Eigen/Geometry>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <optional>
#include <queue>
#include <utility>

#include "pipeline/face/ray_caster.h"
#include "pipeline/face/subdivision.h"

namespace booth {
namespace {

constexpr float infinite = std::numeric_limits<float>::infinity();
constexpr size_t vertex_grain = 512;

/// Each vertex's neighbours, ascending.
class Adjacency {
 public:
  explicit Adjacency(const Mesh& mesh) : first_(mesh.positions.size() + 1, 0) {
    for (const auto& t : mesh.triangles)
      for (const uint32_t v : t) ++first_[v + 1];
    for (size_t v = 0; v + 1 < first_.size(); ++v) first_[v + 1] += first_[v];
    neighbours_.resize(mesh.triangles.size() * 3);
    std::vector<uint32_t> filled(first_.begin(), first_.end() - 1);
    // On a closed mesh every neighbour follows exactly once.
    for (const auto& t : mesh.triangles)
      for (size_t k = 0; k < 3; ++k) neighbours_[filled[t[k]]++] = t[(k + 1) % 3];
    for (size_t v = 0; v + 1 < first_.size(); ++v)
      std::sort(neighbours_.begin() + first_[v], neighbours_.begin() + first_[v + 1]);
  }
  std::span<const uint32_t> of(size_t v) const {
    return {neighbours_.data() + first_[v], neighbours_.data() + first_[v + 1]};
  }

 private:
  std::vector<uint32_t> first_, neighbours_;
};

using PathEnd = std::pair<float, uint32_t>;  ///< length so far, vertex

/// Lengths of the shortest paths over vertices from `sources`, up to `farthest`; infinite beyond.
std::vector<float> path_lengths(const Mesh& mesh, const Adjacency& adjacency, const std::vector<PathEnd>& sources,
                                float farthest) {
  std::vector<float> length(mesh.positions.size(), infinite);
  std::priority_queue<PathEnd, std::vector<PathEnd>, std::greater<>> queue;
  for (const auto& [start, v] : sources) {
    length[v] = std::min(length[v], start);
    queue.emplace(start, v);
  }
  while (!queue.empty()) {
    const auto [so_far, v] = queue.top();
    queue.pop();
    if (so_far > length[v]) continue;
    for (const uint32_t n : adjacency.of(v)) {
      const float there = so_far + (mesh.positions[n] - mesh.positions[v]).norm();
      if (there > farthest || there >= length[n]) continue;
      length[n] = there;
      queue.emplace(there, n);
    }
  }
  return length;
}

/// How far vertices go along their rays; NaN where the scan says nothing.
class SightRays {
 public:
  SightRays(const Mesh& hull, const HeadRegion& head, const ScanMesh& scan, const Eigen::Vector3f& eye,
            const FaceMergeOptions& options)
      : hull_(hull), scan_(scan), head_(head), eye_(eye), hull_rays_(hull), scan_rays_(scan.mesh), options_(options) {}

  Eigen::Vector3f direction(const Eigen::Vector3f& p) const { return (p - eye_).normalized(); }

  float displacement(const Eigen::Vector3f& p, const Eigen::Vector3f& normal) const {
    constexpr float nothing = std::numeric_limits<float>::quiet_NaN();
    if (p.y() < head_.lowest_face_y()) return nothing;
    const Eigen::Vector3f way = direction(p);
    constexpr float least_cosine = 0.15F;
    if (-normal.dot(way) < least_cosine) return nothing;
    const float distance = (p - eye_).norm();
    constexpr float slack_m = 0.003F;
    if (hull_rays_.cast(eye_, way, 0, distance - slack_m)) return nothing;
    const float reach = static_cast<float>(options_.most_move_m);
    const auto hit = scan_rays_.cast(eye_, way, distance - reach, distance + reach);
    if (!hit) return nothing;
    constexpr float least_confidence = 0.15F;
    for (const uint32_t v : scan_.mesh.triangles[hit->triangle])
      if (scan_.confidence[v] < least_confidence) return nothing;
    return hit->distance_m - distance;
  }

 private:
  const Mesh& hull_;
  const ScanMesh& scan_;
  const HeadRegion& head_;
  Eigen::Vector3f eye_;
  RayCaster hull_rays_, scan_rays_;
  const FaceMergeOptions& options_;
};

/// Displacements where none was measured: those that continue the others with least bending (the Laplacian's square
/// over the surface is least), 0 where `fixed`. Bending alone overshoots across wide gaps; some tension holds it.
/// @param moved   measured displacements, NaN where free or fixed at 0
/// @param free    per vertex
void continue_smoothly(const Mesh& mesh, const Adjacency& adjacency, const std::vector<uint8_t>& free, float tension_m,
                       std::vector<float>* moved) {
  std::vector<int> unknown(mesh.positions.size(), -1);
  int unknowns = 0;
  for (size_t v = 0; v < free.size(); ++v)
    if (free[v] != 0) unknown[v] = unknowns++;
  if (unknowns == 0) return;
  const auto value = [&](size_t v) { return std::isnan((*moved)[v]) ? 0.0 : static_cast<double>((*moved)[v]); };

  // Rows: the Laplacian at every vertex that has a free one among itself and its neighbours, and the free edges'
  // differences; least squares of both.
  using Triplets = std::vector<Eigen::Triplet<double>>;
  Triplets triplets;
  std::vector<double> right;
  for (size_t v = 0; v < free.size(); ++v) {
    const auto around = adjacency.of(v);
    const bool concerned =
        free[v] != 0 || std::any_of(around.begin(), around.end(), [&](uint32_t n) { return free[n] != 0; });
    if (!concerned || around.empty()) continue;
    double weights = 0, square = 0;
    for (const uint32_t n : around) {
      const double length = std::max(1e-6, static_cast<double>((mesh.positions[n] - mesh.positions[v]).norm()));
      weights += 1 / length;
      square += length * length;
    }
    square /= static_cast<double>(around.size());
    // Square root of the vertex's area over the squared edge: the row's square is the integral of the Laplacian's.
    const double scale = std::sqrt(square) / square;
    const int row = static_cast<int>(right.size());
    right.push_back(0);
    const auto put = [&](size_t at, double weight) {
      if (unknown[at] >= 0)
        triplets.emplace_back(row, unknown[at], weight);
      else
        right.back() -= weight * value(at);
    };
    put(v, scale);
    for (const uint32_t n : around) {
      const double length = std::max(1e-6, static_cast<double>((mesh.positions[n] - mesh.positions[v]).norm()));
      put(n, -scale / length / weights);
    }
    if (free[v] == 0) continue;
    for (const uint32_t n : around) {
      if (free[n] != 0 && n < v) continue;
      const int edge_row = static_cast<int>(right.size());
      right.push_back(0);
      const double weight = 1.0 / static_cast<double>(tension_m);
      for (const auto& [at, sign] : {std::pair<size_t, double>{v, 1.0}, {n, -1.0}}) {
        if (unknown[at] >= 0)
          triplets.emplace_back(edge_row, unknown[at], sign * weight);
        else
          right.back() -= sign * weight * value(at);
      }
    }
  }
  Eigen::SparseMatrix<double> system(static_cast<Eigen::Index>(right.size()), unknowns);
  system.setFromTriplets(triplets.begin(), triplets.end());
  const Eigen::SparseMatrix<double> normal = system.transpose() * system;
  const Eigen::VectorXd load =
      system.transpose() * Eigen::Map<const Eigen::VectorXd>(right.data(), static_cast<Eigen::Index>(right.size()));
  const Eigen::VectorXd solution = Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>(normal).solve(load);
  for (size_t v = 0; v < free.size(); ++v)
    if (unknown[v] >= 0) (*moved)[v] = static_cast<float>(solution[unknown[v]]);
}

struct Displacements {
  Mesh mesh;                 ///< the hull, subdivided where it moves
  std::vector<float> moved;  ///< metres along the rays, NaN where the scan says nothing
};

/// Casts, subdivides where the scan was met, and casts again for the new vertices.
Displacements cast_and_subdivide(const Mesh& hull, const SightRays& rays, const FaceMergeOptions& options,
                                 const Work& work) {
  Displacements d{hull, std::vector<float>(hull.positions.size(), std::numeric_limits<float>::quiet_NaN())};
  size_t known = 0;
  for (int level = 0;; ++level) {
    const std::vector<Eigen::Vector3f> normals = vertex_normals(d.mesh);
    d.moved.resize(d.mesh.positions.size());
    work.parallel_for(d.mesh.positions.size() - known, vertex_grain, [&](size_t begin, size_t end) {
      for (size_t v = known + begin; v < known + end && !work.stopped(); ++v)
        d.moved[v] = rays.displacement(d.mesh.positions[v], normals[v]);
    });
    known = d.mesh.positions.size();
    if (level == options.subdivisions || work.stopped()) return d;
    std::vector<uint8_t> marked(d.mesh.triangles.size(), 0);
    for (size_t t = 0; t < marked.size(); ++t)
      for (const uint32_t v : d.mesh.triangles[t])
        if (!std::isnan(d.moved[v])) marked[t] = 1;
    d.mesh = subdivide(d.mesh, marked, SubdivisionRule::midpoint).mesh;
  }
}

/// Where the scan leaps (from hair to forehead, from the jaw to the neck behind it) the mesh would hang a curtain along
/// the rays, which later stages fold. No displacement may exceed another's by more than a slope times their distance:
/// what is deeper rises to that slope, the least change that keeps inside what the hull allows.
void limit_slope(const Mesh& mesh, const Adjacency& adjacency, const std::vector<uint8_t>& face,
                 std::vector<float>* moved) {
  constexpr float steepest = 1.5F;
  std::vector<PathEnd> starts;
  for (uint32_t v = 0; v < face.size(); ++v)
    if (face[v] != 0) starts.emplace_back((*moved)[v] / steepest, v);
  const std::vector<float> lowest = path_lengths(mesh, adjacency, starts, infinite);
  for (size_t v = 0; v < face.size(); ++v)
    if (face[v] != 0) (*moved)[v] = std::min((*moved)[v], steepest * lowest[v]);
}

/// How much the surface is smoothed where it goes over from the scan to the hull, 0 … 1 per vertex: all of it that was
/// not measured and hangs together with the hull around (holes in the face do not), fading over the scan's rim, where
/// grazing sight leaves lace.
/// @param measured  1 where a vertex met the scan
/// @param face      1 where it moved
std::vector<float> seam_weights(const Mesh& mesh, const Adjacency& adjacency, const std::vector<uint8_t>& measured,
                                const std::vector<uint8_t>& face) {
  constexpr float rim_m = 0.006F;
  std::vector<float> across(mesh.positions.size(), infinite);  // length over the scan on the way from the hull
  std::priority_queue<PathEnd, std::vector<PathEnd>, std::greater<>> queue;
  for (uint32_t v = 0; v < face.size(); ++v)
    if (face[v] == 0) {
      across[v] = 0;
      queue.emplace(0.0F, v);
    }
  while (!queue.empty()) {
    const auto [so_far, v] = queue.top();
    queue.pop();
    if (so_far > across[v]) continue;
    for (const uint32_t n : adjacency.of(v)) {
      const float there = so_far + (measured[n] != 0 ? (mesh.positions[n] - mesh.positions[v]).norm() : 0.0F);
      if (there > rim_m || there >= across[n]) continue;
      across[n] = there;
      queue.emplace(there, n);
    }
  }
  std::vector<float> weight(across.size(), 0);
  for (size_t v = 0; v < weight.size(); ++v)
    if (face[v] != 0 && across[v] < infinite) weight[v] = 1 - across[v] / rim_m;
  return weight;
}

/// Smooths without shrinking where weights say so.
/// Source: G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995.
void smooth_seam(const Adjacency& adjacency, const std::vector<float>& weight, const Work& work, Mesh* mesh) {
  constexpr int rounds = 80;  // smooths away waves of up to a centimetre where edges are a millimetre long
  constexpr float inwards = 0.5F, outwards = -0.52F;
  std::vector<uint32_t> seam;
  for (uint32_t v = 0; v < weight.size(); ++v)
    if (weight[v] > 0) seam.push_back(v);
  std::vector<Eigen::Vector3f> moved(seam.size());
  for (int step = 0; step < 2 * rounds && !work.stopped(); ++step) {
    const float factor = step % 2 == 0 ? inwards : outwards;
    work.parallel_for(seam.size(), vertex_grain, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        const Eigen::Vector3f& p = mesh->positions[seam[i]];
        Eigen::Vector3f sum = Eigen::Vector3f::Zero();
        float weights = 0;
        for (const uint32_t n : adjacency.of(seam[i])) {
          constexpr float least_m = 1e-5F;
          const float w = 1 / std::max((mesh->positions[n] - p).norm(), least_m);
          sum += w * (mesh->positions[n] - p);
          weights += w;
        }
        moved[i] = weights > 0 ? Eigen::Vector3f(p + factor * weight[seam[i]] / weights * sum) : p;
      }
    });
    for (size_t i = 0; i < seam.size(); ++i) mesh->positions[seam[i]] = moved[i];
  }
}

template <class Predicate>
double area_where(const Mesh& mesh, const Predicate& of_vertex) {
  double area = 0;
  for (const auto& [a, b, c] : mesh.triangles)
    if (of_vertex(a) && of_vertex(b) && of_vertex(c))
      area += 0.5 * static_cast<double>(
                        (mesh.positions[b] - mesh.positions[a]).cross(mesh.positions[c] - mesh.positions[a]).norm());
  return area;
}

Result<FaceMerge> merge_by_sight(const Mesh& hull, const HeadRegion& head, const ScanMesh& scan,
                                 const Eigen::Vector3f& eye, const FaceMergeOptions& options, const Work& work) {
  const SightRays rays(hull, head, scan, eye, options);
  Displacements d = cast_and_subdivide(hull, rays, options, work);
  if (work.stopped()) return Work::cancelled();

  const Adjacency adjacency(d.mesh);
  std::vector<PathEnd> met;
  for (uint32_t v = 0; v < d.moved.size(); ++v)
    if (!std::isnan(d.moved[v])) met.emplace_back(0.0F, v);
  if (met.empty()) return Error{ErrorCode::no_subject, "the scan does not meet the head"};
  const float bridge = static_cast<float>(options.bridge) * head.height();
  const std::vector<float> away = path_lengths(d.mesh, adjacency, met, bridge);
  FaceMerge out;
  out.face.assign(d.moved.size(), 0);
  std::vector<uint8_t> free(d.moved.size(), 0);
  for (size_t v = 0; v < free.size(); ++v) {
    out.face[v] = away[v] < infinite ? 1 : 0;
    free[v] = away[v] < infinite && std::isnan(d.moved[v]) ? 1 : 0;
  }
  continue_smoothly(d.mesh, adjacency, free, 0.5F * bridge, &d.moved);
  limit_slope(d.mesh, adjacency, out.face, &d.moved);
  for (size_t v = 0; v < free.size(); ++v)
    if (!std::isnan(d.moved[v])) d.mesh.positions[v] += d.moved[v] * rays.direction(d.mesh.positions[v]);
  out.moved_m2 = area_where(d.mesh, [&](uint32_t v) { return away[v] == 0; });
  std::vector<uint8_t> measured(free.size());
  for (size_t v = 0; v < free.size(); ++v) measured[v] = away[v] == 0 ? 1 : 0;
  smooth_seam(adjacency, seam_weights(d.mesh, adjacency, measured, out.face), work, &d.mesh);
  out.mesh = std::move(d.mesh);
  return out;
}

/// Where the ray from the head's barycentre through each vertex meets the scan; NaN where it does not, or too far away.
std::vector<Eigen::Vector3f> radial_targets(const Mesh& mesh, const HeadRegion& head, const ScanMesh& scan,
                                            const RayCaster& rays, const Work& work) {
  constexpr float beyond_m = 0.5F, most_move_m = 0.04F;
  std::vector<Eigen::Vector3f> targets(mesh.positions.size(),
                                       Eigen::Vector3f::Constant(std::numeric_limits<float>::quiet_NaN()));
  work.parallel_for(targets.size(), vertex_grain, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end && !work.stopped(); ++v) {
      const Eigen::Vector3f& p = mesh.positions[v];
      const Eigen::Vector3f out = p - head.barycentre;
      if (p.y() < head.lowest_face_y() || out.norm() > beyond_m) continue;
      const Eigen::Vector3f start = head.barycentre + beyond_m * out.normalized();  // from outside: the outermost first
      const auto hit = rays.cast(start, -out.normalized(), 0, beyond_m);
      if (!hit) continue;
      const auto& corner = scan.mesh.triangles[hit->triangle];
      if (std::min({scan.confidence[corner[0]], scan.confidence[corner[1]], scan.confidence[corner[2]]}) <= 0) continue;
      const Eigen::Vector3f target = start - hit->distance_m * out.normalized();
      if ((target - p).norm() < most_move_m) targets[v] = target;
    }
  });
  return targets;
}

Result<FaceMerge> merge_radially(const Mesh& hull, const HeadRegion& head, const ScanMesh& scan,
                                 const FaceMergeOptions& options, const Work& work) {
  const RayCaster rays(scan.mesh);
  Mesh mesh = hull;
  std::vector<Eigen::Vector3f> moved = radial_targets(mesh, head, scan, rays, work);
  const auto is_moved = [&](uint32_t v) { return !std::isnan(moved[v].x()); };
  for (int level = 0; level < options.subdivisions && !work.stopped(); ++level) {
    std::vector<uint8_t> marked(mesh.triangles.size(), 0);
    for (size_t t = 0; t < marked.size(); ++t)
      marked[t] = std::any_of(mesh.triangles[t].begin(), mesh.triangles[t].end(), is_moved) ? 1 : 0;
    mesh = subdivide(mesh, marked, SubdivisionRule::butterfly).mesh;
    moved = radial_targets(mesh, head, scan, rays, work);
  }
  if (work.stopped()) return Work::cancelled();

  const Adjacency adjacency(mesh);
  std::vector<PathEnd> border_moved, border_stuck;  // vertices of either kind next to the other
  for (uint32_t v = 0; v < moved.size(); ++v) {
    const auto around = adjacency.of(v);
    const bool mixed =
        std::any_of(around.begin(), around.end(), [&](uint32_t n) { return is_moved(n) != is_moved(v); });
    if (mixed) (is_moved(v) ? border_moved : border_stuck).emplace_back(0.0F, v);
  }
  if (border_moved.empty()) return Error{ErrorCode::no_subject, "the scan does not meet the head"};
  const float half = 0.5F * static_cast<float>(options.bridge) * head.height();
  const std::vector<float> from_moved = path_lengths(mesh, adjacency, border_moved, half);
  const std::vector<float> from_stuck = path_lengths(mesh, adjacency, border_stuck, half);

  std::vector<uint8_t> scanned(moved.size());
  for (uint32_t v = 0; v < moved.size(); ++v) scanned[v] = is_moved(v) ? 1 : 0;
  // Stuck vertices of the bridge would have moved as their neighbours nearer to the moved shore did.
  std::vector<uint32_t> outwards;
  for (uint32_t v = 0; v < moved.size(); ++v)
    if (!is_moved(v) && from_moved[v] < infinite) outwards.push_back(v);
  std::stable_sort(outwards.begin(), outwards.end(),
                   [&](uint32_t a, uint32_t b) { return from_moved[a] < from_moved[b]; });
  for (const uint32_t v : outwards) {
    Eigen::Vector3f sum = Eigen::Vector3f::Zero();
    float count = 0;
    for (const uint32_t n : adjacency.of(v))
      if (is_moved(n) && from_moved[n] <= from_moved[v]) {
        sum += moved[n] - mesh.positions[n];
        ++count;
      }
    if (count > 0) moved[v] = mesh.positions[v] + sum / count;
  }

  FaceMerge out;
  out.face.assign(moved.size(), 0);
  std::vector<Eigen::Vector3f> positions = mesh.positions;
  for (uint32_t v = 0; v < moved.size(); ++v) {
    if (!is_moved(v)) continue;
    out.face[v] = 1;
    // The shores lie half a bridge to each side of where the scan ends.
    const float d_m = scanned[v] != 0 ? half - std::min(from_stuck[v], half) : half + from_moved[v];
    const float d_s = 2 * half - d_m;
    positions[v] = (d_s * moved[v] + d_m * mesh.positions[v]) / (d_m + d_s);
  }
  mesh.positions = std::move(positions);
  out.moved_m2 = area_where(mesh, [&](uint32_t v) { return scanned[v] != 0; });
  out.mesh = std::move(mesh);
  return out;
}

/// The triangles above a height with their vertices, apart from the rest of a mesh.
struct UpperPart {
  Mesh mesh;
  std::vector<uint32_t> vertex_of;             ///< in the whole mesh, of the part's vertices
  std::vector<std::array<uint32_t, 3>> below;  ///< the other triangles, of the whole mesh's vertices
};
UpperPart part_above(const Mesh& whole, float y) {
  constexpr uint32_t none = std::numeric_limits<uint32_t>::max();
  UpperPart part;
  std::vector<uint32_t> renamed(whole.positions.size(), none);
  const auto rename = [&](uint32_t v) {
    if (renamed[v] == none) {
      renamed[v] = static_cast<uint32_t>(part.vertex_of.size());
      part.vertex_of.push_back(v);
      part.mesh.positions.push_back(whole.positions[v]);
    }
    return renamed[v];
  };
  for (const auto& triangle : whole.triangles) {
    const auto& [a, b, c] = triangle;
    if (std::max({whole.positions[a].y(), whole.positions[b].y(), whole.positions[c].y()}) > y)
      part.mesh.triangles.push_back({rename(a), rename(b), rename(c)});
    else
      part.below.push_back(triangle);
  }
  return part;
}

/// Puts a part that was split and moved back into the whole mesh: its first vertices are those that it had.
FaceMerge put_back(const Mesh& whole, const UpperPart& part, FaceMerge merged) {
  FaceMerge out;
  out.moved_m2 = merged.moved_m2;
  out.mesh.positions = whole.positions;
  out.face.assign(whole.positions.size(), 0);
  std::vector<uint32_t> vertex_of = part.vertex_of;
  for (size_t v = 0; v < merged.mesh.positions.size(); ++v)
    if (v < part.vertex_of.size()) {
      out.mesh.positions[vertex_of[v]] = merged.mesh.positions[v];
      out.face[vertex_of[v]] = merged.face[v];
    } else {
      vertex_of.push_back(static_cast<uint32_t>(out.mesh.positions.size()));
      out.mesh.positions.push_back(merged.mesh.positions[v]);
      out.face.push_back(merged.face[v]);
    }
  out.mesh.triangles = part.below;
  for (const auto& [a, b, c] : merged.mesh.triangles)
    out.mesh.triangles.push_back({vertex_of[a], vertex_of[b], vertex_of[c]});
  return out;
}

}  // namespace

Result<FaceMerge> merge_face(const Mesh& hull, const HeadRegion& head, const ScanMesh& scan, const Eigen::Vector3f& eye,
                             const FaceMergeOptions& options, const Work& work) {
  if (scan.mesh.triangles.empty()) return Error{ErrorCode::no_subject, "the scan is empty"};
  // Nothing moves below the bridge under the lowest height of a face; a little more keeps its neighbours' neighbours.
  constexpr float margin_m = 0.02F;
  const float bridge = static_cast<float>(options.bridge) * head.height();
  const UpperPart part = part_above(hull, head.lowest_face_y() - bridge - margin_m);
  auto merged = options.method == FaceMergeMethod::radial ? merge_radially(part.mesh, head, scan, options, work)
                                                          : merge_by_sight(part.mesh, head, scan, eye, options, work);
  if (!merged) return merged.error();
  return put_back(hull, part, *std::move(merged));
}

}  // namespace booth
