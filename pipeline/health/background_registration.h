#pragma once

#include <Eigen/Core>

#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"

namespace booth {

/// How far a camera's picture of the booth has moved since its background was learned.
struct BackgroundMotion {
  /// The turn of the camera that would move the picture so, a rotation vector in its own frame: x_camera becomes
  /// x_camera + rotation × x_camera. A camera that was carried sideways seems turned.
  Eigen::Vector3d rotation_rad = Eigen::Vector3d::Zero();
  double growth = 0;    ///< by which share the picture grew about its middle: the camera was carried forwards
  double shift_px = 0;  ///< of the picture, root of the mean square over it
  double sigma_px = 0;  ///< its standard deviation
  /// The motion in standard deviations of what the two pictures leave open and of how far a camera trembles; 0 where
  /// nobody can tell.
  double deviation = 0;
  bool moved = false;  ///< by more than a camera trembles that nobody touched
};

/// Registers a capture to the empty booth that the same camera saw before. What stands still in the booth, its floor,
/// walls and whatever hangs there, moves in the picture of a camera that was knocked, whatever the other cameras see:
/// one capture of one camera is enough.
///
/// The pictures' lightness, without its slow part, which light and shadows change, is registered from coarse to fine
/// by a turn of the camera and a growth of the picture, robustly, so that who hides or shades the background, and
/// things that were moved in it, have little say. How certain the motion is comes from how much the parts of the
/// picture disagree on it: a blank wall tells nothing, and says so.
///
/// @param empty_booth what the camera saw of it before
/// @param frame       of the same camera, size and channels; 8 bit grey or RGB, distorted pixels, as captured
/// @param subject     coverage of the frame's size, above 0 where the subject is; empty: nobody is there
/// @param intrinsics  of the frame's size
/// @error invalid_argument  sizes or channels that differ
/// Cost: O(pixels) once, then a few passes over at most 29,000 samples a level.
/// Source: B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo vision", IJCAI
/// 1981; coarse to fine and robust: M. Black, P. Anandan, "The robust estimation of multiple motions", CVIU 63(1),
/// 1996; the covariance, clustered by parts of the picture: H. White, "A heteroskedasticity-consistent covariance
/// matrix estimator", Econometrica 48(4), 1980.
Result<BackgroundMotion> register_background(const Image& empty_booth, const Frame& frame, const Image& subject,
                                             const Intrinsics& intrinsics);

}  // namespace booth
