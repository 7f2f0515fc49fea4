#include "pipeline/face/external_scan.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <optional>
#include <string>
#include <unordered_map>
#include <vector>

#include "pipeline/face/ray_caster.h"

namespace booth {
namespace {

std::string millimetres(double metres) { return std::to_string(std::lround(1000 * metres)) + " mm"; }

/// Surface points with normals, found by their place.
class NearestPoints {
 public:
  NearestPoints(const Mesh& mesh, float lowest_y) {
    const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
    for (size_t v = 0; v < mesh.positions.size(); ++v) {
      if (mesh.positions[v].y() < lowest_y || normals[v].isZero()) continue;
      cells_[key(cell_of(mesh.positions[v]))].push_back(points_.size());
      points_.push_back({mesh.positions[v].cast<double>(), normals[v].cast<double>()});
    }
  }
  struct Point {
    Eigen::Vector3d position, normal;
  };
  bool empty() const { return points_.empty(); }
  /// The nearest within about 6 cm, or nullptr.
  const Point* nearest(const Eigen::Vector3d& p) const {
    const Eigen::Vector3i center = cell_of(p.cast<float>());
    const Point* best = nullptr;
    double least = std::numeric_limits<double>::infinity();
    constexpr int farthest_ring = 6;
    for (int ring = 0; ring <= farthest_ring; ++ring) {
      for (int z = -ring; z <= ring; ++z)
        for (int y = -ring; y <= ring; ++y)
          for (int x = -ring; x <= ring; ++x) {
            if (std::max({std::abs(x), std::abs(y), std::abs(z)}) != ring) continue;
            const auto cell = cells_.find(key(center + Eigen::Vector3i(x, y, z)));
            if (cell == cells_.end()) continue;
            for (const size_t i : cell->second) {
              const double d2 = (points_[i].position - p).squaredNorm();
              if (d2 < least) {
                least = d2;
                best = &points_[i];
              }
            }
          }
      if (best != nullptr && least <= ring * ring * static_cast<double>(cell_m * cell_m)) break;
    }
    return best;
  }

