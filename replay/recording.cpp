#include "replay/recording.h"
namespace booth { Result<Recording> read_recording(const std::filesystem::path&) { return Error{ErrorCode::unsupported, "pending"}; } }
