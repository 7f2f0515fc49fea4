#pragma once

#include <span>

#include "pipeline/structured_light/gray_code.h"
#include "pipeline/types/range_scan.h"
#include "pipeline/types/rig.h"

namespace booth {

struct TriangulationOptions {
  double most_residual_px = 1.5;  ///< reprojection error above which a point is dropped, 0.1 … 100
  double most_sigma_m = 0.003;    ///< uncertainty above which a point is dropped, metres
};

/// The surface that the projector lights, one point a projector pixel, from all cameras that decoded it and, where the
/// rig has it calibrated, the projector itself.
///
/// Each camera's positions are turned around: where in the camera's image a projector pixel lies, linear between its
/// four neighbours. The point is then the one whose distances to all these pixels' rays, in units of their
/// uncertainties, are least; two cameras and the projector give three pairs at once. Where they do not meet, the pair
/// that meets best is taken, or none.
///
/// @param rig    world frame; cameras by id
/// @param views  at most one per camera; positions in projector pixels, distorted camera pixels
/// @param width, height  the pattern's size, projector pixels
/// @return points in the world frame, metres
/// @error not_found         a camera that the rig does not have
/// @error too_few_views     one camera and no calibrated projector, or none
/// @error invalid_argument  the pattern's size is not the calibrated projector's
/// Source: R. Hartley, P. Sturm, "Triangulation", CVIU 68(2), 1997 (the weighted linear method).
Result<RangeScan> triangulate(const Rig& rig, std::span<const ProjectorCoordinates> views, int width, int height,
                              const TriangulationOptions& options = {}, const Work& work = {});

}  // namespace booth
