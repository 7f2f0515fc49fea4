#pragma once

#include <cstdint>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>

#include "daemon/capture_session.h"
#include "daemon/preview_board.h"
#include "pipeline/types/result.h"

namespace booth::api {

/// The largest piece of a file that avatar.fetch gives.
constexpr uint64_t most_fetch_bytes = 8 * 1024 * 1024;

struct NoParams {};
struct SystemHistory {
  int hours = 24;      ///< back from now
  size_t limit = 100;  ///< samples
};
struct PreviewStart {
  std::string camera;
  PreviewSettings settings;
};
struct BackgroundLearn {
  std::optional<int> frames;
};
struct CalibrationSolve {
  bool keep_unseen = true;
};
struct CalibrationApply {
  bool force = false;
};
struct CalibrationDiscard {
  bool shots = true;
};
struct CalibrationRestore {
  std::optional<std::string> name;
};
/// Of the methods that take one id: of a camera, a capture, a job or an avatar.
struct IdParams {
  std::string id;
};
struct JobList {
  std::optional<std::string> job;
};
struct AvatarList {
  size_t limit = 50;
  std::string before;  ///< empty: from the newest
};
struct AvatarFetch {
  std::string avatar, file;
  uint64_t offset = 0;
  uint64_t length = most_fetch_bytes;
};

// From a JSON object, without `key`, to a request. @error invalid_argument  the member, its value and what would do;
// a member that is missing or that nobody asked for
Result<NoParams> parse_no_params(const nlohmann::json& params);
Result<SystemHistory> parse_system_history(const nlohmann::json& params);
Result<PreviewStart> parse_preview_start(const nlohmann::json& params);
Result<BackgroundLearn> parse_background_learn(const nlohmann::json& params);
Result<BoardRequest> parse_calibration_capture(const nlohmann::json& params);
Result<CalibrationSolve> parse_calibration_solve(const nlohmann::json& params);
Result<CalibrationApply> parse_calibration_apply(const nlohmann::json& params);
Result<CalibrationDiscard> parse_calibration_discard(const nlohmann::json& params);
Result<CalibrationRestore> parse_calibration_restore(const nlohmann::json& params);
Result<CaptureRequest> parse_capture_start(const nlohmann::json& params);
/// @param member  "camera", "capture", "job" or "avatar"
Result<IdParams> parse_id(const nlohmann::json& params, const char* member);
Result<JobList> parse_job_list(const nlohmann::json& params);
Result<AvatarList> parse_avatar_list(const nlohmann::json& params);
Result<AvatarFetch> parse_avatar_fetch(const nlohmann::json& params);

/// The `key` of a request that changes something, taken out of `params`; nothing when it has none.
/// @error invalid_argument  not a text of 1 … 64 characters
Result<std::optional<std::string>> take_key(nlohmann::json& params);

}  // namespace booth::api
