#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/types/field.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct VisualHullOptions {
  double voxel_m = 0.005;  ///< distance of the samples, 0.001 … 0.05
  int min_views = 3;       ///< a point inside fewer cameras' images is outside the hull
};

struct VisualHull {
  Field field;                        ///< metres where stored, negative inside; positive on the grid's border
  std::vector<std::string> cameras;   ///< ids of the cameras that were used
  std::vector<std::string> warnings;
};

/// The largest solid that fits inside every silhouette.
///
/// @param silhouettes  at most one a camera, distorted pixels, as captured
/// @error no_subject     nothing is left after carving
/// @error too_few_views  fewer than options.min_views silhouettes of cameras in the rig
Result<VisualHull> carve_visual_hull(const Rig& rig, std::span<const Silhouette> silhouettes,
                                     const VisualHullOptions& options, const Work& work = {});

}  // namespace booth
