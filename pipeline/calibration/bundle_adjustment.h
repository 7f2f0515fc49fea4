#pragma once

#include <Eigen/Geometry>
#include <limits>
#include <vector>

#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// One corner of the target in one device's image.
struct BundleObservation {
  int device = 0;
  int board = 0;                                             ///< index into Bundle::world_from_board
  int corner = 0;                                            ///< id
  Eigen::Vector3d p_board = Eigen::Vector3d::Zero();         ///< metres
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();           ///< measured, distorted
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Identity();  ///< px²
  bool outlier = false;                                      ///< has no say
};

/// Devices, places of the board, and what ties them.
struct Bundle {
  std::vector<Intrinsics> intrinsics;  ///< by device; skew is taken as 0
  std::vector<Eigen::Isometry3d> camera_from_world;
  std::vector<Eigen::Isometry3d> world_from_board;
  std::vector<BundleObservation> observations;
  int fixed_device = 0;  ///< its pose stays: it holds the world frame
};

/// What the devices are believed to be before anything is seen, as standard deviations around: principal point in the
/// image's middle, no distortion. It decides what the views leave open and yields to what they tell.
struct BundlePriors {
  double principal_point = 0.5;          ///< of the image's width and height
  double k1 = 0.3, k2 = 0.2, k3 = 0.05;  ///< lenses of booths stay well within
  double tangential = 0.0015;            ///< p1, p2

  /// Nothing is believed.
  static BundlePriors none() {
    constexpr double anything = std::numeric_limits<double>::infinity();
    return {anything, anything, anything, anything, anything};
  }
};

struct BundleOptions {
  BundlePriors priors;
  double loss_scale =
      3;  ///< standard deviations from which on an observation's pull grows no further; 0: plain least squares
  int most_iterations = 100;
};

/// The residual in pixels, projected minus measured; NaN where the point is behind the device.
Eigen::Vector2d residual(const Bundle& bundle, const BundleObservation& observation);

/// Moves everything to where the observations agree best: Levenberg–Marquardt over all intrinsics, poses of devices
/// and of the board, with a Cauchy loss where
/// one is asked for. One thread, fixed order: the same bytes each time.
/// @error cancelled; internal  the adjustment found no finite solution
Result<void> adjust(Bundle& bundle, const BundleOptions& options, const Work& work = {});

/// How certain a device is.
struct DeviceCovariance {
  Eigen::Matrix3d center = Eigen::Matrix3d::Zero();    ///< of the optical centre, m², world frame
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Zero();  ///< of small turns in the camera frame, rad²
  Eigen::Matrix4d pinhole = Eigen::Matrix4d::Zero();   ///< of fx, fy, cx, cy, px²
};

/// By device, at the solution, from the inverse of the normal equations; poses relative to the devices as a whole, that
/// is up to a rigid motion that brings their centres closest.
/// @param variance  of an observation's residual in units of its covariance
/// @error internal  the normal equations are singular
/// Cost: cubic in the number of devices and poses.
Result<std::vector<DeviceCovariance>> device_covariances(const Bundle& bundle, const BundlePriors& priors,
                                                         double variance);

}  // namespace booth
