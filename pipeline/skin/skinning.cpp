#include "pipeline/skin/skinning.h"
namespace booth { Result<Skin> compute_skin(const Mesh&, const Skeleton&, const SkinningOptions&, const Work&) { return Error{ErrorCode::unsupported, "pending"}; } }
