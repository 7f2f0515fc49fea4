#pragma once

#include <Eigen/Geometry>
#include <span>
#include <string>
#include <vector>

#include "pipeline/structured_light/gray_code.h"
#include "pipeline/structured_light/triangulation.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/range_scan.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

/// What a Gray-code shot left.
struct GrayCodeCapture {
  GrayCodePattern pattern;
  std::vector<FrameSet> sets;  ///< by index; a set lacks the cameras whose image is missing
};

struct StructuredLightOptions {
  GrayCodeOptions decoding;
  TriangulationOptions triangulation;
  int fewest_points = 2000;      ///< below that the scan is refused, 1 … 10^7
  double most_motion_m = 0.006;  ///< the subject's movement during the sequence above which the scan is refused
};

struct StructuredLightScan {
  RangeScan scan;                                 ///< one point a projector pixel, within rig.volume
  Eigen::Vector3f eye = Eigen::Vector3f::Zero();  ///< world frame, metres: the projector's centre or, where it is not
                                                  ///< calibrated, the middle of the cameras
  double motion_m = 0;                ///< how far the subject moved across the line of sight during the sequence
  std::vector<std::string> warnings;  ///< sentences for an operator
};

/// From the images of a Gray-code shot to the surface that the projector lights.
///
/// @param silhouettes  of the body shot, where there are any: what lies well away from the subject is not decoded
/// @param region       world frame, metres: what lies outside is not decoded; the rig's volume is enough
/// A camera that cannot be decoded is left out with a warning.
/// @error no_subject       no camera could be decoded, too few points are left, or the subject moved too far; the
/// message
///                         says which
/// @error too_few_views, invalid_argument  as triangulate
Result<StructuredLightScan> scan_structured_light(const Rig& rig, const GrayCodeCapture& capture,
                                                  std::span<const Silhouette> silhouettes,
                                                  const Eigen::AlignedBox3d& region,
                                                  const StructuredLightOptions& options = {}, const Work& work = {});

}  // namespace booth
