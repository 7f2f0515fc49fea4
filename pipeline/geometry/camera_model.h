#pragma once

#include <Eigen/Core>
#include <optional>

#include "pipeline/types/rig.h"

namespace booth {

/// Pixel coordinates of a point in the camera frame: perspective division, OpenCV's five-parameter distortion
/// (radial k1, k2, k3; tangential p1, p2), intrinsics. (0,0) is the centre of the top-left pixel.
///
/// @return nothing for a point at or behind the camera's plane (z ≤ 1 mm), or so far off the axis that the
///         distortion polynomial has folded back (its radial derivative is not positive) and would bring it
///         into the image falsely
/// Source: OpenCV, "Camera Calibration and 3D Reconstruction", detailed description.
std::optional<Eigen::Vector2d> project_camera_point(const Intrinsics& intrinsics, const Eigen::Vector3d& p_camera);

/// The same for a point in the world frame, metres.
std::optional<Eigen::Vector2d> project(const CalibratedView& view, const Eigen::Vector3d& p_world);

/// The direction (x, y, 1) in the camera frame whose projection is `pixel`, with the distortion inverted by
/// Newton iteration to 1e-10. Pixels beyond the model's fold get the nearest direction the iteration reaches.
Eigen::Vector3d unproject(const Intrinsics& intrinsics, const Eigen::Vector2d& pixel);

/// The unit direction in the world frame of the ray from view.center() through `pixel`.
Eigen::Vector3d world_ray(const CalibratedView& view, const Eigen::Vector2d& pixel);

}  // namespace booth
