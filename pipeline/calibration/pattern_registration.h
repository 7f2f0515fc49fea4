#pragma once

#include <Eigen/Geometry>
#include <vector>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/board_view.h"
#include "pipeline/types/rig.h"

namespace booth {

/// Where the corners of a board really are in a picture, from the lines that meet in each.
///
/// The pattern is drawn into the picture as the given calibration sees it, at the picture's resolution and blur. Along
/// the lines between squares, half a square each way from the corner, the picture is then, to first order, a linear
/// function of that drawing, its powers, its gradient and its Laplacian, and of the light's slope. The least-squares
/// coefficients give the shift of the corner, and a better estimate of the blur; the powers of the drawing take in any
/// camera's response curve. All the pixels along the lines instead of a handful beside the saddle point make a corner
/// several times as certain, as long as the prediction is within half a pixel. What the markers look like has no say:
/// programs that draw boards round their cells to whole pixels.
///
/// @param view  has a crop; its corners are not used, those of the whole board that lie in the crop are tried
/// @param intrinsics, camera_from_board  the prediction; board frame
/// @param blur_px  standard deviation of the picture's blur beyond the pixel's own square; improved
/// @return corners, by id, whose surroundings resemble the pattern; distorted pixels of the whole picture
/// Cost: O(pixels of the crop).
/// Source: B. Lucas, T. Kanade, "An iterative image registration technique with an application to stereo vision",
/// IJCAI 1981, with an appearance model; whole patches as control points: A. Datta, J. Kim, T. Kanade, "Accurate camera
/// calibration using iterative refinement of control points", ICCV workshops 2009.
std::vector<TargetCorner> register_pattern(const BoardPattern& pattern, const BoardView& view,
                                           const Intrinsics& intrinsics, const Eigen::Isometry3d& camera_from_board,
                                           double& blur_px);

}  // namespace booth
