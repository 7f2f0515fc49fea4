#pragma once

#include <vector>

#include "pipeline/types/mesh.h"
#include "pipeline/types/range_scan.h"
#include "pipeline/types/work.h"

namespace booth {

struct ScanMeshOptions {
  double most_gap_m = 0.005;         ///< neighbours farther apart are not joined, metres
  double smallest_region_m2 = 4e-4;  ///< connected regions below that area are strays, square metres
  int narrowest = 3;                 ///< parts narrower than that are lace and dropped, points of the grid; 0: none are
  int smoothing_radius = 3;          ///< of the planes that average noise, points of the grid, 0 … 10
  double largest_hole_m = 0.03;      ///< holes up to the size of an eye are closed, metres
};

/// The scan as an open triangle mesh.
struct ScanMesh {
  Mesh mesh;                      ///< world frame, metres; its triangles all face the same side of the grid
  std::vector<float> confidence;  ///< per vertex, 0 … 1: falls with uncertainty and towards the scan's rims
  std::vector<float> rim_m;       ///< per vertex: distance from the scan's rim over the grid, up to 5 cm
};

/// Neighbouring points joined to triangles. Points that stand off from the plane of their neighbours, narrow parts
/// (lace of grazing light) and regions that hang together with little else are removed; noise is averaged by planes
/// through the neighbours within a few of its own amplitudes, so that edges stay. Holes that are small enough are
/// closed by the smoothest surface (Laplace's) with confidence 0.
Result<ScanMesh> mesh_scan(const RangeScan& scan, const ScanMeshOptions& options = {}, const Work& work = {});

}  // namespace booth
