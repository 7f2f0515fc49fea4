#include "pipeline/hull/camera_alignment.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <numeric>
#include <optional>
#include <string>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// So many rows and columns of an image are searched for the outline.
constexpr int scan_lines = 48;
/// Nearer to the image's border an outline may be that of the image.
constexpr int border_px = 6;
/// Rays are followed near the hull in steps of so many voxels.
constexpr double step_voxels = 3;
/// Misses beyond this are no matter of alignment.
constexpr double largest_miss_px = 12;
/// This share of an outline's points misses less than the regression's line.
constexpr double quantile = 0.75;
constexpr int regression_rounds = 20;
/// Keeps the weights of the regression finite, pixels.
constexpr double smallest_residual_px = 0.05;
/// An outline of fewer points, or one that runs one way, says nothing.
constexpr size_t fewest_points = 40;
constexpr double least_condition = 0.05;

/// With fewer cameras the others' hull is too loose to judge one by.
constexpr size_t fewest_judges = 6;
/// A camera is suspected from an offset of this share of its image's shorter side on, or of so many pixels, and an
/// outline of so many points. Measured on well calibrated rigs: up to 1.1 px of 1200 with seven cameras and more.
constexpr double suspicious_share = 1.0 / 750;
constexpr double suspicious_px = 1.5;
constexpr size_t suspicious_support = 80;
/// Realigning the right one lowers the disagreement of all by at least this share of its own offset.
constexpr double convincing = 0.7;

struct RimPoint {
  Eigen::Vector2d pixel, outwards;
};

std::vector<RimPoint> find_rim(const SilhouetteView& view) {
  const Image& coverage = view.coverage();
  const OutlineDistance& outline = view.outline();
  std::vector<RimPoint> rim;
  const auto add = [&](double x, double y) {
    if (x < border_px || y < border_px || x > coverage.width - 1 - border_px || y > coverage.height - 1 - border_px)
      return;
    const auto at = [&](double dx, double dy) {
      return static_cast<double>(outline.at(static_cast<float>(x + dx), static_cast<float>(y + dy)));
    };
    constexpr double reach = 1.5;
    const Eigen::Vector2d gradient(at(reach, 0) - at(-reach, 0), at(0, reach) - at(0, -reach));
    // Where the outline turns sharply, or another is close, there is no direction.
    if (gradient.norm() > reach) rim.push_back({{x, y}, gradient.normalized()});
  };
  const auto between = [](uint8_t a, uint8_t b) { return (127.5 - a) / (b - a); };
  const int row_step = std::max(1, coverage.height / scan_lines);
  for (int y = row_step / 2; y < coverage.height; y += row_step)
    for (int x = 0; x + 1 < coverage.width; ++x)
      if (const uint8_t a = coverage.at(x, y), b = coverage.at(x + 1, y); (a >= 128) != (b >= 128))
        add(x + between(a, b), y);
  const int column_step = std::max(1, coverage.width / scan_lines);
  for (int x = column_step / 2; x < coverage.width; x += column_step)
    for (int y = 0; y + 1 < coverage.height; ++y)
      if (const uint8_t a = coverage.at(x, y), b = coverage.at(x, y + 1); (a >= 128) != (b >= 128))
        add(x, y + between(a, b));
  return rim;
}

class Measuring {
 public:
  Measuring(const SilhouetteViews& views, const Field& hull) : views_(views), hull_(hull) {}

  CameraOffset measure(size_t view) const {
    std::vector<RimPoint> rim = find_rim(*views_[view]);
    std::vector<double> misses;
    size_t kept = 0;
    for (const RimPoint& point : rim) {
      const auto miss = miss_px(view, point.pixel);
      if (!miss || std::abs(*miss) > largest_miss_px) continue;
      rim[kept++] = point;
      misses.push_back(*miss);
    }
    rim.resize(kept);
    return regress(rim, misses);
  }

 private:
  /// By how many pixels of the camera the ray through one of its pixels passes the hull of all others: negative where
  /// it runs through it. Nothing where it does not come near the hull.
  std::optional<double> miss_px(size_t view, const Eigen::Vector2d& pixel) const {
    const CalibratedView& camera = views_[view]->camera();
    const Eigen::Vector3d center = camera.center(), direction = world_ray(camera, pixel);
    const Grid& grid = hull_.grid();
    const Eigen::Vector3d low = grid.origin;
    const Eigen::Vector3d high = grid.point(grid.size[0] - 1, grid.size[1] - 1, grid.size[2] - 1);
    double begin_m = 0, end_m = std::numeric_limits<double>::infinity();
    for (int axis = 0; axis < 3; ++axis) {
      const double a = (low[axis] - center[axis]) / direction[axis], b = (high[axis] - center[axis]) / direction[axis];
      begin_m = std::max(begin_m, std::min(a, b));
      end_m = std::min(end_m, std::max(a, b));
    }
    const double step_m = step_voxels * grid.voxel_m;
    double best = std::numeric_limits<double>::infinity(), best_m = 0;
    size_t severest = 0;
    const auto look = [&](double at_m) {
      const Eigen::Vector3d p = center + at_m * direction;
      const double miss = farthest_outside(view, p.cast<float>(), best, &severest);
      if (miss < best) best = miss, best_m = at_m;
    };
    for (double at_m = begin_m; at_m <= end_m; at_m += step_m)
      if (is_near_hull(center + at_m * direction)) look(at_m);
    if (!std::isfinite(best)) return std::nullopt;
    for (double closer_m = step_m / 2; closer_m > grid.voxel_m / 2; closer_m /= 2)
      for (const double from_m = best_m; const double side : {-1.0, 1.0}) look(from_m + side * closer_m);
    const double depth_m = (camera.camera_from_world * (center + best_m * direction)).z();
    return best / (depth_m * static_cast<double>(views_[view]->per_focal()));
  }

