#include "pipeline/geometry/point_triangulation.h"

#include <Eigen/Dense>
#include <array>
#include <cmath>
#include <limits>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// Coefficients by rising power.
using Polynomial = std::vector<double>;

Polynomial operator*(const Polynomial& p, const Polynomial& q) {
  Polynomial product(p.size() + q.size() - 1, 0.0);
  for (size_t i = 0; i < p.size(); ++i)
    for (size_t j = 0; j < q.size(); ++j) product[i + j] += p[i] * q[j];
  return product;
}

Polynomial sum(Polynomial p, const Polynomial& q, double factor) {
  if (p.size() < q.size()) p.resize(q.size(), 0.0);
  for (size_t i = 0; i < q.size(); ++i) p[i] += factor * q[i];
  return p;
}

/// The real parts of the zeros, as eigenvalues of the companion matrix.
std::vector<double> real_parts_of_zeros(Polynomial p) {
  double largest = 0;
  for (const double c : p) largest = std::max(largest, std::abs(c));
  constexpr double negligible = 1e-14;
  while (p.size() > 1 && std::abs(p.back()) <= negligible * largest) p.pop_back();
  const auto degree = static_cast<Eigen::Index>(p.size()) - 1;
  if (degree < 1) return {};
  Eigen::MatrixXd companion = Eigen::MatrixXd::Zero(degree, degree);
  for (Eigen::Index i = 0; i + 1 < degree; ++i) companion(i + 1, i) = 1;
  for (Eigen::Index i = 0; i < degree; ++i) companion(i, degree - 1) = -p[static_cast<size_t>(i)] / p.back();
  const Eigen::VectorXcd zeros = companion.eigenvalues();
  std::vector<double> real(static_cast<size_t>(degree));
  for (Eigen::Index i = 0; i < degree; ++i) real[static_cast<size_t>(i)] = zeros[i].real();
  return real;
}

Eigen::Matrix3d cross_matrix(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

/// A view's undistorted image in units of the sighting's sigma, so that noise is the same in both of a pair.
struct UnitNoiseImage {
  explicit UnitNoiseImage(const Sighting& sighting) {
    const Intrinsics& k = sighting.view->intrinsics;
    Eigen::Matrix3d calibration;
    calibration << k.fx, k.skew, k.cx, 0, k.fy, k.cy, 0, 0, 1;
    scaled = Eigen::DiagonalMatrix<double, 3>(1 / sighting.sigma_px, 1 / sighting.sigma_px, 1) * calibration;
    inverse = scaled.inverse();
    point = (scaled * unproject(k, sighting.pixel)).hnormalized();
  }
  Eigen::Matrix3d scaled, inverse;
  Eigen::Vector2d point;
};

/// Takes the point to the origin and the epipole onto the x axis: (1, 0, f). Steps 1 to 5 of the algorithm.
struct EpipolarFrame {
  EpipolarFrame(const Eigen::Vector2d& point, Eigen::Vector3d epipole) {
    Eigen::Matrix3d shift = Eigen::Matrix3d::Identity();
    shift.block<2, 1>(0, 2) = -point;
    epipole = shift * epipole;
    const double length = epipole.head<2>().norm();
    // An epipole at the point itself leaves the direction open: any will do.
    const Eigen::Vector2d axis = length > 0 ? Eigen::Vector2d(epipole.head<2>() / length) : Eigen::Vector2d::UnitX();
    Eigen::Matrix3d turn = Eigen::Matrix3d::Identity();
    turn.block<2, 2>(0, 0) << axis.x(), axis.y(), -axis.y(), axis.x();
    from_image = turn * shift;
    f = length > 0 ? epipole.z() / length : std::numeric_limits<double>::infinity();
  }
  Eigen::Matrix3d from_image;
  double f;
};

/// The point of a line (λ, μ, ν) next to the origin.
Eigen::Vector3d foot_of(const Eigen::Vector3d& line) {
  return {-line.x() * line.z(), -line.y() * line.z(), line.x() * line.x() + line.y() * line.y()};
}

/// The midpoint of two rays' shortest connection.
std::optional<Eigen::Vector3d> meet(const Eigen::Vector3d& a, const Eigen::Vector3d& along_a, const Eigen::Vector3d& b,
                                    const Eigen::Vector3d& along_b) {
  const Eigen::Vector3d across = along_a.cross(along_b);
  const double square = across.squaredNorm();
  constexpr double parallel = 1e-12;
  if (!(square > parallel * along_a.squaredNorm() * along_b.squaredNorm())) return std::nullopt;
  const double s = (b - a).cross(along_b).dot(across) / square;
  const double t = (b - a).cross(along_a).dot(across) / square;
  return (a + s * along_a + b + t * along_b) / 2;
}

bool in_front(const CalibratedView& view, const Eigen::Vector3d& p) { return (view.camera_from_world * p).z() > 0; }

/// The reprojection error by its sigma, and its derivative by the point.
struct Residual {
  Eigen::Vector2d error;
  Eigen::Matrix<double, 2, 3> slope;
};

std::optional<Residual> residual_at(const Sighting& sighting, const Eigen::Vector3d& p) {
  const auto projected = project(*sighting.view, p);
  if (!projected) return std::nullopt;
  Residual residual;
  residual.error = (*projected - sighting.pixel) / sighting.sigma_px;
  const double depth = (sighting.view->camera_from_world * p).z();
  const double step = 1e-5 * depth;  // about a hundredth of a pixel: far above rounding, far below the lens's bends
  for (int axis = 0; axis < 3; ++axis) {
    const Eigen::Vector3d aside = step * Eigen::Vector3d::Unit(axis);
    const auto ahead = project(*sighting.view, p + aside), behind = project(*sighting.view, p - aside);
    if (!ahead || !behind) return std::nullopt;
    residual.slope.col(axis) = (*ahead - *behind) / (2 * step * sighting.sigma_px);
  }
  return residual;
}

struct NormalEquations {
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();
  Eigen::Vector3d gradient = Eigen::Vector3d::Zero();
  double chi_square = 0;
};

std::optional<NormalEquations> normal_equations(std::span<const Sighting> sightings, const Eigen::Vector3d& p) {
  NormalEquations equations;
  for (const Sighting& sighting : sightings) {
    const auto residual = residual_at(sighting, p);
    if (!residual) return std::nullopt;
    equations.information += residual->slope.transpose() * residual->slope;
    equations.gradient += residual->slope.transpose() * residual->error;
    equations.chi_square += residual->error.squaredNorm();
  }
  return equations;
}

/// Squared distance of a sighting from a point's projection in units of its sigma; infinite where it is not seen.
double squared_sigmas(const Sighting& sighting, const Eigen::Vector3d& p) {
  const auto projected = project(*sighting.view, p);
  return projected ? (*projected - sighting.pixel).squaredNorm() / (sighting.sigma_px * sighting.sigma_px)
                   : std::numeric_limits<double>::infinity();
}

}  // namespace

