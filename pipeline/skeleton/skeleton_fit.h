#pragma once

#include <string>
#include <vector>

#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

struct SkeletonOptions {};

struct FittedSkeleton {
  Skeleton skeleton;  ///< the 23 joints of the avatar's contract, world frame, rest = captured pose
  std::vector<std::string> warnings;
};

/// The skeleton of a standing person, found from the shape.
///
/// @param mesh  closed manifold, world frame, facing +Z, standing on y = 0
/// @error not_riggable  the shape has no recognisable head, hands and feet; the message says which and why
Result<FittedSkeleton> fit_skeleton(const Mesh& mesh, const SkeletonOptions& options, const Work& work = {});

}  // namespace booth
