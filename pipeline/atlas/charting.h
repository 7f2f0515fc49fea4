#pragma once

#include <vector>

#include "pipeline/atlas/unfolding.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// How the surface is cut and laid flat.
enum class Charting {
  /// Every triangle keeps its exact shape; the surface is cut wherever it is curved. Pagés et al., CGF 2015.
  unfolding,
  /// Nearly flat regions, each laid flat as one piece with about 1 % of change in length: far shorter seams, and
  /// smooth outlines that pack tighter. What does not lie flat is unfolded.
  flattening
};

/// Cuts the whole mesh into charts.
///
/// @param clearance_m  least gap between parts of a chart that are not neighbours on the surface
/// @return every triangle in exactly one chart; no two triangles of a chart overlap
std::vector<Chart> cut_into_charts(const Mesh& mesh, Charting charting, double clearance_m, const Work& work = {});

}  // namespace booth
