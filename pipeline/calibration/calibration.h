#pragma once

#include <Eigen/Geometry>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/colour_response.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"
#include "pipeline/types/work.h"

namespace booth {

/// A camera, or the projector, whose calibration is wanted.
struct CalibrationDevice {
  std::string id;
  int width = 0, height = 0;  ///< pixels
  CameraRole role = CameraRole::body;
  int mount_rotation_deg = 0;
  bool projector = false;  ///< an inverse camera
};

/// The devices of a rig, its projector last.
std::vector<CalibrationDevice> calibration_devices(const Rig& rig);

struct CalibrationInput {
  std::vector<CalibrationDevice> devices;
  CalibrationBoard board;
  std::vector<BoardView> views;     ///< of the devices, in any order; at most one a device and pose
  std::vector<WhiteSample> whites;  ///< of the cameras' pictures of the board; none: colours are not matched
  std::optional<int> floor_pose;    ///< the pose of the board laid on the floor: it gives the world frame
  std::optional<Rig> previous;      ///< the world frame otherwise, the volume, and the scale to compare with
};

struct CalibrationOptions {
  bool refine_corners = true;  ///< register the whole printed pattern around each corner instead of its saddle alone
  /// Ends with least squares over all corners, outliers too, each counting alike, without any belief about lenses: to
  /// compare with other programs, and where the views are many. Otherwise weak priors decide what few views leave open.
  bool plain_least_squares = false;
  int fewest_poses = 3;            ///< fewer distinct poses of the board are refused, 2 … 1000
  double good_rms_px = 0.25;       ///< worst camera's, up to which a calibration is good
  double usable_rms_px = 0.6;      ///< up to which it is usable
  double good_center_m = 0.001;    ///< worst uncertainty of a camera's centre, up to which a calibration is good
  double usable_center_m = 0.004;  ///< up to which it is usable
};

enum class CalibrationVerdict { good, usable, bad };
std::string_view to_string(CalibrationVerdict verdict);

/// A board corner in an image and how far from it the solution puts it.
struct CornerResidual {
  int pose = 0;
  int corner = 0;
  Eigen::Vector2d pixel;     ///< measured
  Eigen::Vector2d residual;  ///< projected minus measured, pixels
  bool outlier = false;      ///< it had no say in the solution
};

/// How well one device was solved.
struct DeviceQuality {
  std::string id;
  bool solved = false;
  double rms_px = 0;  ///< root of the mean squared distance between projected and measured corners, without outliers
  int views = 0, corners = 0, outliers = 0;
  PoseUncertainty pose;                 ///< relative to the rig as a whole
  double focal_sigma_px = 0;            ///< of the mean of fx and fy
  double principal_point_sigma_px = 0;  ///< along its least certain direction
  std::vector<CornerResidual> residuals;
  std::vector<std::string> messages;  ///< what is wrong with this device, sentences
};

struct Calibration {
  Rig rig;                 ///< the solved devices; world frame as in rig.json
  ColourResponse colours;  ///< of the solved cameras; without any where there were no whites
  CalibrationVerdict verdict = CalibrationVerdict::bad;
  std::string reason;                               ///< of the verdict, a sentence
  std::vector<DeviceQuality> devices;               ///< in the order of the input's
  std::vector<int> poses;                           ///< which were used, ascending
  std::vector<Eigen::Isometry3d> world_from_board;  ///< of each of `poses`
  double rms_px = 0;                                ///< over all corners without outliers
  std::vector<std::string> messages;                ///< sentences for the operator, the most important first
};

/// Intrinsics with five-parameter distortion and extrinsics of all devices in one bundle adjustment.
///
/// Each device's intrinsics start from the homographies of its views, its poses from them; relative poses of devices
/// that saw the same pose of the board go through a maximum spanning tree of shared corners, so that no pose needs to
/// be seen by all. Then all intrinsics, extrinsics and board poses are adjusted together with a robust loss; corners
/// far from the result have no say and are reported. With refine_corners the printed pattern around each corner is then
/// registered to the picture as the solution predicts it, and the adjustment repeated.
///
/// World frame: of floor_pose (origin at the board's centre, +Y out of its face, +Z towards its bottom edge), otherwise
/// that in which the previous rig's cameras lie closest, otherwise that of the first pose. The scale is the board's.
///
/// The solved cameras' colours are matched by the board's white, which does not change the verdict: see
/// match_colours.
///
/// A device that cannot be solved is left out of the rig and says why in its DeviceQuality; verdict is then bad.
/// @error invalid_argument  a board or device that is not valid, a view of an unknown device or with wrong corners
/// @error too_few_views     nothing can be solved: the board was never found, in one pose only, all poses coplanar …;
///                          the message says which and what to do
/// @error cancelled
/// Same input, same bytes, whatever the thread count and the order of the views.
/// Source: Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22(11), 2000; B. Triggs et al.,
/// "Bundle adjustment – a modern synthesis", 1999; refinement in the spirit of A. Datta, J. Kim, T. Kanade, "Accurate
/// camera calibration using iterative refinement of control points", ICCV workshops 2009.
Result<Calibration> solve_calibration(const CalibrationInput& input, const CalibrationOptions& options = {},
                                      const Work& work = {});

}  // namespace booth
