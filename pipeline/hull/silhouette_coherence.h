#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/work.h"

namespace booth {

/// A small motion of a camera: a rotation vector (radians), then a translation (metres), both in the camera's frame
/// as calibrated: x_camera becomes x_camera + rotation × x_camera + translation.
using PoseChange = Eigen::Matrix<double, 6, 1>;

/// What the ray through one point of a camera's outline says about the calibration. With true silhouettes and a true
/// calibration such a ray touches the hull of the other cameras or runs through it, but never misses it.
struct CoherenceSample {
  /// How the miss changes with the pose of one camera.
  struct Slope {
    size_t view = 0;
    PoseChange px = PoseChange::Zero();  ///< pixels a radian, pixels a metre
  };
  double miss_px = 0;           ///< by how much the ray passes the others' hull; negative where it runs through it
  double noise_px = 1;          ///< of the miss, when every outline has the noise of one pixel of its own camera
  std::array<Slope, 3> slopes;  ///< of the camera itself, and of the one or two others that hold the ray back
};

/// Samples along the outlines of all views. A ray that comes nowhere near the hull, or misses it by far, is none.
///
/// @param hull   carved from the same views; it tells where to look
/// @return in the order of the views
/// Source: C. Hernández, F. Schmitt, R. Cipolla, "Silhouette coherence for camera calibration under circular motion",
/// IEEE PAMI 29(2), 2007; the slopes by the envelope theorem at the point where the largest distance is least.
std::vector<CoherenceSample> sample_coherence(const SilhouetteViews& views, const Field& hull, const Work& work = {});

}  // namespace booth
