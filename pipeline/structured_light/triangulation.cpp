#include "pipeline/structured_light/triangulation.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <utility>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

constexpr float nan = std::numeric_limits<float>::quiet_NaN();

/// The world's directions, of depth 1, that part of a view's pixels look in, by interpolation between exact ones:
/// distortion is smooth.
class RayTable {
 public:
  RayTable(const CalibratedView& view, const Eigen::AlignedBox2d& pixels)
      : origin_(pixels.min()),
        columns_(static_cast<int>(pixels.sizes().x()) / spacing + 2),
        rows_(static_cast<int>(pixels.sizes().y()) / spacing + 2) {
    const Eigen::Matrix3d world_from_camera = view.camera_from_world.linear().transpose();
    rays_.reserve(static_cast<size_t>(columns_) * static_cast<size_t>(rows_));
    for (int y = 0; y < rows_; ++y)
      for (int x = 0; x < columns_; ++x)
        rays_.emplace_back(world_from_camera * unproject(view.intrinsics, origin_ + spacing * Eigen::Vector2d(x, y)));
  }
  Eigen::Vector3d at(const Eigen::Vector2d& pixel) const {
    const Eigen::Vector2d p =
        ((pixel - origin_) / spacing).cwiseMax(0.0).cwiseMin(Eigen::Vector2d(columns_ - 1.001, rows_ - 1.001));
    const int x = static_cast<int>(p.x()), y = static_cast<int>(p.y());
    const double a = p.x() - x, b = p.y() - y;
    const Eigen::Vector3d* r = rays_.data() + static_cast<std::ptrdiff_t>(y) * columns_ + x;
    return (1 - b) * ((1 - a) * r[0] + a * r[1]) + b * ((1 - a) * r[columns_] + a * r[columns_ + 1]);
  }

 private:
  static constexpr int spacing = 8;
  Eigen::Vector2d origin_;
  int columns_, rows_;
  std::vector<Eigen::Vector3d> rays_;
};

/// Where in a camera's image each projector pixel is seen: x, y and their standard deviation, camera pixels.
FloatImage invert(const ProjectorCoordinates& view, int width, int height) {
  FloatImage inverse(width, height, 3, nan);
  const FloatImage& map = view.position;
  constexpr float widest = 6;  // projector pixels between neighbours: farther apart they are two surfaces
  const auto draw = [&](const std::array<Eigen::Vector2i, 3>& pixel, const std::array<Eigen::Vector2f, 3>& p) {
    const Eigen::Vector2f low = p[0].cwiseMin(p[1]).cwiseMin(p[2]), high = p[0].cwiseMax(p[1]).cwiseMax(p[2]);
    const auto first = [](float from) { return std::max(0, static_cast<int>(std::ceil(from))); };
    const int x0 = first(low.x()), y0 = first(low.y());
    const int x1 = std::min(static_cast<int>(high.x()), width - 1),
              y1 = std::min(static_cast<int>(high.y()), height - 1);
    if (x0 > x1 || y0 > y1) return;
    const Eigen::Vector2f e1 = p[1] - p[0], e2 = p[2] - p[0];
    if (std::max({e1.squaredNorm(), e2.squaredNorm(), (e2 - e1).squaredNorm()}) > widest * widest) return;
    const float area = e1.x() * e2.y() - e1.y() * e2.x();  // of a camera pixel, in projector pixels
    constexpr float grazing = 0.02F;
    if (std::abs(area) < grazing) return;
    float sigma = 0;
    for (const Eigen::Vector2i& at : pixel) sigma = std::max(sigma, view.sigma.at(at.x(), at.y()));
    sigma /= std::sqrt(std::abs(area));
    const float per_area = 1 / area;
    for (int y = y0; y <= y1; ++y)
      for (int x = x0; x <= x1; ++x) {
        const Eigen::Vector2f d = Eigen::Vector2f(static_cast<float>(x), static_cast<float>(y)) - p[0];
        const float b1 = (d.x() * e2.y() - d.y() * e2.x()) * per_area,
                    b2 = (e1.x() * d.y() - e1.y() * d.x()) * per_area;
        constexpr float rim = -1e-5F;
        if (b1 < rim || b2 < rim || b1 + b2 > 1 - rim) continue;
        float* out = inverse.pixel(x, y);
        if (out[2] <= sigma) continue;  // a pixel seen twice (false positions do that) goes to the surer; NaN gives way
        const Eigen::Vector2f at = pixel[0].cast<float>() + b1 * (pixel[1] - pixel[0]).cast<float>() +
                                   b2 * (pixel[2] - pixel[0]).cast<float>();
        out[0] = at.x() + static_cast<float>(view.origin.x());
        out[1] = at.y() + static_cast<float>(view.origin.y());
        out[2] = sigma;
      }
  };
  for (int y = 0; y + 1 < map.height; ++y)
    for (int x = 0; x + 1 < map.width; ++x) {
      const Eigen::Map<const Eigen::Vector2f> a(map.pixel(x, y)), b(map.pixel(x + 1, y)), c(map.pixel(x, y + 1)),
          d(map.pixel(x + 1, y + 1));
      if (std::isnan(a.x()) || std::isnan(d.x())) continue;
      const Eigen::Vector2i pixel(x, y);
      if (!std::isnan(b.x())) draw({pixel, {x + 1, y}, {x + 1, y + 1}}, {a, b, d});
      if (!std::isnan(c.x())) draw({pixel, {x + 1, y + 1}, {x, y + 1}}, {a, d, c});
    }
  return inverse;
}

