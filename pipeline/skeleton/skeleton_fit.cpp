#include "pipeline/skeleton/skeleton_fit.h"
namespace booth { Result<FittedSkeleton> fit_skeleton(const Mesh&, const SkeletonOptions&, const Work&) { return Error{ErrorCode::unsupported, "pending"}; } }
