#include "pipeline/hull/visual_hull.h"
namespace booth { Result<VisualHull> carve_visual_hull(const Rig&, std::span<const Silhouette>, const VisualHullOptions&, const Work&) { return Error{ErrorCode::unsupported, "pending"}; } }
