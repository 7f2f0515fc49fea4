#pragma once

#include <Eigen/Core>
#include <span>
#include <vector>

#include "pipeline/hull/silhouette_coherence.h"

namespace booth {

/// One camera of an estimation. Its pose is counted in pixels: by how much the subject's picture moves.
struct PoseScale {
  PoseChange px;        ///< pixels a radian (three times), pixels a metre (three times)
  double noise_px = 1;  ///< of its samples, when every outline has the noise of one pixel of its own camera
};

/// What all samples together say about the poses of all cameras.
struct PoseSolution {
  Eigen::VectorXd px;           ///< six a camera, in the order of PoseChange, pixels
  Eigen::MatrixXd information;  ///< of the samples and the priors together, 1 / pixels²
};

/// The changes of all cameras' poses that their silhouettes ask for, in one robust estimation: a sample's miss is
/// noise where its ray touches the subject in a point that other cameras see on their outline too; elsewhere a surplus
/// of the hull lies below it, exponentially distributed; a few samples are anything.
///
/// Source: C. Hernández, F. Schmitt, R. Cipolla (see silhouette_coherence.h) for the constraint; the mixture is solved
/// by iteratively reweighted least squares from a wide to a narrow noise, as in P. J. Rousseeuw, A. M. Leroy, "Robust
/// Regression and Outlier Detection", Wiley 1987.
class PoseEstimation {
 public:
  /// @param samples  their views count the cameras; outlive the estimation
  PoseEstimation(std::span<const CoherenceSample> samples, std::vector<PoseScale> cameras);

  size_t cameras() const { return cameras_.size(); }
  const PoseScale& scale(size_t camera) const { return cameras_[camera]; }

  /// @param prior_px       by camera: the standard deviation that its pose has without any sample
  /// @param narrow  false: with the wide noise only, so that no sample is far off
  PoseSolution solve(std::span<const double> prior_px, bool narrow = true) const;

  /// In physical units. @return the change of a camera's pose that the solution asks for
  PoseChange change(const PoseSolution& solution, size_t camera) const;

 private:
  Eigen::VectorXd residuals(const Eigen::VectorXd& px) const;

  std::span<const CoherenceSample> samples_;
  std::vector<PoseScale> cameras_;
  std::vector<double> surplus_;  ///< by camera: the mean of what lies below a touch, in the noise of its samples
};

/// Scales for views that see a subject around `center`; noise from the samples.
std::vector<PoseScale> pose_scales(std::span<const CalibratedView* const> cameras, const Eigen::Vector3d& center,
                                   std::span<const CoherenceSample> samples);

/// The camera with its pose changed, a rotation again.
Eigen::Isometry3d changed_pose(const Eigen::Isometry3d& camera_from_world, const PoseChange& change);

}  // namespace booth
