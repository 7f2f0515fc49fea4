#include "daemon/api/requests.h"

#include <algorithm>
#include <limits>
#include <nlohmann/json.hpp>
#include <vector>

namespace booth::api {
namespace {

using Json = nlohmann::json;

constexpr size_t most_shown = 80;  ///< of a refused value, in the message

/// Code points of a text that is valid UTF-8, as all that was parsed from JSON.
size_t count_characters(const std::string& text) {
  return static_cast<size_t>(
      std::count_if(text.begin(), text.end(), [](char c) { return (static_cast<unsigned char>(c) & 0xC0U) != 0x80U; }));
}

std::string shown(const Json& value) {
  std::string text = value.dump(-1, ' ', true, Json::error_handler_t::replace);
  if (text.size() > most_shown) text = text.substr(0, most_shown) + "…";
  return text;
}

/// Reads the members of an object one by one and keeps the first fault.
class Reader {
 public:
  explicit Reader(const Json& params) : params_(params) {}

  std::optional<std::string> text(const char* name, size_t most_characters, const char* expected) {
    const Json* value = find(name);
    if (value == nullptr) return std::nullopt;
    if (value->is_string() && count_characters(value->get_ref<const std::string&>()) <= most_characters)
      return value->get<std::string>();
    refuse(name, *value, expected);
    return std::nullopt;
  }
  std::string required_text(const char* name) {
    constexpr size_t most_characters = 256;
    if (!params_.contains(name)) fail(std::string(name) + ": missing");
    return text(name, most_characters, "a text of at most 256 characters").value_or("");
  }
  std::optional<double> number(const char* name, double least, double most, const char* expected) {
    const Json* value = find(name);
    if (value == nullptr) return std::nullopt;
    if (value->is_number() && value->get<double>() >= least && value->get<double>() <= most)
      return value->get<double>();
    refuse(name, *value, expected);
    return std::nullopt;
  }
  std::optional<bool> flag(const char* name) {
    const Json* value = find(name);
    if (value == nullptr) return std::nullopt;
    if (value->is_boolean()) return value->get<bool>();
    refuse(name, *value, "true or false");
    return std::nullopt;
  }
  std::optional<uint64_t> whole(const char* name, uint64_t least, uint64_t most, const char* expected) {
    const Json* value = find(name);
    if (value == nullptr) return std::nullopt;
    // Written as a whole number and not negative; 1.0 is not.
    if (value->is_number_unsigned() && value->get<uint64_t>() >= least && value->get<uint64_t>() <= most)
      return value->get<uint64_t>();
    refuse(name, *value, expected);
    return std::nullopt;
  }

  /// What was wrong, members that nobody asked for included.
  template <class T>
  Result<T> finish(T request) {
    for (const auto& [name, value] : params_.items())
      if (std::find(asked_.begin(), asked_.end(), name) == asked_.end()) fail(shown(name) + ": unknown parameter");
    if (!fault_.empty()) return Error{ErrorCode::invalid_argument, fault_};
    return request;
  }

 private:
  const Json* find(const char* name) {
    asked_.emplace_back(name);
    const auto found = params_.find(name);
    return found == params_.end() ? nullptr : &*found;
  }
  void refuse(const char* name, const Json& value, const char* expected) {
    fail(std::string(name) + ": " + shown(value) + ", expected " + expected);
  }
  void fail(const std::string& fault) {
    if (fault_.empty()) fault_ = fault;
  }

