#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <span>
#include <string>
#include <vector>

#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"
#include "pipeline/types/work.h"

namespace booth {

struct GrayCodeOptions {
  /// Between lit and unlit, in standard deviations of a bit's difference, averaged over as many pixels as it is read
  /// from: below that a pixel is not decoded, 1 … 100.
  double min_snr = 3.0;
};

/// Where in a camera's image something is looked for, by square tiles from its top left, and which pixels of the
/// projector's image can light it.
struct SearchTiles {
  static constexpr int size_px = 16;

  int columns = 0, rows = 0;
  std::vector<Eigen::AlignedBox2i> lit_from;  ///< by tile, row by row; corners included; empty: nothing is looked for

  /// Everything in an image of that size, whichever pixel lights it.
  static SearchTiles everywhere(int width, int height);

  Eigen::AlignedBox2i& at(int column, int row) { return lit_from[static_cast<size_t>(row * columns + column)]; }
  const Eigen::AlignedBox2i& at(int column, int row) const {
    return lit_from[static_cast<size_t>(row * columns + column)];
  }
  const Eigen::AlignedBox2i& of_pixel(const Eigen::Vector2i& pixel) const {
    return at(pixel.x() / size_px, pixel.y() / size_px);
  }
};

/// Which point of the projector's image lights each pixel of a camera.
struct ProjectorCoordinates {
  std::string camera;
  Eigen::Vector2i origin{0, 0};       ///< the camera's pixel that (0, 0) of `position` and `sigma` is
  FloatImage position;                ///< 2 channels: column and row in projector pixels, NaN where nothing was decoded
  FloatImage sigma;                   ///< their standard deviation, projector pixels
  size_t decoded = 0;                 ///< pixels with a position
  double blur_px = 0;                 ///< standard deviation of the stripes' blur, projector pixels
  double noise = 0;                   ///< standard deviation of one image, grey levels
  double motion_px = 0;               ///< how far the lit part of the image moved during the sequence, camera pixels
  std::vector<std::string> warnings;  ///< sentences for an operator: images that were missing or contradict the others
};

/// Decodes one camera's Gray-code sequence to sub-pixel projector coordinates.
///
/// Bits come from the sign of pattern minus inverse, which is blind to ambient light, reflectance and light that
/// reaches a pixel by way of other surfaces (it is equal in both). Where one of the two is missing, the other is
/// compared with the mean of lit and unlit. The position between the stripes' edges then comes from the finest four
/// bits' differences relative to the contrast: they are square waves blurred by an amount that is measured over the
/// whole image, and one or another of them is at its steepest nearly everywhere; where only a coarser bit has an edge,
/// that one's difference tells. What is too dim by itself is averaged with its surroundings, as far as the noise, which
/// every pixel's sums of pattern and inverse show, asks for. Where the image of the subject moves during the sequence,
/// all images are moved to where it is when the finest column bit is shown. A plane fitted to each pixel's neighbours
/// that continue it averages the noise; pixels that no neighbours continue are dropped.
///
/// @param frames   of one camera, grey or RGB, index as in recording.json's order; at most one per index
/// @param subject  255 where the camera sees the subject, as large as the images: what lies well away from it is not
///                 decoded; nullptr decodes everything that is lit
/// @param tiles    as large as the images: what is not looked for is not decoded; nullptr decodes everything
/// @return positions for the camera's pixels, distorted as captured; (0,0) is the centre of the projector's first pixel
/// @error invalid_argument  sizes that differ
/// @error unsupported       a pattern without columns or rows, or of more than 65536 of them
/// @error no_subject        images of a bit that cannot be done without are missing, or hardly any pixel is lit
/// Cost: O(images × pixels) in one pass of rows. Same input, same bytes, whatever the thread count.
/// Source: bits and order: S. Inokuchi et al., "Range imaging system for 3-D object recognition", ICPR 1984, as
/// OpenCV's structured_light::GrayCodePattern lays them out; direct and global light: Y. Xu, D. Aliaga, "Robust pixel
/// classification for 3D modeling with structured light", GI 2007; edges between pattern and inverse: M. Trobina,
/// "Error model of a coded-light range sensor", ETH 1995.
Result<ProjectorCoordinates> decode_gray_code(std::span<const Frame> frames, const GrayCodePattern& pattern,
                                              const Image* subject = nullptr, const SearchTiles* tiles = nullptr,
                                              const GrayCodeOptions& options = {}, const Work& work = {});

}  // namespace booth
