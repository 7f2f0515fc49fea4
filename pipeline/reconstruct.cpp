#include "pipeline/reconstruct.h"
namespace booth { Result<Reconstruction> reconstruct(const CaptureFrames&, const ReconstructionOptions&, const Work&, const StageProgress&) { return Error{ErrorCode::unsupported, "pending"}; } }
