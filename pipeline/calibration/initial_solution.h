#pragma once

#include <Eigen/Geometry>
#include <optional>
#include <span>
#include <vector>

#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/bundle_adjustment.h"
#include "pipeline/calibration/calibration.h"

namespace booth {

/// Where one device saw the board in one pose.
struct DeviceView {
  int device = 0;
  int pose = 0;  ///< index into the list of poses
  const BoardView* view = nullptr;
  /// The board in the device's frame: a plane seen from afar has two poses that project nearly alike, the likelier
  /// first.
  std::vector<Eigen::Isometry3d> camera_from_board;
};

/// What a device's own views tell about it.
struct DeviceStart {
  Intrinsics intrinsics;
  double rms_px = 0;    ///< of its views by themselves
  double tilt_rad = 0;  ///< the largest angle between the planes that the board lay in, as seen by the device
};

/// Intrinsics of one device by adjusting its own views, from several focal lengths, and the pose of the board in each.
/// @param views  the device's; their camera_from_board is filled in
/// @param known  intrinsics to begin with, such as a previous calibration's, or nullptr
/// @return nothing where no focal length leads anywhere, or the work was stopped
/// Source: Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22(11), 2000; poses: T. Collins,
/// A. Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109(3), 2014.
std::optional<DeviceStart> start_device(const CalibrationDevice& device, std::span<DeviceView*> views,
                                        const std::vector<Eigen::Vector3d>& on_board, const Intrinsics* known,
                                        const Work& work);

/// Poses of devices and of the board in the frame of one device, through a tree of devices that saw the same poses.
struct Chain {
  int root = -1;                                                    ///< the device whose frame is the world
  std::vector<std::optional<Eigen::Isometry3d>> camera_from_world;  ///< by device; nothing where it is not connected
  std::vector<std::optional<Eigen::Isometry3d>> world_from_board;   ///< by pose
};

/// The maximum spanning tree over corners seen in common, of the connected part that holds the most devices; each of
/// its edges takes the relative pose that the poses of the board seen by both agree on best.
/// @param starts  by device; devices without a start are not connected
Chain chain_devices(std::span<const std::optional<DeviceStart>> starts, std::span<const DeviceView> views, size_t poses,
                    const std::vector<Eigen::Vector3d>& on_board);

}  // namespace booth
