#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

/// A point of the calibration target in an image.
struct TargetCorner {
  int id = 0;                                       ///< index into the target's points: of a board, into board_corners
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();  ///< distorted, as captured
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Identity();  ///< px²
};

/// What one camera saw of the target in one place, or which projector pixels lit it there.
struct BoardView {
  std::string camera;                 ///< a camera's id, or the projector's
  int pose = 0;                       ///< views of the same pose were taken at once, of the same place of the board
  std::vector<TargetCorner> corners;  ///< by ascending id, each at most once; empty where the board was not found
  int markers = 0;                    ///< how many were read
  double blur_px = 0;                 ///< standard deviation of the image's blur, pixels; 0 where nothing was found
  bool blurred = false;               ///< too blurred to be used; it has no corners
  std::string message;  ///< a sentence for the operator about what is wrong with the view; empty when nothing is
  Image crop;           ///< 1 channel: the part of the picture that shows the board, for refining its corners
  Eigen::Vector2i crop_origin = Eigen::Vector2i::Zero();  ///< the crop's first pixel in the picture
};

struct BoardDetectionOptions {
  int fewest_corners = 6;     ///< a view with fewer is not used, 4 … 1000
  double most_blur_px = 2.5;  ///< standard deviation of the blur above which a view is not used, 0.5 … 20
};

/// Finds the board in one picture, in any turn, also when it is partly hidden or outside. Seen from behind, or not at
/// all, the view has no corners; that is no error.
///
/// Markers are found by OpenCV's detector; corners between them are predicted by the local homographies of the markers
/// beside them and then found as saddle points of the grey values, with a covariance from the picture's noise and
/// gradient. Corners that are no saddle, or off the pattern of the others, are left out.
///
/// @param image  grey or RGB, distorted, as captured
/// @return a view with `camera` and `pose` as given
/// @error invalid_argument  check(board) fails, or the image is empty
/// Source: markers: S. Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers
/// under occlusion", Pattern Recognition 47(6), 2014; saddle points: W. Förstner, E. Gülch, "A fast operator for
/// detection and precise location of distinct points", ISPRS 1987.
Result<BoardView> find_board(const std::string& camera, int pose, const Image& image, const CalibrationBoard& board,
                             const BoardDetectionOptions& options = {});

/// Where the projector's image meets the corners that a camera saw: its decoded Gray code, at each corner.
///
/// @param camera     the corners in a camera's picture, the board at rest since
/// @param position   2 channels: the projector's column and row that light each pixel of that camera, NaN where unknown
/// @param sigma      1 channel: the standard deviation of each of the two, projector pixels
/// @param projector  its id
/// @return the view of the projector as an inverse camera: corners in projector pixels; those around which too little
///         was decoded are left out
/// @error invalid_argument  position and sigma are not of the same size, or have other channels
Result<BoardView> projector_view(const BoardView& camera, const FloatImage& position, const FloatImage& sigma,
                                 const std::string& projector);

}  // namespace booth