std::optional<Eigen::Vector3d> triangulate_pair(const Sighting& first, const Sighting& second) {
  const UnitNoiseImage image_a(first), image_b(second);
  const Eigen::Isometry3d b_from_a = second.view->camera_from_world * first.view->camera_from_world.inverse();
  if (!(b_from_a.translation().norm() > 0)) return std::nullopt;
  const Eigen::Matrix3d fundamental =
      image_b.inverse.transpose() * cross_matrix(b_from_a.translation()) * b_from_a.linear() * image_a.inverse;
  const EpipolarFrame frame_a(image_a.point, image_a.scaled * b_from_a.inverse().translation());
  const EpipolarFrame frame_b(image_b.point, image_b.scaled * b_from_a.translation());
  if (!std::isfinite(frame_a.f) || !std::isfinite(frame_b.f)) return std::nullopt;
  Eigen::Matrix3d moved = frame_b.from_image.inverse().transpose() * fundamental * frame_a.from_image.inverse();
  moved /= moved.norm();

  // Epipolar lines through the first image are named by t, where they cross its y axis.
  const double f = frame_a.f, g = frame_b.f;
  const double a = moved(1, 1), b = moved(1, 2), c = moved(2, 1), d = moved(2, 2);
  const auto cost = [&](double t) {
    const double first_part = t * t / (1 + f * f * t * t);
    const double up = c * t + d, across = a * t + b;
    return first_part + up * up / (across * across + g * g * up * up);
  };
  // Equation (12.7): t ((at+b)² + f'²(ct+d)²)² − (ad − bc) (1 + f²t²)² (at+b)(ct+d) = 0.
  const Polynomial across{b, a}, up{d, c}, first_length{1, 0, f * f};
  const Polynomial second_length = sum(across * across, up * up, g * g);
  const Polynomial slope = sum(Polynomial{0, 1} * second_length * second_length,
                               first_length * first_length * across * up, -(a * d - b * c));
  const double at_infinity = 1 / (f * f) + c * c / (a * a + g * g * c * c);
  double best = at_infinity;
  std::optional<double> best_t;
  for (const double t : real_parts_of_zeros(slope))
    if (const double s = cost(t); !(s > best)) {
      best = s;
      best_t = t;
    }
  if (!std::isfinite(best)) return std::nullopt;

  const Eigen::Vector3d line_a = best_t ? Eigen::Vector3d(*best_t * f, 1, -*best_t) : Eigen::Vector3d(f, 0, -1);
  const Eigen::Vector3d line_b = best_t ? Eigen::Vector3d(-g * (c * *best_t + d), a * *best_t + b, c * *best_t + d)
                                        : Eigen::Vector3d(-g * c, a, c);
  // From here on the rays meet, so that where is a matter of one intersection.
  const auto world_direction = [](const CalibratedView& view, const UnitNoiseImage& image, const EpipolarFrame& frame,
                                  const Eigen::Vector3d& point) -> Eigen::Vector3d {
    return view.camera_from_world.linear().transpose() *
           (image.inverse * (frame.from_image.inverse() * point)).normalized();
  };
  const auto point = meet(first.view->center(), world_direction(*first.view, image_a, frame_a, foot_of(line_a)),
                          second.view->center(), world_direction(*second.view, image_b, frame_b, foot_of(line_b)));
  if (!point || !point->allFinite() || !in_front(*first.view, *point) || !in_front(*second.view, *point))
    return std::nullopt;
  return point;
}

