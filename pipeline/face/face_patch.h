#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <vector>

#include "pipeline/face/head_fit.h"
#include "pipeline/face/scan_mesh.h"
#include "pipeline/types/mesh.h"

namespace booth {

/// The part of a fitted head that takes the place of the hull's face.
struct FacePatch {
  Mesh mesh;                          ///< open, world frame, metres
  std::vector<uint32_t> head_vertex;  ///< per vertex: which of the fitted head's it is
  std::vector<float> weight;  ///< per vertex, 0 … 1: falls to 0 towards the rim and around what covers the face
  /// Where the weight is nearly 1, as a scan: for merge_face.
  ScanMesh core;
  /// In front of the face, a little below its middle: it sees the patch's hollows, nostrils included. World frame.
  Eigen::Vector3f eye = Eigen::Vector3f::Zero();
};

struct FacePatchOptions {
  double blend_m = 0.010;             ///< over which the weight falls, 0.002 … 0.05 metres
  double smallest_cover_m2 = 0.0006;  ///< what covers less of the face is noise of the hull, square metres
};

/// The face of a fitted head without what lies under hair, glasses or hands.
FacePatch face_patch(const FittedHead& head, const FacePatchOptions& options = {});

}  // namespace booth
