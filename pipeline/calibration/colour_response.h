#pragma once

#include <Eigen/Core>
#include <span>
#include <string>
#include <vector>

#include "pipeline/calibration/board_view.h"
#include "pipeline/types/image.h"
#include "pipeline/types/shot.h"

namespace booth {

/// How bright one white square of the board is in one picture.
struct WhiteSample {
  std::string camera;
  int pose = 0;                                   ///< of the board, as in BoardView
  int square = 0;                                 ///< x + y · squares_x, from the top left
  Eigen::Array3f light = Eigen::Array3f::Zero();  ///< linear, 0 … 1: red, green, blue; of grey pictures thrice the same
  bool grey = false;                              ///< the picture has one channel
  bool clipped = false;                           ///< overexposed in some channel: `light` tells nothing
};

/// What a picture shows of the board's white: in each white square, the pixels that lie so deep in printed white (the
/// ring around the marker, the marker's white bits) that the picture's blur carries nothing of the black to them. Of
/// each channel's linear light the mean of the middle half, which neither noise nor a small stain moves. Squares
/// without enough such pixels, or too dark to tell, are left out.
///
/// @param view   find_board's of this picture
/// @param image  grey or RGB, sRGB encoded, distorted, as captured
/// @return by ascending square
/// @pre check(board) holds
std::vector<WhiteSample> sample_whites(const BoardView& view, const Image& image, const CalibrationBoard& board);

/// What one camera's pictures are to be multiplied by, in linear light.
struct CameraColour {
  std::string id;
  Eigen::Array3f gain{1, 1, 1};  ///< red, green, blue; 1 unless matched
  bool matched = false;
  int samples = 0;               ///< white squares, overexposed ones aside
  int clipped = 0;               ///< overexposed ones
  double before = 0, after = 0;  ///< distance from the cameras' mean of the same square, share of it, rms
};

struct ColourResponse {
  std::vector<CameraColour> cameras;  ///< in the order asked for
  double before = 0, after = 0;       ///< as of the cameras, over all that are matched
  int samples = 0;                    ///< that were compared
  std::vector<std::string> messages;  ///< sentences for the operator
};

/// Matches the cameras' colours, that is their white balance and gain, by squares that several saw at once:
/// log light(camera, pose, square, channel) = response(camera, channel) + radiance(pose, square, channel),
/// the board taken for matte. Least squares with Huber's weights, iterated, so that a highlight on the board has
/// little say; a sample has one weight for its three channels. The geometric mean over the cameras of each channel's
/// factors is 1; grey cameras get the same factor in all channels and are left out of that mean where others are.
/// The largest group of cameras that squares connect is matched; the others keep 1 and are named, and so is who needs
/// a factor outside the range of RigCamera::colour_gain.
///
/// The exposure, gain and white balance of the cameras must be the same in all poses, and later in use.
/// @param cameras  whose colours are wanted; samples of others are not used
/// @return the same bytes whatever the order of the samples
/// Source: radiometric alignment by exposure and white balance as in D. B. Goldman, "Vignette and exposure calibration
/// and compensation", IEEE PAMI 32(12), 2010, here without vignetting; P. J. Huber, "Robust estimation of a location
/// parameter", Annals of Mathematical Statistics 35(1), 1964.
ColourResponse match_colours(std::span<const std::string> cameras, std::span<const WhiteSample> samples);

}  // namespace booth
