#pragma once

#include <Eigen/Geometry>

#include "pipeline/face/head.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/range_scan.h"
#include "pipeline/types/work.h"

namespace booth {

/// A scan of another scanner, in the rig's frame.
struct PlacedScan {
  Eigen::Isometry3d world_from_scan = Eigen::Isometry3d::Identity();  ///< after the unit was made metres
  double metres_per_unit = 1;                                         ///< 1, or 0.001 for millimetres
  bool in_place = false;  ///< it came in the rig's frame and was left where it is
  double misfit_m = 0;    ///< root of the mean squared distance of its nearer part from the hull's planes
  RangeScan scan;         ///< as seen from `eye`
  Eigen::Vector3f eye = Eigen::Vector3f::Zero();  ///< world frame, metres: in front of the face
};

/// Places another scanner's face on the hull's head and samples it as if seen from in front of the face.
///
/// The unit is metres or millimetres, whichever makes it the size of a face. Where it lies on the head already, it
/// stays: the hull says less about where it belongs than a common calibration. Otherwise it is turned every way a cube
/// can be, and each start is aligned by the iterative closest point method (point to plane, the farther part left out).
///
/// @param scan  a mesh, or a cloud where it has no triangles; any frame
/// @param hull  closed, world frame, metres; what lies above the head's lowest height counts
/// @error no_subject  a size that is neither a face's in metres nor in millimetres, too few points, a fit that is bad
///                    or no better than another one; the message says which
/// Cost: about 0.3 s. Same input, same bytes.
/// Source: Y. Chen, G. Medioni, "Object modelling by registration of multiple range images", IVC 10(3), 1992; trimming:
/// D. Chetverikov et al., "The trimmed iterative closest point algorithm", ICPR 2002.
Result<PlacedScan> place_external_scan(const Mesh& scan, const Mesh& hull, const HeadRegion& head,
                                       const Work& work = {});

}  // namespace booth
