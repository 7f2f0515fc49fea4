#pragma once

#include <Eigen/Geometry>
#include <optional>

#include "pipeline/calibration/calibration.h"

namespace booth {

/// The world frame that a board lying face up on the floor gives: origin at its middle, +Y out of its face, +Z towards
/// its bottom edge, +X towards its right one.
Eigen::Isometry3d world_from_floor_board(const CalibrationBoard& board);

/// How one rig lies in the frame of another that has the same cameras.
struct RigAlignment {
  Eigen::Isometry3d target_from_source = Eigen::Isometry3d::Identity();
  double scale = 1;       ///< the target's lengths over the source's
  int cameras = 0;        ///< how many agree on it
  double residual_m = 0;  ///< root mean square distance of their centres after a similarity
};

/// The rigid motion that brings centres and viewing directions of cameras with the same id closest; cameras that moved
/// meanwhile are found as those far off and have no say.
/// @return nothing with no camera in common, or fewer than three that agree and none with a direction
/// Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE PAMI
/// 13(4), 1991.
std::optional<RigAlignment> align_rigs(const Rig& source, const Rig& target);

/// A plausible frame where nothing tells the true one: cameras are mounted upright after mount_rotation_deg, look at
/// the subject, and face cameras stand before it.
Eigen::Isometry3d guess_world(const Rig& source);

}  // namespace booth
