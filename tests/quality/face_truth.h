#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <vector>

#include "pipeline/types/range_scan.h"

namespace booth::quality {

/// What a face scan should have found: points that one face camera at least and the projector see.
struct FaceTruth {
  std::vector<Eigen::Vector3d> points;     ///< world frame, metres
  std::vector<Eigen::Vector2d> projected;  ///< where the projector lights them, projector pixels
};

/// The points of truth/face/*.npz on the face proper: 20 mm or more before the head joint, from 80 mm below it to 40 mm
/// below the crown, 90 mm to each side. Throws what the standard library throws at files that are none.
FaceTruth read_face_truth(const std::filesystem::path& recording);

struct ScanErrors {
  double coverage = 0;  ///< share of the true points that were measured
  double median_m = 0;  ///< of the distances of measured points from the true ones
  double p95_m = 0;
};

/// A scan of one point a projector pixel against the truth, point by point: between the four of them around where the
/// projector lights a true point, or the nearest.
ScanErrors compare(const RangeScan& scan, const FaceTruth& truth);

}  // namespace booth::quality
