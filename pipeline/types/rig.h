#pragma once

#include <Eigen/Geometry>
#include <array>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// Pinhole intrinsics with OpenCV's five-parameter distortion, for the image as stored.
struct Intrinsics {
  int width = 0;   ///< pixels
  int height = 0;  ///< pixels
  double fx = 0, fy = 0, cx = 0, cy = 0;
  double skew = 0;                                  ///< K(0,1)
  std::array<double, 5> distortion{0, 0, 0, 0, 0};  ///< k1, k2, p1, p2, k3
};

/// A calibrated camera or, as an inverse camera, the projector. Camera frame: +x right, +y down, +z forward.
struct CalibratedView {
  std::string id;
  Intrinsics intrinsics;
  Eigen::Isometry3d camera_from_world = Eigen::Isometry3d::Identity();

  /// The optical centre in the world frame, metres.
  Eigen::Vector3d center() const { return -(camera_from_world.linear().transpose() * camera_from_world.translation()); }
};

enum class CameraRole { body, face };

/// Standard deviations of a calibrated pose in the world frame.
struct PoseUncertainty {
  double center_m = 0;      ///< of the optical centre, along its least certain direction
  double rotation_rad = 0;  ///< about its least certain axis
};

constexpr double least_colour_gain = 0.1;
constexpr double most_colour_gain = 10;

struct RigCamera : CalibratedView {
  CameraRole role = CameraRole::body;
  int mount_rotation_deg = 0;  ///< turning the stored image clockwise by it makes it upright: 0, 90, 180, 270
  /// Factors in linear light, red, green, blue, that make this camera's pictures agree with the others'; each within
  /// least_colour_gain … most_colour_gain.
  Eigen::Array3f colour_gain{1, 1, 1};
  std::optional<double> rms_px;                ///< reprojection error of its calibration
  std::optional<PoseUncertainty> uncertainty;  ///< of its calibration
};

/// The calibrated booth: rig.json. World frame: right-handed, +Y up, floor at y = 0, the subject faces +Z
/// and has the left hand towards +X; metres.
struct Rig {
  std::string name;
  Eigen::AlignedBox3d volume;  ///< where the subject can be
  std::vector<RigCamera> cameras;
  std::optional<CalibratedView> projector;

  /// The camera of that id, or nullptr.
  const RigCamera* find(const std::string& id) const;
};

/// Ids unique and file-name safe, sizes and focal lengths positive, rotations orthonormal, everything finite,
/// colour gains in their range, volume not empty. The message names the camera and the field.
Result<void> check(const Rig& rig);

/// Letters, digits, '-', '_' and '.', at most 64 of them, not starting with '.': safe as a file name and in a topic.
bool is_safe_id(const std::string& id);

}  // namespace booth
