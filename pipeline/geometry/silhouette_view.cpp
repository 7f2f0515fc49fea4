#include "pipeline/geometry/silhouette_view.h"

#include <Eigen/SVD>
#include <algorithm>
#include <limits>
#include <vector>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// Beside a cut-off silhouette a camera's say fades over this share of its image's shorter side.
constexpr double feather_share = 0.06;
/// What distances between the outline's tiles may be off by, and the rounding of projections, in pixels.
constexpr double distance_slack_px = 1;
/// Background that the subject encloses is a fault of the mask when its area is at most that of a square with this
/// share of the image's shorter side: true gaps that small carve nothing that could be seen.
constexpr double hole_share = 0.004;

/// The coverage without small holes.
Image fill_small_holes(const Image& coverage) {
  const double side_px = hole_share * std::min(coverage.width, coverage.height);
  const size_t most_pixels = std::max(size_t{1}, static_cast<size_t>(side_px * side_px));
  Image filled = coverage;
  const auto subject = [&](int x, int y) { return filled.at(x, y) >= 128; };
  struct Pixel {
    int x, y;
  };
  std::vector<Pixel> hole;
  for (int y = 1; y + 1 < filled.height; ++y)
    for (int x = 1; x + 1 < filled.width; ++x) {
      // Every hole has a topmost pixel that has the subject above and on its left.
      if (subject(x, y) || !subject(x - 1, y) || !subject(x, y - 1)) continue;
      hole.assign(1, {x, y});
      bool enclosed = true;
      for (size_t n = 0; n < hole.size() && enclosed; ++n)
        for (const Pixel& next : {Pixel{hole[n].x - 1, hole[n].y}, Pixel{hole[n].x + 1, hole[n].y},
                                  Pixel{hole[n].x, hole[n].y - 1}, Pixel{hole[n].x, hole[n].y + 1}}) {
          const auto same = [&](const Pixel& p) { return p.x == next.x && p.y == next.y; };
          if (!filled.contains(next.x, next.y) || hole.size() > most_pixels) {
            enclosed = false;
            break;
          }
          if (!subject(next.x, next.y) && std::none_of(hole.begin(), hole.end(), same)) hole.push_back(next);
        }
      if (!enclosed || hole.size() > most_pixels) continue;
      for (const Pixel& p : hole) filled.at(p.x, p.y) = 255;
    }
  return filled;
}

}  // namespace

SilhouetteView::SilhouetteView(const RigCamera& camera, const Image& coverage)
    : camera_(&camera),
      coverage_(fill_small_holes(coverage)),
      outline_(coverage_, feather_share * std::min(coverage.width, coverage.height)),
      rotation_(camera.camera_from_world.linear().cast<float>()),
      translation_(camera.camera_from_world.translation().cast<float>()),
      per_focal_(static_cast<float>(1 / std::sqrt(camera.intrinsics.fx * camera.intrinsics.fy))) {
  const Intrinsics& k = camera.intrinsics;
  const auto single = [](double value) { return static_cast<float>(value); };
  const auto& d = k.distortion;
  lens_ = {single(k.fx), single(k.fy), single(k.cx), single(k.cy), single(k.skew),        single(d[0]),
           single(d[1]), single(d[2]), single(d[3]), single(d[4]), single(k.width - 0.5), single(k.height - 0.5)};
  measure_lens();
}

/// Samples the image, and a margin around it that balls on its edge reach into.
void SilhouetteView::measure_lens() {
  const Intrinsics& k = camera_->intrinsics;
  constexpr int steps = 16;
  constexpr double margin = 0.1;
  double radius2 = 0;
  for (int i = 0; i <= steps; ++i)
    for (int j = 0; j <= steps; ++j) {
      const Eigen::Vector2d share(static_cast<double>(i) / steps, static_cast<double>(j) / steps);
      const Eigen::Vector2d size(k.width, k.height);
      const Eigen::Vector2d wide = (share * (1 + 2 * margin) - Eigen::Vector2d::Constant(margin)).cwiseProduct(size);
      const Eigen::Vector3d direction = unproject(k, wide);
      constexpr double step = 1e-4;
      const auto middle = project_camera_point(k, direction);
      const auto beside = project_camera_point(k, direction + Eigen::Vector3d(step, 0, 0));
      const auto below = project_camera_point(k, direction + Eigen::Vector3d(0, step, 0));
      if (middle && beside && below) {
        Eigen::Matrix2d jacobian;
        jacobian.col(0) = (*beside - *middle) / step;
        jacobian.col(1) = (*below - *middle) / step;
        stretch_px_ = std::max(stretch_px_, jacobian.jacobiSvd().singularValues()[0]);
      }
      radius2 = std::max(radius2, unproject(k, share.cwiseProduct(size)).head<2>().squaredNorm());
    }
  constexpr double between_samples = 1.02;
  stretch_px_ *= between_samples;
  image_radius2_ = static_cast<float>(radius2 * between_samples);
}

float SilhouetteView::distance_m(const Eigen::Vector3f& p_world) const {
  float u, v, depth_m, within_px;
  project(p_world.x(), p_world.y(), p_world.z(), u, v, depth_m, within_px);
  if (!(within_px >= 0)) return std::numeric_limits<float>::quiet_NaN();
  return outline_.at(u, v) * depth_m * per_focal_;
}

SilhouetteView::Verdict SilhouetteView::judge(const Eigen::Vector3d& center, double radius_m) const {
  constexpr double unbounded = std::numeric_limits<double>::infinity();
  const Eigen::Vector3d p = camera_->camera_from_world * center;
  constexpr auto near = static_cast<double>(nearest_m);
  if (p.z() + radius_m < near) return {.hidden = true};
  if (p.z() - radius_m < near) return {.least_m = -unbounded, .most_m = unbounded};
  const double off_axis = p.head<2>().norm() / p.z();
  // From q to p, both in the ball, a projection moves by |(q − p)xy − x (q − p)z| / qz in the plane z = 1.
  const double moved = radius_m * std::sqrt(1 + off_axis * off_axis) / (p.z() - radius_m);
  if (off_axis > moved && (off_axis - moved) * (off_axis - moved) > static_cast<double>(image_radius2_))
    return {.hidden = true};
  const auto pixel = project_camera_point(camera_->intrinsics, p);
  if (!pixel) return {.least_m = -unbounded, .most_m = unbounded};
  const double moved_px = moved * stretch_px_ + distance_slack_px;
  const double right = camera_->intrinsics.width - 0.5, bottom = camera_->intrinsics.height - 0.5;
  // How far inside the image the middle is; negative outside.
  const double within = std::min({pixel->x() + 0.5, right - pixel->x(), pixel->y() + 0.5, bottom - pixel->y()});
  Verdict verdict;
  verdict.seen = within >= moved_px;
  verdict.hidden = within < -moved_px;
  if (verdict.hidden) return verdict;
  // The distance is looked up at the image's nearest point; seen points are no farther from it than twice the move.
  const double reach_px = outline_.slope() * moved_px * (within < 0 ? 2 : 1);
  const double middle_px =
      static_cast<double>(outline_.at(static_cast<float>(pixel->x()), static_cast<float>(pixel->y())));
  const auto metres = [&](double px, double depth) { return px * depth * static_cast<double>(per_focal_); };
  const double least_px = middle_px - reach_px, most_px = middle_px + reach_px;
  verdict.least_m = metres(least_px, p.z() + (least_px < 0 ? radius_m : -radius_m));
  verdict.most_m = metres(most_px, p.z() + (most_px < 0 ? -radius_m : radius_m));
  return verdict;
}

}  // namespace booth
