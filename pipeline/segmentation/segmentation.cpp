#include "pipeline/segmentation/segmentation.h"
namespace booth { Result<Segmentation> segment(std::span<const Frame>, const Frame&, const SegmentationOptions&, const Work&) { return Error{ErrorCode::unsupported, "pending"}; } }
