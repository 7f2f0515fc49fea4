#include "pipeline/geometry/camera_model.h"

#include <Eigen/LU>
#include <cmath>

namespace booth {
namespace {

/// Distorts a normalised image point; fills the Jacobian where one is wanted.
Eigen::Vector2d distort(const std::array<double, 5>& d, const Eigen::Vector2d& p, Eigen::Matrix2d* jacobian = nullptr) {
  const auto [k1, k2, p1, p2, k3] = d;
  const double x = p.x(), y = p.y();
  const double r2 = x * x + y * y;
  const double radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  if (jacobian != nullptr) {
    const double slope = k1 + r2 * (2 * k2 + r2 * 3 * k3);  // d radial / d r²
    (*jacobian)(0, 0) = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x;
    (*jacobian)(0, 1) = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y;
    (*jacobian)(1, 0) = (*jacobian)(0, 1);
    (*jacobian)(1, 1) = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x;
  }
  return {x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y};
}

/// The distorted radius r (1 + k1 r² + k2 r⁴ + k3 r⁶) must grow all the way from the axis to r, or a far point lands
/// inside the image. It does while its derivative 1 + a s + b s² + c s³ by s = r² has no zero there.
bool before_fold(const std::array<double, 5>& d, double r2) {
  const double a = 3 * d[0], b = 5 * d[1], c = 7 * d[4];
  if (1 - r2 * (std::abs(a) + r2 * (std::abs(b) + r2 * std::abs(c))) > 0) return true;  // no terms could do it: usual
  const auto grows = [&](double s) { return 1 + s * (a + s * (b + s * c)) > 0; };
  if (!grows(r2)) return false;
  // It may have folded and unfolded again: look where the derivative is least, at a zero of a + 2 b s + 3 c s².
  const double discriminant = b * b - 3 * a * c;
  if (discriminant < 0) return true;
  const double q = -(b + std::copysign(std::sqrt(discriminant), b));
  const auto grows_at = [&](double s) { return !(s > 0 && s < r2) || grows(s); };  // NaN and infinity are no zeros
  return grows_at(q / (3 * c)) && grows_at(a / q);
}

}  // namespace

std::optional<Eigen::Vector2d> project_camera_point(const Intrinsics& k, const Eigen::Vector3d& p_camera) {
  constexpr double nearest_m = 1e-3;
  if (!(p_camera.z() > nearest_m)) return std::nullopt;
  const Eigen::Vector2d p = p_camera.head<2>() / p_camera.z();
  if (!before_fold(k.distortion, p.squaredNorm())) return std::nullopt;
  const Eigen::Vector2d q = distort(k.distortion, p);
  return Eigen::Vector2d(k.fx * q.x() + k.skew * q.y() + k.cx, k.fy * q.y() + k.cy);
}

std::optional<Eigen::Vector2d> project(const CalibratedView& view, const Eigen::Vector3d& p_world) {
  return project_camera_point(view.intrinsics, view.camera_from_world * p_world);
}

Eigen::Vector3d unproject(const Intrinsics& k, const Eigen::Vector2d& pixel) {
  const double y = (pixel.y() - k.cy) / k.fy;
  const Eigen::Vector2d target((pixel.x() - k.cx - k.skew * y) / k.fx, y);
  Eigen::Vector2d p = target;
  constexpr int most_iterations = 20;
  for (int i = 0; i < most_iterations; ++i) {
    Eigen::Matrix2d jacobian;
    const Eigen::Vector2d residual = distort(k.distortion, p, &jacobian) - target;
    if (residual.squaredNorm() < 1e-20 || std::abs(jacobian.determinant()) < 1e-6) break;
    p -= jacobian.inverse() * residual;
  }
  return {p.x(), p.y(), 1};
}

Eigen::Vector3d world_ray(const CalibratedView& view, const Eigen::Vector2d& pixel) {
  return (view.camera_from_world.linear().transpose() * unproject(view.intrinsics, pixel)).normalized();
}

}  // namespace booth
