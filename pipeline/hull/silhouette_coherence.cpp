#include "pipeline/hull/silhouette_coherence.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// So many rows and columns of an image are searched for the outline.
constexpr int scan_lines = 96;
/// Nearer to the image's border an outline may be that of the image.
constexpr int border_px = 6;
/// Rays are followed near the hull in steps of this length, then in ever smaller ones.
constexpr double step_m = 0.012;
constexpr double finest_step_m = 0.0002;
/// Misses beyond this, and beyond this share of the image's shorter side, are no matter of calibration.
constexpr double largest_miss_px = 5;
constexpr double largest_miss_share = 0.02;

struct RimPoint {
  Eigen::Vector2d pixel, outwards;
};

/// The outline's distance changes this way per pixel; short where the outline turns sharply or another is close.
Eigen::Vector2d outline_gradient(const OutlineDistance& outline, const Eigen::Vector2d& pixel) {
  constexpr double reach = 1.5;
  const auto at = [&](double dx, double dy) {
    return static_cast<double>(outline.at(static_cast<float>(pixel.x() + dx), static_cast<float>(pixel.y() + dy)));
  };
  return Eigen::Vector2d(at(reach, 0) - at(-reach, 0), at(0, reach) - at(0, -reach)) / (2 * reach);
}

std::vector<RimPoint> find_rim(const SilhouetteView& view) {
  const Image& coverage = view.coverage();
  std::vector<RimPoint> rim;
  const auto add = [&](double x, double y) {
    if (x < border_px || y < border_px || x > coverage.width - 1 - border_px || y > coverage.height - 1 - border_px)
      return;
    constexpr double least_gradient = 0.5;
    const Eigen::Vector2d gradient = outline_gradient(view.outline(), {x, y});
    if (gradient.norm() > least_gradient) rim.push_back({{x, y}, gradient.normalized()});
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

/// How the projection of a point moves along `direction` with the camera's pose, pixels.
PoseChange slope_of_projection(const CalibratedView& camera, const Eigen::Vector3d& p_world,
                               const Eigen::Vector2d& direction) {
  const Eigen::Vector3d p = camera.camera_from_world * p_world;
  const double reach_m = 1e-4 * p.z();
  Eigen::RowVector3d by_point;
  for (int axis = 0; axis < 3; ++axis) {
    const Eigen::Vector3d step = reach_m * Eigen::Vector3d::Unit(axis);
    const auto ahead = project_camera_point(camera.intrinsics, p + step);
    const auto behind = project_camera_point(camera.intrinsics, p - step);
    by_point[axis] = ahead && behind ? direction.dot(*ahead - *behind) / (2 * reach_m) : 0;
  }
  PoseChange slope;
  slope.head<3>() = p.cross(by_point.transpose());  // by_point · (ω × p) = ω · (p × by_point)
  slope.tail<3>() = by_point.transpose();
  return slope;
}

class Sampling {
 public:
  Sampling(const SilhouetteViews& views, const Field& hull) : views_(views), hull_(hull) {}

  std::vector<CoherenceSample> of(size_t view) const {
    std::vector<CoherenceSample> samples;
    const Intrinsics& k = views_[view]->camera().intrinsics;
    const double largest_px = std::max(largest_miss_px, largest_miss_share * std::min(k.width, k.height));
    for (const RimPoint& point : find_rim(*views_[view])) {
      const auto contact = find_contact(view, point.pixel);
      if (!contact) continue;
      const double pixel_m = pixel_at(view, contact->p);
      const double miss_px = contact->distance_m / pixel_m;
      if (std::abs(miss_px) > largest_px) continue;
      samples.push_back(describe(view, point, *contact, miss_px, pixel_m));
    }
    return samples;
  }

 private:
  /// The point of a ray where the largest distance to the others' outlines is least.
  struct Contact {
    Eigen::Vector3d p;
    Eigen::Vector3d direction;  ///< of the ray, unit
    double distance_m;
  };

  std::optional<Contact> find_contact(size_t view, const Eigen::Vector2d& pixel) const {
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
    double best = std::numeric_limits<double>::infinity(), best_m = 0;
    size_t severest = 0;
    const auto look = [&](double at_m) {
      const Eigen::Vector3d p = center + at_m * direction;
      const double distance = farthest_outside(view, p.cast<float>(), best, &severest);
      if (distance < best) best = distance, best_m = at_m;
    };
    for (double at_m = begin_m; at_m <= end_m; at_m += step_m)
      if (is_near_hull(center + at_m * direction)) look(at_m);
    if (!std::isfinite(best)) return std::nullopt;
    for (double closer_m = step_m / 2; closer_m > finest_step_m; closer_m /= 2)
      for (const double from_m = best_m; const double side : {-1.0, 1.0}) look(from_m + side * closer_m);
    return Contact{center + best_m * direction, direction, best};
  }

  /// Also where a camera that was moved carved some of the subject away.
  bool is_near_hull(const Eigen::Vector3d& p) const {
    constexpr double margin_m = 0.02;
    for (const double side : {0.0, -margin_m, margin_m})
      for (int axis = 0; axis < (side == 0 ? 1 : 3); ++axis)
        if (is_in_brick(p + side * Eigen::Vector3d::Unit(axis))) return true;
    return false;
  }

  bool is_in_brick(const Eigen::Vector3d& p) const {
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

  double pixel_at(size_t view, const Eigen::Vector3d& p) const {
    const double depth_m = (views_[view]->camera().camera_from_world * p).z();
    return depth_m * static_cast<double>(views_[view]->per_focal());
  }

  CoherenceSample describe(size_t view, const RimPoint& point, const Contact& contact, double miss_px,
                           double pixel_m) const {
    CoherenceSample sample;
    sample.miss_px = miss_px;
    sample.slopes.fill({view, PoseChange::Zero()});
    sample.slopes[0].px = -slope_of_projection(views_[view]->camera(), contact.p, point.outwards);

    // The two others that hold the ray back: one on either side of the point, or one alone whose distance is least.
    struct Witness {
      size_t view;
      double distance_m, rise;
    };
    std::optional<Witness> rising, falling;
    for (size_t v = 0; v < views_.size(); ++v) {
      if (v == view) continue;
      const auto at = [&](double along_m) {
        const Eigen::Vector3d p = contact.p + along_m * contact.direction;
        return static_cast<double>(views_[v]->distance_m(p.cast<float>()));
      };
      constexpr double reach_m = 0.001;
      const Witness witness{v, at(0), (at(reach_m) - at(-reach_m)) / (2 * reach_m)};
      if (!std::isfinite(witness.rise) || !(witness.distance_m > contact.distance_m - reach_m)) continue;
      std::optional<Witness>& side = witness.rise > 0 ? rising : falling;
      if (!side || witness.distance_m > side->distance_m) side = witness;
    }
    const auto witnesses = [&](size_t place, const Witness& witness, double weight) {
      const SilhouetteView& other = *views_[witness.view];
      const auto pixel = project(other.camera(), contact.p);
      if (!pixel) return;
      const Eigen::Vector2d gradient = outline_gradient(other.outline(), *pixel);
      const double scale = weight * pixel_at(witness.view, contact.p) / pixel_m;
      sample.noise_px = std::hypot(sample.noise_px, scale);
      sample.slopes[place] = {witness.view, scale * slope_of_projection(other.camera(), contact.p, gradient)};
    };
    if (rising && falling) {
      // At the least of their maximum the weighted rises cancel.
      const double both = rising->rise - falling->rise;
      const double share = both > 0 ? -falling->rise / both : 0.5;
      witnesses(1, *rising, share);
      witnesses(2, *falling, 1 - share);
    } else if (rising || falling) {
      witnesses(1, rising ? *rising : *falling, 1);
    }
    return sample;
  }

  const SilhouetteViews& views_;
  const Field& hull_;
};

}  // namespace

std::vector<CoherenceSample> sample_coherence(const SilhouetteViews& views, const Field& hull, const Work& work) {
  const Sampling sampling(views, hull);
  std::vector<std::vector<CoherenceSample>> by_view(views.size());
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v)
      if (!work.stopped()) by_view[v] = sampling.of(v);
  });
  std::vector<CoherenceSample> samples;
  for (const auto& of_view : by_view) samples.insert(samples.end(), of_view.begin(), of_view.end());
  return samples;
}

}  // namespace booth
