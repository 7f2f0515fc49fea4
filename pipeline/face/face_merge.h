#pragma once

#include <Eigen/Core>
#include <string>
#include <vector>

#include "pipeline/face/head.h"
#include "pipeline/face/scan_mesh.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// Which way the hull's vertices go to the scan.
enum class FaceMergeMethod {
  sight,   ///< along the rays from where the scan was seen; the surface around it bends to meet it
  radial,  ///< the paper's: along the rays from the head's barycentre; the step is smoothed afterwards
  sewing,  ///< the paper's for a fitted face: cut out and sewn in (face_sewing.h); a scan goes by sight
};

struct FaceMergeOptions {
  FaceMergeMethod method = FaceMergeMethod::sight;
  int subdivisions = 2;  ///< how often the hull's triangles are quartered where the scan is, 0 … 4
  double bridge = 0.15;  ///< width of the zone between scan and hull that bends, of the head's height, 0.02 … 0.5
  double most_move_m = 0.008;  ///< a vertex farther from the scan stays, metres
};

struct FaceMerge {
  Mesh mesh;
  std::vector<uint8_t> face;  ///< per vertex: 1 where the surface was moved
  double moved_m2 = 0;        ///< area that follows the scan, square metres
};

/// Gives the head of a closed mesh the surface of a scan. Vertices are only split and moved, so that the mesh stays
/// closed and a manifold.
///
/// By sight: everything that a scanner measures it sees, so from its eye the scan is met once by every ray, nostrils
/// and the underside of nose and chin included, and the part of the hull that faces the eye is, too. Vertices go along
/// these rays, none past another, so nothing folds. How far the surface beside the scan (and in holes of it) goes
/// continues the scan's displacement smoothly (least bending) and fades within the bridge. Where scan and hull meet,
/// the surface is then smoothed without shrinking, by which the scan's outermost 6 mm lose their lace.
///
/// Radial: vertices of the subdivided region (by the butterfly scheme) go along the rays from the head's barycentre to
/// the outermost surface there. Between the MOVED and the STUCK shore, half a bridge to each side of where the scan
/// ends, each vertex takes the mean of both positions weighted by its distances d_M and d_S to the shores along
/// shortest vertex paths. Where a ray meets the scan more than once (under the nose, at nostrils and ears) detail is
/// lost.
///
/// @param hull  closed, world frame, its facets finer than the bridge
/// @param eye   world frame: where the scan was seen from (the projector)
/// @error no_subject  the scan does not meet the head
/// Source: displacement with least bending: M. Botsch, O. Sorkine, "On linear variational surface deformation methods",
/// TVCG 14(1), 2008; smoothing: G. Taubin, "A signal processing approach to fair surface design", SIGGRAPH 1995.
/// Radial: R. Pagés et al., automatic avatar booth, section 4.2.
Result<FaceMerge> merge_face(const Mesh& hull, const HeadRegion& head, const ScanMesh& scan, const Eigen::Vector3f& eye,
                             const FaceMergeOptions& options = {}, const Work& work = {});

}  // namespace booth
