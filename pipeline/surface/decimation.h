#pragma once

#include <cstddef>

#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

struct DecimationOptions {
  size_t triangles = 20000;  ///< the budget; reached from above where topology allows
};

/// Fewer triangles by collapsing edges in the order of the quadric error, closed and manifold as the input.
/// Source: M. Garland, P. Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997;
/// link condition: T. Dey et al., "Topology preserving edge contraction", 1999.
Mesh decimate(const Mesh& mesh, const DecimationOptions& options, const Work& work = {});

}  // namespace booth
