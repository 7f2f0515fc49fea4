#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct VisualHullOptions {
  double voxel_m = 0.005;  ///< distance of the samples, 0.001 … 0.05
  int min_views = 3;       ///< a point inside fewer cameras' images is outside the hull, 1 … the number of cameras
};

/// Whether a camera's silhouette agrees with the others'; see camera_alignment.h.
struct CameraAgreement {
  std::string camera;
  bool moved = false;    ///< it no longer stands where it was calibrated
  double offset_px = 0;  ///< by how much its picture of the subject is off
  double deviation = 0;  ///< in standard deviations; 0 where nobody can tell
};

struct VisualHull {
  Field field;  ///< metres where stored, cut off at two voxels; negative inside, positive on the grid's border
  /// The rig given, with cameras put back that were moved since their calibration.
  std::shared_ptr<const Rig> rig;
  SilhouetteViews views;  ///< the silhouettes that it explains: overruled where a camera was; of cameras in `rig`
  std::vector<std::string> cameras;        ///< ids of the cameras that were used
  std::vector<CameraAgreement> agreement;  ///< of each of these
  std::vector<std::string> warnings;       ///< sentences for an operator
};

/// The largest solid that fits inside every silhouette and inside rig.volume: one connected body without cavities.
///
/// A camera has a say only about points inside its image; where its silhouette is cut off by the image's border, its
/// say fades towards the cut. Silhouettes without any subject are left out; a camera that was moved since its
/// calibration is realigned (see camera_alignment.h); where a camera alone denies what all others see, it is overruled
/// (see contradictions.h). Each with a warning that names the camera.
///
/// @param rig          world frame; only cameras that have a silhouette are used
/// @param silhouettes  at most one a camera, distorted pixels, as captured; the size of the camera's image
/// @return a field over rig.volume, world frame. Between samples it is linear: a surface is off by the distance's
///         curvature over one voxel, not by half a voxel as with binary voxels
/// @error no_subject        nothing is left after carving
/// @error too_few_views     fewer than options.min_views silhouettes of cameras in the rig
/// @error invalid_argument  options out of range, a volume that is empty or too large for the voxel, two
///                          silhouettes of one camera, or a silhouette of another size than its camera's image
/// Cost: grows with the surface (bricks that surely lie inside or outside are settled by one look per camera) and with
/// the length of the outlines. Same input, same bytes, whatever the thread count.
/// Source: A. Laurentini, "The visual hull concept for silhouette-based image understanding", IEEE PAMI 16(2), 1994;
/// distances to sub-pixel outlines instead of binary voxels after M. Tarini et al., "Marching intersections: an
/// efficient approach to shape-from-silhouette", VMV 2002; coarse to fine after R. Szeliski, "Rapid octree
/// construction from image sequences", CVGIP 58(1), 1993.
Result<VisualHull> carve_visual_hull(const Rig& rig, std::span<const Silhouette> silhouettes,
                                     const VisualHullOptions& options, const Work& work = {});

}  // namespace booth