  const Json& params_;
  std::vector<std::string> asked_;
  std::string fault_;
};

}  // namespace

Result<NoParams> parse_no_params(const Json& params) { return Reader(params).finish(NoParams{}); }

Result<SystemHistory> parse_system_history(const Json& params) {
  Reader reader(params);
  SystemHistory request;
  if (const auto hours = reader.whole("hours", 1, 10000, "1 … 10000")) request.hours = static_cast<int>(*hours);
  if (const auto limit = reader.whole("limit", 1, 500, "1 … 500")) request.limit = *limit;
  return reader.finish(request);
}

Result<PreviewStart> parse_preview_start(const Json& params) {
  Reader reader(params);
  PreviewStart request;
  request.camera = reader.required_text("camera");
  if (const auto fps = reader.whole("fps", 1, 30, "1 … 30")) request.settings.fps = static_cast<int>(*fps);
  if (const auto width = reader.whole("max_width", 1, 65536, "1 … 65536"))
    request.settings.max_width = static_cast<int>(*width);
  return reader.finish(request);
}

Result<BackgroundLearn> parse_background_learn(const Json& params) {
  Reader reader(params);
  BackgroundLearn request;
  if (const auto frames = reader.whole("frames", 1, 100, "1 … 100")) request.frames = static_cast<int>(*frames);
  return reader.finish(request);
}

Result<BoardRequest> parse_calibration_capture(const Json& params) {
  Reader reader(params);
  BoardRequest request;
  request.floor = reader.flag("floor").value_or(request.floor);
  request.patterns = reader.flag("patterns").value_or(request.patterns);
  return reader.finish(request);
}

Result<CalibrationSolve> parse_calibration_solve(const Json& params) {
  Reader reader(params);
  CalibrationSolve request;
  request.keep_unseen = reader.flag("keep_unseen").value_or(request.keep_unseen);
  return reader.finish(request);
}

Result<CalibrationApply> parse_calibration_apply(const Json& params) {
  Reader reader(params);
  CalibrationApply request;
  request.force = reader.flag("force").value_or(request.force);
  return reader.finish(request);
}

Result<CalibrationDiscard> parse_calibration_discard(const Json& params) {
  Reader reader(params);
  CalibrationDiscard request;
  request.shots = reader.flag("shots").value_or(request.shots);
  return reader.finish(request);
}

Result<CalibrationRestore> parse_calibration_restore(const Json& params) {
  Reader reader(params);
  return reader.finish(CalibrationRestore{reader.text("name", 64, "the name of an earlier calibration")});
}

Result<CaptureRequest> parse_capture_start(const Json& params) {
  constexpr size_t most_label = 200;
  constexpr double most_countdown = 60;
  Reader reader(params);
  CaptureRequest request;
  constexpr const char* faces = "\"active\", \"passive\", \"none\" or \"auto\"";
  if (const auto face = reader.text("face", 16, faces)) {
    const auto mode = face_mode_from(*face);
    if (!mode) return Error{ErrorCode::invalid_argument, "face: " + shown(*face) + ", expected " + faces};
    request.face = *mode;
  }
  request.countdown_s = reader.number("countdown_s", 0, most_countdown, "0 … 60").value_or(0);
  request.label = reader.text("label", most_label, "a text of at most 200 characters").value_or("");
  return reader.finish(request);
}

Result<IdParams> parse_id(const Json& params, const char* member) {
  Reader reader(params);
  return reader.finish(IdParams{reader.required_text(member)});
}

Result<JobList> parse_job_list(const Json& params) {
  Reader reader(params);
  return reader.finish(JobList{reader.text("job", 256, "a job's id")});
}

Result<AvatarList> parse_avatar_list(const Json& params) {
  constexpr uint64_t most_avatars = 500;
  Reader reader(params);
  AvatarList request;
  if (const auto limit = reader.whole("limit", 1, most_avatars, "1 … 500")) request.limit = *limit;
  request.before = reader.text("before", 256, "an avatar's id").value_or("");
  return reader.finish(request);
}

Result<AvatarFetch> parse_avatar_fetch(const Json& params) {
  constexpr uint64_t most_offset = std::numeric_limits<int64_t>::max();
  Reader reader(params);
  AvatarFetch request;
  request.avatar = reader.required_text("avatar");
  request.file = reader.required_text("file");
  request.offset = reader.whole("offset", 0, most_offset, "0 … the file's size").value_or(request.offset);
  request.length = reader.whole("length", 0, most_fetch_bytes, "0 … 8388608").value_or(request.length);
  return reader.finish(request);
}

Result<std::optional<std::string>> take_key(Json& params) {
  constexpr size_t most_key = 64;
  const auto found = params.find("key");
  if (found == params.end()) return std::optional<std::string>();
  if (!found->is_string() || found->get_ref<const std::string&>().empty() ||
      count_characters(found->get_ref<const std::string&>()) > most_key)
    return Error{ErrorCode::invalid_argument, "key: " + shown(*found) + ", expected a text of 1 … 64 characters"};
  std::optional<std::string> key = found->get<std::string>();
  params.erase(found);
  return key;
}

}  // namespace booth::api