 private:
  static constexpr float cell_m = 0.01F;
  static Eigen::Vector3i cell_of(const Eigen::Vector3f& p) { return (p / cell_m).array().floor().matrix().cast<int>(); }
  static uint64_t key(const Eigen::Vector3i& cell) {
    constexpr int bits = 21;
    constexpr uint64_t mask = (uint64_t{1} << bits) - 1;
    return (static_cast<uint64_t>(cell.x()) & mask) << (2 * bits) | (static_cast<uint64_t>(cell.y()) & mask) << bits |
           (static_cast<uint64_t>(cell.z()) & mask);
  }
  std::vector<Point> points_;
  std::unordered_map<uint64_t, std::vector<size_t>> cells_;
};

struct Fit {
  Eigen::Isometry3d world_from_scan = Eigen::Isometry3d::Identity();
  double misfit_m = std::numeric_limits<double>::infinity();
};

/// Of the pairs, the nearer ones are used: hair, neck and a hull's bulk are another surface.
constexpr double used_share = 0.7;

/// Iterations of point to plane over `used_share` of the points; 0 iterations measure the misfit alone.
Fit align(const std::vector<Eigen::Vector3d>& points, const NearestPoints& surface, const Eigen::Isometry3d& start,
          int iterations) {
  Fit fit;
  fit.world_from_scan = start;
  struct Pair {
    double distance2;
    Eigen::Vector3d at, normal;
    double off;
  };
  std::vector<Pair> pairs;
  for (int i = 0;; ++i) {
    pairs.clear();
    for (const Eigen::Vector3d& point : points) {
      const Eigen::Vector3d p = fit.world_from_scan * point;
      const NearestPoints::Point* near = surface.nearest(p);
      if (near == nullptr) continue;
      pairs.push_back({(near->position - p).squaredNorm(), p, near->normal, near->normal.dot(near->position - p)});
    }
    const size_t used = static_cast<size_t>(used_share * static_cast<double>(points.size()));
    if (pairs.size() < used || used < 6) return {};
    std::sort(pairs.begin(), pairs.end(), [](const Pair& a, const Pair& b) { return a.distance2 < b.distance2; });
    double sum = 0;
    for (size_t k = 0; k < used; ++k) sum += pairs[k].off * pairs[k].off;
    fit.misfit_m = std::sqrt(sum / static_cast<double>(used));
    if (i == iterations) return fit;
    Eigen::Vector3d middle = Eigen::Vector3d::Zero();
    for (size_t k = 0; k < used; ++k) middle += pairs[k].at / static_cast<double>(used);
    Eigen::Matrix<double, 6, 6> normal = Eigen::Matrix<double, 6, 6>::Zero();
    Eigen::Matrix<double, 6, 1> right = Eigen::Matrix<double, 6, 1>::Zero();
    for (size_t k = 0; k < used; ++k) {
      Eigen::Matrix<double, 6, 1> row;
      row << (pairs[k].at - middle).cross(pairs[k].normal), pairs[k].normal;
      normal += row * row.transpose();
      right += row * pairs[k].off;
    }
    constexpr double damping = 1e-9;  // keeps what a ball's symmetry leaves open where it is
    normal.diagonal().array() += damping * static_cast<double>(used);
    const Eigen::Matrix<double, 6, 1> step = normal.ldlt().solve(right);
    const Eigen::Vector3d turn = step.head<3>();
    Eigen::Isometry3d move = Eigen::Isometry3d::Identity();
    move.translate(middle + step.tail<3>());
    if (turn.norm() > 0) move.rotate(Eigen::AngleAxisd(turn.norm(), turn.normalized()));
    move.translate(-middle);
    fit.world_from_scan = move * fit.world_from_scan;
  }
}

/// The 24 rotations of a cube.
std::vector<Eigen::Matrix3d> cube_rotations() {
  std::vector<Eigen::Matrix3d> rotations;
  const std::array<Eigen::Vector3d, 6> axes{Eigen::Vector3d::UnitX(), -Eigen::Vector3d::UnitX(),
                                            Eigen::Vector3d::UnitY(), -Eigen::Vector3d::UnitY(),
                                            Eigen::Vector3d::UnitZ(), -Eigen::Vector3d::UnitZ()};
  for (const Eigen::Vector3d& x : axes)
    for (const Eigen::Vector3d& y : axes)
      if (std::abs(x.dot(y)) < 0.5) {
        Eigen::Matrix3d rotation;
        rotation << x, y, x.cross(y);
        rotations.push_back(rotation);
      }
  return rotations;
}

/// Every so manieth vertex.
std::vector<Eigen::Vector3d> thinned(const Mesh& mesh, double scale, size_t most) {
  std::vector<Eigen::Vector3d> points;
  const size_t count = mesh.positions.size(), wanted = std::min(most, count);
  for (size_t i = 0; i < wanted; ++i) points.push_back(scale * mesh.positions[i * count / wanted].cast<double>());
  return points;
}

/// The extent of the middle nine tenths of the points along the axis where it is largest.
double extent_of(const Mesh& mesh) {
  double largest = 0;
  for (int axis = 0; axis < 3; ++axis) {
    std::vector<float> values;
    for (const Eigen::Vector3f& p : mesh.positions) values.push_back(p[axis]);
    std::sort(values.begin(), values.end());
    const size_t margin = values.size() / 20;
    largest = std::max(largest, static_cast<double>(values[values.size() - 1 - margin] - values[margin]));
  }
  return largest;
}

Eigen::Vector3d mean_of(const std::vector<Eigen::Vector3d>& points) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& p : points) sum += p;
  return sum / static_cast<double>(points.size());
}

