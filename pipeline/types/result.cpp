#include "pipeline/types/result.h"

namespace booth {

std::string_view to_string(ErrorCode code) {
  switch (code) {
    case ErrorCode::invalid_argument: return "invalid_argument";
    case ErrorCode::invalid_file: return "invalid_file";
    case ErrorCode::not_found: return "not_found";
    case ErrorCode::io: return "io";
    case ErrorCode::disk_full: return "disk_full";
    case ErrorCode::no_background: return "no_background";
    case ErrorCode::no_subject: return "no_subject";
    case ErrorCode::too_few_views: return "too_few_views";
    case ErrorCode::not_riggable: return "not_riggable";
    case ErrorCode::timeout: return "timeout";
    case ErrorCode::device_lost: return "device_lost";
    case ErrorCode::cancelled: return "cancelled";
    case ErrorCode::busy: return "busy";
    case ErrorCode::invalid_state: return "invalid_state";
    case ErrorCode::unsupported: return "unsupported";
    case ErrorCode::not_calibrated: return "not_calibrated";
    case ErrorCode::not_ready: return "not_ready";
    case ErrorCode::internal: return "internal";
  }
  return "internal";
}

}  // namespace booth