/// One of the views that see a point.
struct View {
  explicit View(const CalibratedView& view)
      : center(view.center()), axis(view.camera_from_world.linear().row(2)), focal(view.intrinsics.fx) {}
  Eigen::Vector3d center;
  Eigen::Vector3d axis;  ///< of its optics in the world
  double focal;          ///< pixels
};

/// A ray with what its pixel's uncertainty means at unit depth.
struct Sight {
  const View* view;
  Eigen::Vector3d direction;  ///< world, of depth 1 in the camera's frame
  double sigma;               ///< at unit depth
};

struct Meeting {
  Eigen::Vector3d point;
  double residual_px = 0;  ///< largest
  double sigma_m = 0;
};

constexpr size_t most_sights = 8;

/// The point of least weighted squared distance to the rays.
/// @param near  where it may be, world frame
std::optional<Meeting> meet(std::span<const Sight> sights, const Eigen::Vector3d& near) {
  Meeting found;
  std::array<double, most_sights> depth;
  for (size_t i = 0; i < sights.size(); ++i) {
    constexpr double least_m = 0.01;
    depth[i] = std::max(sights[i].view->axis.dot(near - sights[i].view->center), least_m);
  }
  Eigen::Matrix3d covariance;
  constexpr double good_enough = 0.05;  // of the depths, which the weights need
  double change = 1;
  for (int pass = 0; pass < 2 && change > good_enough; ++pass) {
    double xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    for (size_t i = 0; i < sights.size(); ++i) {
      const Eigen::Vector3d &d = sights[i].direction, &center = sights[i].view->center;
      const double spread = sights[i].sigma * depth[i], w = 1 / (spread * spread), along = w / d.squaredNorm();
      xx += w - along * d.x() * d.x();
      xy -= along * d.x() * d.y();
      xz -= along * d.x() * d.z();
      yy += w - along * d.y() * d.y();
      yz -= along * d.y() * d.z();
      zz += w - along * d.z() * d.z();
      right += w * center - (along * d.dot(center)) * d;
    }
    const double a = yy * zz - yz * yz, b = xz * yz - xy * zz, c = xy * yz - xz * yy;
    const double determinant = xx * a + xy * b + xz * c;
    if (!(determinant > 0)) return std::nullopt;
    const double e = xx * zz - xz * xz, f = xy * xz - xx * yz, g = xx * yy - xy * xy;
    covariance << a, b, c, b, e, f, c, f, g;
    covariance /= determinant;
    found.point = covariance * right;
    change = 0;
    for (size_t i = 0; i < sights.size(); ++i) {
      const double before = std::exchange(depth[i], sights[i].view->axis.dot(found.point - sights[i].view->center));
      if (!(depth[i] > 0)) return std::nullopt;
      change = std::max(change, std::abs(depth[i] - before) / before);
    }
  }
  for (size_t i = 0; i < sights.size(); ++i) {
    const Eigen::Vector3d off = (found.point - sights[i].view->center) / depth[i] - sights[i].direction;
    found.residual_px = std::max(found.residual_px, off.norm() * sights[i].view->focal);
  }
  // The largest standard deviation of any direction, by powers: depth is far less certain than the rest.
  Eigen::Index largest = 0;
  covariance.diagonal().maxCoeff(&largest);
  const Eigen::Vector3d direction = covariance * covariance.col(largest);
  found.sigma_m = std::sqrt(direction.dot(covariance * direction) / direction.squaredNorm());
  return found;
}

}  // namespace