std::optional<TriangulatedPoint> triangulate_views(std::span<const Sighting> sightings, const Eigen::Vector3d& start) {
  if (sightings.size() < 2) return std::nullopt;
  Eigen::Vector3d p = start;
  auto at = normal_equations(sightings, p);
  if (!at) return std::nullopt;
  double damping = 1e-6;
  constexpr int most_steps = 30;
  constexpr double close_enough_m = 1e-9;
  for (int step = 0; step < most_steps; ++step) {
    Eigen::Matrix3d damped = at->information;
    damped.diagonal() *= 1 + damping;
    const Eigen::Vector3d move = -damped.ldlt().solve(at->gradient);
    if (!move.allFinite()) return std::nullopt;
    const auto there = normal_equations(sightings, p + move);
    if (there && there->chi_square <= at->chi_square) {
      p += move;
      at = there;
      damping /= 10;
    } else {
      damping *= 10;
    }
    if (move.norm() < close_enough_m) break;
  }
  // Directions that no sighting fixes have no inverse.
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(at->information);
  constexpr double widest_sigma_m = 10;
  if (!(axes.eigenvalues()[0] > 1 / (widest_sigma_m * widest_sigma_m))) return std::nullopt;
  return TriangulatedPoint{p, at->information.inverse(), at->chi_square, 2 * static_cast<int>(sightings.size()) - 3};
}

std::optional<ConsensusPoint> triangulate_consensus(std::span<const Sighting> sightings, double most_sigmas) {
  const double most = most_sigmas * most_sigmas;
  size_t best_count = 0;
  double best_error = 0;
  std::optional<Eigen::Vector3d> best;
  for (size_t i = 0; i < sightings.size(); ++i)
    for (size_t j = i + 1; j < sightings.size(); ++j) {
      const auto point = triangulate_pair(sightings[i], sightings[j]);
      if (!point) continue;
      size_t count = 0;
      double error = 0;
      for (const Sighting& sighting : sightings)
        if (const double squared = squared_sigmas(sighting, *point); squared <= most) {
          ++count;
          error += squared;
        }
      if (count < 2 || count < best_count || (count == best_count && error >= best_error)) continue;
      best = point;
      best_count = count;
      best_error = error;
    }
  if (!best) return std::nullopt;

  // The fit may bring further views into agreement, or lose one: until it stays.
  ConsensusPoint consensus;
  constexpr int most_rounds = 5;
  for (int round = 0; round < most_rounds; ++round) {
    std::vector<bool> agrees(sightings.size());
    std::vector<Sighting> kept;
    for (size_t i = 0; i < sightings.size(); ++i) {
      agrees[i] = squared_sigmas(sightings[i], *best) <= most;
      if (agrees[i]) kept.push_back(sightings[i]);
    }
    if (agrees == consensus.agrees) break;
    const auto fitted = triangulate_views(kept, *best);
    if (!fitted) return std::nullopt;
    consensus = {*fitted, std::move(agrees)};
    best = fitted->position;
  }
  return consensus;
}

}  // namespace booth