  bool is_near_hull(const Eigen::Vector3d& p) const {
    const Grid& grid = hull_.grid();
    const Eigen::Vector3d at = (p - grid.origin) / grid.voxel_m;
    const auto i = static_cast<int>(std::lround(at.x())), j = static_cast<int>(std::lround(at.y()));
    const auto k = static_cast<int>(std::lround(at.z()));
    if (i < 0 || j < 0 || k < 0 || i >= grid.size[0] || j >= grid.size[1] || k >= grid.size[2]) return false;
    return hull_.brick(hull_.brick_index(i / Field::brick_side, j / Field::brick_side, k / Field::brick_side)) !=
           Field::all_outside;
  }

  /// The largest distance to the outline of any other camera that sees the point, metres; anything not below
  /// `enough` when it is not below that.
  double farthest_outside(size_t view, const Eigen::Vector3f& p, double enough, size_t* severest) const {
    double farthest = -std::numeric_limits<double>::infinity();
    const auto ask = [&](size_t v) {
      if (v == view) return;
      const auto distance = static_cast<double>(views_[v]->distance_m(p));
      if (distance > farthest) farthest = distance, *severest = v;
    };
    // Who was severest on the ray's last point mostly is again.
    ask(*severest);
    for (size_t v = 0; v < views_.size() && farthest < enough; ++v) ask(v);
    return std::isfinite(farthest) ? farthest : std::numeric_limits<double>::infinity();
  }

  /// Fits miss = shift · outwards + surplus.
  static CameraOffset regress(const std::vector<RimPoint>& rim, const std::vector<double>& misses) {
    if (rim.size() < fewest_points) return {};
    Eigen::Vector3d fit = Eigen::Vector3d::Zero();
    for (int round = 0; round < regression_rounds; ++round) {
      Eigen::Matrix3d squares = Eigen::Matrix3d::Zero();
      Eigen::Vector3d right = Eigen::Vector3d::Zero();
      for (size_t n = 0; n < rim.size(); ++n) {
        const Eigen::Vector3d row(rim[n].outwards.x(), rim[n].outwards.y(), 1);
        const double residual = misses[n] - row.dot(fit);
        const double weight =
            (residual > 0 ? quantile : 1 - quantile) / std::max(std::abs(residual), smallest_residual_px);
        squares += weight * row * row.transpose();
        right += weight * misses[n] * row;
      }
      const double scale = squares(2, 2);
      if (std::min(squares(0, 0), squares(1, 1)) < least_condition * scale) return {};
      fit = squares.ldlt().solve(right);
    }
    return {fit.head<2>(), rim.size()};
  }

  const SilhouetteViews& views_;
  const Field& hull_;
};

}  // namespace

std::vector<CameraOffset> measure_camera_offsets(const SilhouetteViews& views, const Field& hull, const Work& work) {
  const Measuring measuring(views, hull);
  std::vector<CameraOffset> offsets(views.size());
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v)
      if (!work.stopped()) offsets[v] = measuring.measure(v);
  });
  return offsets;
}

std::vector<Realignment> realign_cameras(Rig& rig, SilhouetteViews& views, const Field& hull, const Work& work) {
  std::vector<Realignment> realigned;
  if (views.size() < fewest_judges) return realigned;
  const auto disagreement = [](const std::vector<CameraOffset>& offsets) {
    return std::accumulate(offsets.begin(), offsets.end(), 0.0,
                           [](double sum, const CameraOffset& offset) { return sum + offset.shift_px.norm(); });
  };
  const auto intrinsics_of = [&](size_t v) -> Intrinsics& {
    const std::string& id = views[v]->camera().id;
    return std::find_if(rig.cameras.begin(), rig.cameras.end(), [&](const RigCamera& c) { return c.id == id; })
        ->intrinsics;
  };
  /// The view with its camera's principal point moved.
  const auto shifted = [&](size_t v, const Eigen::Vector2d& by_px) {
    Intrinsics& intrinsics = intrinsics_of(v);
    intrinsics.cx += by_px.x();
    intrinsics.cy += by_px.y();
    return std::make_unique<SilhouetteView>(views[v]->camera(), views[v]->coverage());
  };
  std::vector<CameraOffset> offsets = measure_camera_offsets(views, hull, work);
  while (realigned.size() < views.size() / 3 && !work.stopped()) {
    // One camera's fault shows in its neighbours as well: it is the one whose realignment settles most.
    std::optional<size_t> culprit;
    std::vector<CameraOffset> settled;
    double least = std::numeric_limits<double>::infinity();
    for (size_t v = 0; v < views.size(); ++v) {
      const Eigen::Vector2d offset = offsets[v].shift_px;
      const Intrinsics& k = views[v]->camera().intrinsics;
      const double most_px = std::max(suspicious_px, suspicious_share * std::min(k.width, k.height));
      if (offset.norm() < most_px || offsets[v].support < suspicious_support) continue;
      const Intrinsics as_calibrated = k;
      auto view = shifted(v, offset);
      std::swap(view, views[v]);
      std::vector<CameraOffset> then = measure_camera_offsets(views, hull, work);
      std::swap(view, views[v]);
      intrinsics_of(v) = as_calibrated;
      const double left = disagreement(then);
      if (left >= least || left > disagreement(offsets) - convincing * offset.norm()) continue;
      least = left;
      culprit = v;
      settled = std::move(then);
    }
    if (!culprit) break;
    views[*culprit] = shifted(*culprit, offsets[*culprit].shift_px);
    realigned.push_back({*culprit, offsets[*culprit].shift_px.norm()});
    offsets = std::move(settled);
  }
  return realigned;
}

}  // namespace booth
