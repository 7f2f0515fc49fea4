#pragma once

#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

struct SkinningOptions {};

/// Smooth joint weights, at most four a vertex.
///
/// @param mesh      closed manifold, world frame
/// @param skeleton  at rest in the same frame, inside the mesh
Result<Skin> compute_skin(const Mesh& mesh, const Skeleton& skeleton, const SkinningOptions& options,
                          const Work& work = {});

}  // namespace booth