double angle_between(const Eigen::Isometry3d& a, const Eigen::Isometry3d& b) {
  return Eigen::AngleAxisd(a.linear().transpose() * b.linear()).angle();
}

Result<Fit> find_place(const Mesh& scan, double scale, const NearestPoints& surface, const HeadRegion& head,
                       const Work& work) {
  constexpr size_t few = 250, many = 1500;
  constexpr int coarse_iterations = 12, fine_iterations = 25;
  constexpr size_t kept = 5;
  const std::vector<Eigen::Vector3d> coarse = thinned(scan, scale, few), fine = thinned(scan, scale, many);
  const std::vector<Eigen::Matrix3d> rotations = cube_rotations();
  // A face alone lies before the head's middle, a whole head around it.
  const std::array<double, 2> before_m{0.06, 0.0};
  std::vector<Fit> fits(rotations.size() * before_m.size());
  work.parallel_for(fits.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      Eigen::Isometry3d start = Eigen::Isometry3d::Identity();
      start.linear() = rotations[i % rotations.size()];
      start.translation() = head.barycentre.cast<double>() + before_m[i / rotations.size()] * Eigen::Vector3d::UnitZ() -
                            start.linear() * mean_of(coarse);
      fits[i] = align(coarse, surface, start, coarse_iterations);
    }
  });
  if (work.stopped()) return Work::cancelled();
  std::stable_sort(fits.begin(), fits.end(), [](const Fit& a, const Fit& b) { return a.misfit_m < b.misfit_m; });
  fits.resize(std::min(fits.size(), kept));
  for (Fit& fit : fits)
    if (std::isfinite(fit.misfit_m)) fit = align(fine, surface, fit.world_from_scan, fine_iterations);
  std::stable_sort(fits.begin(), fits.end(), [](const Fit& a, const Fit& b) { return a.misfit_m < b.misfit_m; });
  const Fit& best = fits.front();
  constexpr double most_misfit_m = 0.006;
  if (!(best.misfit_m <= most_misfit_m))
    return Error{ErrorCode::no_subject,
                 std::isfinite(best.misfit_m)
                     ? "it does not fit the subject's head: " + millimetres(best.misfit_m) + " apart at best"
                     : "it does not fit the subject's head"};
  constexpr double another_angle_rad = 0.35, as_good = 1.1;
  for (const Fit& other : fits)
    if (other.misfit_m < as_good * best.misfit_m &&
        angle_between(other.world_from_scan, best.world_from_scan) > another_angle_rad)
      return Error{ErrorCode::no_subject, "it fits the subject's head in more than one way"};
  return best;
}

/// What is seen of a mesh or cloud from `eye`, through a grid of rays around `towards`.
RangeScan seen_from(const Mesh& mesh, const Eigen::Vector3f& eye, const HeadRegion& head) {
  // 0.8 mm a ray on a head; of a cloud no finer than its points lie.
  constexpr int finest = 400, coarsest = 100;
  const int size =
      mesh.triangles.empty()
          ? std::clamp(static_cast<int>(std::sqrt(1.5 * static_cast<double>(mesh.positions.size()))), coarsest, finest)
          : finest;
  const Eigen::Vector3f axis = (head.barycentre - eye).normalized();
  const Eigen::Vector3f right = axis.cross(Eigen::Vector3f::UnitY()).normalized(), down = axis.cross(right);
  const float depth = (head.barycentre - eye).norm(), half = 0.75F * head.height();
  const float middle = 0.5F * static_cast<float>(size), step = half / middle / depth;
  RangeScan scan(size, size);
  constexpr float sigma_m = 2e-4F;
  const auto keep = [&](size_t i, const Eigen::Vector3f& p) {
    scan.points[i] = p;
    scan.sigma_m[i] = sigma_m;
  };
  if (!mesh.triangles.empty()) {
    const RayCaster rays(mesh);
    for (int y = 0; y < size; ++y)
      for (int x = 0; x < size; ++x) {
        const Eigen::Vector3f way =
            (axis + step * (static_cast<float>(x) - middle) * right + step * (static_cast<float>(y) - middle) * down)
                .normalized();
        if (const auto hit = rays.cast(eye, way, 0, 2 * depth)) keep(scan.index(x, y), eye + hit->distance_m * way);
      }
    return scan;
  }
  // The nearest point in each ray's cell; gaps between sparse points close when the scan is meshed.
  for (const Eigen::Vector3f& p : mesh.positions) {
    const Eigen::Vector3f from = p - eye;
    const float along = from.dot(axis);
    if (!(along > 0)) continue;
    const int x = static_cast<int>(std::lround(from.dot(right) / along / step + middle)),
              y = static_cast<int>(std::lround(from.dot(down) / along / step + middle));
    if (x < 0 || y < 0 || x >= size || y >= size) continue;
    const size_t i = scan.index(x, y);
    if (!scan.measured(i) || from.squaredNorm() < (scan.points[i] - eye).squaredNorm()) keep(i, p);
  }
  return scan;
}

}  // namespace

