#pragma once

#include <Eigen/Core>
#include <optional>

#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"

namespace booth {

/// A pinhole view from a camera's own place, without distortion, turned so that `middle` is in its middle and the
/// world's up is up in the image: what a detector of upright faces expects, however the camera is mounted.
///
/// @param middle   world frame, metres
/// @param width_m  how much of the world around the middle it shows, across and up
/// @param pixels   the image's width and height
/// @return nothing where the camera looks at it from above or below so steeply (50° and more) that no face is seen
std::optional<CalibratedView> upright_view(const CalibratedView& camera, const Eigen::Vector3d& middle, double width_m,
                                           int pixels);

/// What the view shows of a picture the camera took, in grey; black where the picture ends. Where the picture is finer
/// than the view, its pixels are averaged; where it is coarser, they are interpolated linearly.
///
/// @param picture  1 or 3 channels, of the camera's size
/// @param view     from upright_view of the same camera
Image render_view(const CalibratedView& camera, const Image& picture, const CalibratedView& view);

/// The same of red less blue in linear light, −1 … 1; 0 where the picture ends and for a picture of 1 channel.
FloatImage render_matte(const CalibratedView& camera, const Image& picture, const CalibratedView& view);

/// Where a pixel of the view lies in the camera's picture, distorted pixels.
std::optional<Eigen::Vector2d> pixel_in_camera(const CalibratedView& camera, const CalibratedView& view,
                                               const Eigen::Vector2d& pixel);

}  // namespace booth