Result<RangeScan> triangulate(const Rig& rig, std::span<const ProjectorCoordinates> views, int width, int height,
                              const TriangulationOptions& options, const Work& work) {
  const CalibratedView* projector = rig.projector ? &*rig.projector : nullptr;
  if (views.size() + (projector != nullptr ? 1 : 0) < 2)
    return Error{ErrorCode::too_few_views, "structured light needs two cameras, or one and a calibrated projector"};
  if (projector != nullptr && (projector->intrinsics.width != width || projector->intrinsics.height != height))
    return Error{ErrorCode::invalid_argument,
                 "the Gray-code pattern is not as large as the calibrated projector's image"};
  constexpr size_t most_views = most_sights - 1;  // more add nothing
  if (views.size() > most_views) views = views.first(most_views);

  struct Source {
    View view;
    RayTable rays;
    FloatImage map;
  };
  std::vector<Source> sources;
  for (const ProjectorCoordinates& view : views) {
    const RigCamera* camera = rig.find(view.camera);
    if (camera == nullptr) return Error{ErrorCode::not_found, "the rig has no camera " + view.camera};
    const Eigen::Vector2d last(view.position.width - 1, view.position.height - 1);
    const Eigen::Vector2d origin = view.origin.cast<double>();
    sources.push_back({View(*camera), RayTable(*camera, {origin, origin + last}), {}});
  }
  work.parallel_for(sources.size(), 1, [&](size_t begin, size_t end) {
    for (size_t s = begin; s < end; ++s) sources[s].map = invert(views[s], width, height);
  });
  if (work.stopped()) return Work::cancelled();
  std::optional<Source> lights;
  if (projector != nullptr) {
    const Eigen::AlignedBox2d whole(Eigen::Vector2d::Zero(), Eigen::Vector2d(width, height));
    lights.emplace(Source{View(*projector), RayTable(*projector, whole), {}});
  }
  const auto sight = [](const Source& source, const Eigen::Vector2d& pixel, double sigma_px) {
    return Sight{&source.view, source.rays.at(pixel), sigma_px / source.view.focal};
  };
  const auto sights_of = [&](int x, int y, std::vector<Sight>* sights) {
    sights->clear();
    for (const Source& source : sources)
      if (const float* at = source.map.pixel(x, y); !std::isnan(at[0]))
        sights->push_back(sight(source, Eigen::Vector2d(at[0], at[1]), at[2]));
  };

  // A subject that moves is lit elsewhere when its rows are shown than when its columns are. Cameras have been brought
  // to one moment; what they measure without the projector says by how much its coordinates are off.
  constexpr double noticeable_px = 0.4;
  Eigen::Vector2d lit_off = Eigen::Vector2d::Zero();
  if (projector != nullptr && sources.size() > 1 &&
      std::any_of(views.begin(), views.end(), [&](const auto& view) { return view.motion_px > noticeable_px; })) {
    std::array<std::vector<double>, 2> off;
    constexpr int stride = 7;
    for (int y = 0; y < height; y += stride)
      for (int x = 0; x < width; x += stride) {
        std::vector<Sight> sights;
        sights_of(x, y, &sights);
        const auto found = sights.size() < 2 ? std::nullopt : meet(sights, rig.volume.center());
        if (!found || found->residual_px > options.most_residual_px) continue;
        const auto lit = project(*projector, found->point);
        if (!lit) continue;
        off[0].push_back(lit->x() - x);
        off[1].push_back(lit->y() - y);
      }
    constexpr size_t fewest = 50;
    for (size_t axis = 0; axis < 2 && off[0].size() >= fewest; ++axis) {
      const auto middle = off[axis].begin() + static_cast<std::ptrdiff_t>(off[axis].size() / 2);
      std::nth_element(off[axis].begin(), middle, off[axis].end());
      lit_off[static_cast<Eigen::Index>(axis)] = *middle;
    }
  }

  RangeScan scan(width, height);
  constexpr size_t row_grain = 16;
  work.parallel_for(static_cast<size_t>(height), row_grain, [&](size_t begin, size_t end) {
    std::vector<Sight> sights;
    for (int y = static_cast<int>(begin); y < static_cast<int>(end) && !work.stopped(); ++y) {
      Eigen::Vector3d near = rig.volume.center();  // the last point of the row
      for (int x = 0; x < width; ++x) {
        sights_of(x, y, &sights);
        if (sights.empty()) continue;
        constexpr double projector_sigma_px = 0.02;  // the pixel is exact; its calibration is not
        if (lights) sights.push_back(sight(*lights, Eigen::Vector2d(x, y) + lit_off, projector_sigma_px));
        if (sights.size() < 2) continue;
        auto found = meet(sights, near);
        if (sights.size() > 2 && (!found || found->residual_px > options.most_residual_px)) {
          // One of them decoded wrongly: the pair with the last sight (the projector's, if any) that meets best.
          found.reset();
          for (size_t i = 0; i + 1 < sights.size(); ++i) {
            const std::array<Sight, 2> pair{sights[i], sights.back()};
            const auto other = meet(pair, near);
            if (other && (!found || other->residual_px < found->residual_px)) found = other;
          }
        }
        if (!found || found->residual_px > options.most_residual_px || found->sigma_m > options.most_sigma_m) continue;
        near = found->point;
        const size_t i = scan.index(x, y);
        scan.points[i] = near.cast<float>();
        scan.sigma_m[i] = static_cast<float>(found->sigma_m);
      }
    }
  });
  if (work.stopped()) return Work::cancelled();
  return scan;
}

}  // namespace booth
