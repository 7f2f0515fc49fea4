#pragma once

#include <Eigen/Core>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/work.h"

namespace booth {

/// A point of the hull's surface, world frame.
struct HullSample {
  Eigen::Vector3f position;  ///< metres
  Eigen::Vector3f normal;    ///< unit, outwards
  float slack_m = 0;         ///< how far inside the true surface may be
};

/// At most one sample for each cell of a grid and each of the six directions that the surface faces there.
std::vector<HullSample> sample_hull(const Field& hull, double cell_m);

/// A viewing ray that grazes the hull in one place only, so that it touches the true surface there.
struct GrazingRay {
  size_t sample = 0;                   ///< of the hull, where the ray passes
  Eigen::Vector3f direction{0, 0, 0};  ///< unit
  float begin_m = 0, end_m = 0;        ///< the stretch around the sample on which it grazes the hull
};

/// Fills in the slack. A viewing ray that grazes the hull over a length L touches the true surface somewhere there. The
/// middle is the best guess, a quarter of L its error, and a surface that bends with a radius R has left the ray by
/// s² / 2R at a distance s from the contact. A ray that grazes the hull in two places proves neither.
///
/// @return the rays, in the order of their samples and directions
std::vector<GrazingRay> measure_slack(const Field& hull, const SilhouetteViews& views, std::vector<HullSample>& samples,
                                      const Work& work = {});

}  // namespace booth
