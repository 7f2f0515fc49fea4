#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

struct DecimationOptions {
  size_t triangles = 20000;  ///< the budget; reached from above where topology allows
};

/// Fewer triangles by collapsing edges in the order of the quadric error, closed and manifold as the input. Of a large
/// mesh slabs are thinned side by side, up to one error at a time, before the order among the last ones is decided in
/// the whole: the same result for any number of threads.
/// Source: M. Garland, P. Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997;
/// link condition: T. Dey et al., "Topology preserving edge contraction", 1999.
Mesh decimate(const Mesh& mesh, const DecimationOptions& options, const Work& work = {});

/// The same with a share of the budget for a part that deserves more detail.
///
/// @param detail        per vertex: 1 in that part
/// @param detail_share  of options.triangles that the part's triangles (all three corners in it) get, 0 … 1; the rest
///                      of the mesh gets the rest
Mesh decimate(const Mesh& mesh, std::span<const uint8_t> detail, double detail_share, const DecimationOptions& options,
              const Work& work = {});

}  // namespace booth
