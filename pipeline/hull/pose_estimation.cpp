#include "pipeline/hull/pose_estimation.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <numbers>

namespace booth {
namespace {

/// The noise of a miss, in pixels times its noise_px: from wide, so that a camera that is many pixels off still pulls,
/// to the accuracy of outlines and lenses.
constexpr double widest_noise = 2.0;
constexpr double narrowing = 0.75;  ///< a round
constexpr double noise = 0.3;
constexpr int rounds = 12;
constexpr int wide_rounds = 4;
/// Shares of the samples. Measured on standing people seen by 8 to 12 cameras: 0.13 touch.
constexpr double touching_share = 0.15;
constexpr double outlying_share = 0.02;
constexpr double outlier_range = 40;  ///< over which outliers spread
constexpr double least_surplus = 0.5;
/// Keeps every sample a little curvature, so that each round is solvable.
constexpr double least_weight = 0.05;

/// log of the normal distribution function; beyond, its leading term.
double log_normal_cdf(double z) {
  constexpr double deepest = -30;
  if (z < deepest) return -z * z / 2 - std::log(-z * std::sqrt(2 * std::numbers::pi));
  return std::log(std::erfc(-z / std::numbers::sqrt2) / 2);
}

struct Pull {
  double force;      ///< minus the derivative of the log likelihood
  double curvature;  ///< positive, its weight in least squares
  double touching;   ///< probability
};

/// The mixture's pull on a residual.
Pull pull_of(double residual, double sigma, double surplus) {
  const double log_root = std::log(std::sqrt(2 * std::numbers::pi));
  const double touch =
      std::log(touching_share) - residual * residual / (2 * sigma * sigma) - std::log(sigma) - log_root;
  const double z = -residual / sigma - sigma / surplus;
  const double log_cdf = log_normal_cdf(z);
  const double tail = std::log(1 - touching_share - outlying_share) - std::log(surplus) +
                      sigma * sigma / (2 * surplus * surplus) + residual / surplus + log_cdf;
  const double outlier = std::log(outlying_share / outlier_range);
  const double most = std::max({touch, tail, outlier});
  const double p_touch = std::exp(touch - most), p_tail = std::exp(tail - most), p_outlier = std::exp(outlier - most);
  const double all = p_touch + p_tail + p_outlier;
  const double hazard = std::exp(-z * z / 2 - log_root - log_cdf);
  const double force = (p_touch * residual / (sigma * sigma) + p_tail * (hazard / sigma - 1 / surplus)) / all;
  const double full = 1 / (sigma * sigma);
  constexpr double flat = 1e-6;
  const double curvature = std::abs(residual) > flat ? std::clamp(force / residual, least_weight * full, full) : full;
  return {force, curvature, p_touch / all};
}

}  // namespace

PoseEstimation::PoseEstimation(std::span<const CoherenceSample> samples, std::vector<PoseScale> cameras)
    : samples_(samples), cameras_(std::move(cameras)), surplus_(cameras_.size(), least_surplus) {
  std::vector<double> sums(cameras_.size()), counts(cameras_.size());
  for (const CoherenceSample& sample : samples_) {
    if (sample.miss_px >= 0) continue;
    sums[sample.slopes[0].view] -= sample.miss_px / sample.noise_px;
    counts[sample.slopes[0].view] += 1;
  }
  for (size_t v = 0; v < cameras_.size(); ++v)
    if (counts[v] > 0) surplus_[v] = std::max(least_surplus, sums[v] / counts[v]);
}

Eigen::VectorXd PoseEstimation::residuals(const Eigen::VectorXd& px) const {
  Eigen::VectorXd all(static_cast<Eigen::Index>(samples_.size()));
  for (size_t n = 0; n < samples_.size(); ++n) {
    const CoherenceSample& sample = samples_[n];
    double miss_px = sample.miss_px;
    for (const CoherenceSample::Slope& slope : sample.slopes)
      miss_px +=
          slope.px.cwiseQuotient(cameras_[slope.view].px).dot(px.segment<6>(static_cast<Eigen::Index>(6 * slope.view)));
    all[static_cast<Eigen::Index>(n)] = miss_px / sample.noise_px;
  }
  return all;
}

PoseSolution PoseEstimation::solve(std::span<const double> prior_px, bool narrow) const {
  const auto size = static_cast<Eigen::Index>(6 * cameras_.size());
  Eigen::VectorXd prior(size);
  for (Eigen::Index i = 0; i < size; ++i) {
    const double deviation = prior_px[static_cast<size_t>(i / 6)];
    prior[i] = 1 / (deviation * deviation);
  }
  PoseSolution solution{Eigen::VectorXd::Zero(size), {}};
  double sigma = widest_noise;
  const int last = narrow ? rounds : wide_rounds;
  for (int round = 0; round <= last; ++round) {
    const Eigen::VectorXd misses = residuals(solution.px);
    Eigen::MatrixXd squares = Eigen::MatrixXd::Zero(size, size);
    Eigen::VectorXd right = -prior.cwiseProduct(solution.px);
    for (size_t n = 0; n < samples_.size(); ++n) {
      const CoherenceSample& sample = samples_[n];
      const Pull pull = pull_of(misses[static_cast<Eigen::Index>(n)], sigma, surplus_[sample.slopes[0].view]);
      // In the last round, what the samples that touch tell: the others know only one side.
      const double weight = round == last ? pull.touching / (sigma * sigma) : pull.curvature;
      std::array<PoseChange, 3> rows;
      for (size_t s = 0; s < rows.size(); ++s)
        rows[s] = sample.slopes[s].px.cwiseQuotient(cameras_[sample.slopes[s].view].px) / sample.noise_px;
      for (size_t a = 0; a < rows.size(); ++a) {
        const auto at = static_cast<Eigen::Index>(6 * sample.slopes[a].view);
        right.segment<6>(at) -= pull.force * rows[a];
        for (size_t b = 0; b < rows.size(); ++b)
          squares.block<6, 6>(at, static_cast<Eigen::Index>(6 * sample.slopes[b].view)) +=
              weight * rows[a] * rows[b].transpose();
      }
    }
    squares.diagonal() += prior;
    if (round == last) {
      solution.information = std::move(squares);
    } else {
      solution.px += squares.llt().solve(right);
      if (narrow) sigma = std::max(noise, sigma * narrowing);
    }
  }
  return solution;
}

PoseChange PoseEstimation::change(const PoseSolution& solution, size_t camera) const {
  return solution.px.segment<6>(static_cast<Eigen::Index>(6 * camera)).cwiseQuotient(cameras_[camera].px);
}

std::vector<PoseScale> pose_scales(std::span<const CalibratedView* const> cameras, const Eigen::Vector3d& center,
                                   std::span<const CoherenceSample> samples) {
  std::vector<std::vector<double>> noises(cameras.size());
  for (const CoherenceSample& sample : samples) noises[sample.slopes[0].view].push_back(sample.noise_px);
  std::vector<PoseScale> scales(cameras.size());
  for (size_t v = 0; v < cameras.size(); ++v) {
    constexpr double nearest_m = 0.1;
    const double focal_px = cameras[v]->intrinsics.fx;
    const double distance_m = std::max(nearest_m, (center - cameras[v]->center()).norm());
    scales[v].px << Eigen::Vector3d::Constant(focal_px), Eigen::Vector3d::Constant(focal_px / distance_m);
    if (noises[v].empty()) continue;
    const auto middle = noises[v].begin() + static_cast<std::ptrdiff_t>(noises[v].size() / 2);
    std::nth_element(noises[v].begin(), middle, noises[v].end());
    scales[v].noise_px = *middle;
  }
  return scales;
}

Eigen::Isometry3d changed_pose(const Eigen::Isometry3d& camera_from_world, const PoseChange& change) {
  Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
  const Eigen::Vector3d rotation = change.head<3>();
  if (rotation.norm() > 0)
    motion.linear() = Eigen::AngleAxisd(rotation.norm(), rotation.normalized()).toRotationMatrix();
  motion.translation() = change.tail<3>();
  return motion * camera_from_world;
}

}  // namespace booth
