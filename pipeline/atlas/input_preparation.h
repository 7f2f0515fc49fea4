#pragma once

#include <Eigen/Core>
#include <cmath>
#include <cstdint>
#include <vector>

#include "pipeline/atlas/push_pull.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"

namespace booth {

/// How pixels outside the subject are replaced by colours of the subject.
enum class Inpainting {
  push_pull,  ///< smooth, fast
  telea       ///< A. Telea, "An image inpainting technique based on the fast marching method", JGT 9(1), 2004
};

/// The brightest that a camera delivers, as a sample of a LightImage; the other half of the range is room for gains.
constexpr float full_light = 16383, brightest_light = 32767;

/// What is known about a place between four pixels: this one, that to its right, and the two below.
struct TrustCell {
  float surface_m = 0;  ///< depth of the first surface, the farthest of the four; huge = none
  /// Of the four, first the lowest byte: 255 well inside, falling to 0 at outlines, depth steps and image borders.
  uint32_t confidence = 0;
};

/// What makes a camera's light comparable with the other cameras': factors of linear light.
struct LightCorrection {
  Eigen::Array3f gain = Eigen::Array3f::Ones();  ///< by channel
  /// The logarithm of the factor by which the image's corner is darker than its principal point, for a lens that
  /// darkens with the square of the distance from there; the factor for that square r², 1 at the corner, is
  /// exp(vignetting r²).
  float vignetting = 0;
};

/// What texturing needs of one camera, cropped to the subject. Pixel coordinates are relative to the crop.
struct PreparedView {
  const RigCamera* camera = nullptr;
  /// Of each vertex: pixel x and y, and the depth along the optical axis in metres; a depth of 0 says that the
  /// camera cannot see it (behind it, or too far off the axis).
  std::vector<Eigen::Vector3f> projected;
  LightPyramid
      colours;  ///< times the camera's colour_gain; the rim and the outside of the subject hold colours of its inside
  Raster<TrustCell> trust;  ///< at half the resolution (level 1 of the pyramid)
  Raster<uint16_t> margin;  ///< like `trust`: how far the silhouette's outline is, thirds of a pixel of this map
  int left = 0, top = 0;    ///< of the crop in the image
  LightCorrection balance;  ///< not applied to `colours`

  /// The squared distance of a pixel from the principal point; that of the image's farthest corner is 1.
  float squared_radius(float x, float y) const;
  /// `balance` at a pixel.
  Eigen::Array3f correction_at(float x, float y) const {
    return balance.vignetting == 0 ? balance.gain
                                   : Eigen::Array3f(balance.gain * std::exp(balance.vignetting * squared_radius(x, y)));
  }
};

/// @param frame  grey or RGB, the size of the camera's image; so is the silhouette
/// @param rim_m  how far from outlines and depth steps colours are not trusted, for the error of the surface
PreparedView prepare_view(const Mesh& mesh, const RigCamera& camera, const Frame& frame, const Silhouette& silhouette,
                          double rim_m, Inpainting inpainting);

/// Follows vertices that were moved by little: where they are in the image, not what is seen there.
void project_again(const Mesh& mesh, PreparedView* view);

}  // namespace booth