Result<PlacedScan> place_external_scan(const Mesh& scan, const Mesh& hull, const HeadRegion& head, const Work& work) {
  constexpr size_t fewest_points = 500;
  if (scan.positions.size() < fewest_points)
    return Error{ErrorCode::no_subject, "it has only " + std::to_string(scan.positions.size()) + " points"};
  PlacedScan placed;
  const double extent = extent_of(scan);
  constexpr double smallest_m = 0.08, largest_m = 0.8, mm_per_m = 1000;
  if (extent >= smallest_m * mm_per_m && extent <= largest_m * mm_per_m)
    placed.metres_per_unit = 1 / mm_per_m;
  else if (!(extent >= smallest_m && extent <= largest_m))
    return Error{ErrorCode::no_subject,
                 "its extent of " + std::to_string(extent) + " is a face's neither in metres nor in millimetres"};
  const NearestPoints surface(hull, head.lowest_face_y());
  if (surface.empty()) return Error{ErrorCode::no_subject, "the hull has no head"};

  // In its place: on the head as near as a hull can say.
  constexpr double in_place_m = 0.01;
  constexpr size_t samples = 1500;
  const Fit as_it_is = align(thinned(scan, placed.metres_per_unit, samples), surface, Eigen::Isometry3d::Identity(), 0);
  placed.in_place = as_it_is.misfit_m < in_place_m;
  if (placed.in_place) {
    placed.misfit_m = as_it_is.misfit_m;
  } else {
    const auto fit = find_place(scan, placed.metres_per_unit, surface, head, work);
    if (!fit) return fit.error();
    placed.world_from_scan = fit->world_from_scan;
    placed.misfit_m = fit->misfit_m;
  }

  Mesh moved = scan;
  Eigen::Vector3d middle = Eigen::Vector3d::Zero();
  for (Eigen::Vector3f& p : moved.positions) {
    const Eigen::Vector3d world = placed.world_from_scan * (placed.metres_per_unit * p.cast<double>());
    p = world.cast<float>();
    middle += world / static_cast<double>(moved.positions.size());
  }
  // Before the face: where the scan lies from the head's middle, or ahead where it is of the whole head.
  const Eigen::Vector3f ahead = middle.cast<float>() - head.barycentre;
  const Eigen::Vector3f level(ahead.x(), 0, ahead.z());
  constexpr float one_sided_m = 0.02F, distance_m = 0.8F;
  placed.eye = head.barycentre + distance_m * (level.norm() > one_sided_m ? Eigen::Vector3f(level.normalized())
                                                                          : Eigen::Vector3f(Eigen::Vector3f::UnitZ()));
  placed.scan = seen_from(moved, placed.eye, head);
  return placed;
}

}  // namespace booth
