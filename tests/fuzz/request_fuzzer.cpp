#include <cstdlib>
#include <functional>
#include <map>
#include <nlohmann/json.hpp>
#include <string>

#include "daemon/api/methods.h"
#include "daemon/api/requests.h"

namespace {

using booth::api::Method;
using Json = nlohmann::json;

/// What a reader makes of parameters: nothing where it accepts them, else why not.
using Reader = std::function<std::string(const Json&)>;

template <class Request>
Reader reader(booth::Result<Request> (*parse)(const Json&)) {
  return [parse](const Json& params) {
    const auto request = parse(params);
    return request ? std::string() : request.error().message;
  };
}

Reader id_reader(const char* member) {
  return [member](const Json& params) {
    const auto request = booth::api::parse_id(params, member);
    return request ? std::string() : request.error().message;
  };
}

const std::map<Method, Reader>& readers() {
  static const std::map<Method, Reader> all{
      {Method::preview_start, reader(booth::api::parse_preview_start)},
      {Method::preview_stop, id_reader("camera")},
      {Method::background_learn, reader(booth::api::parse_background_learn)},
      {Method::calibration_capture, reader(booth::api::parse_calibration_capture)},
      {Method::calibration_solve, reader(booth::api::parse_calibration_solve)},
      {Method::calibration_apply, reader(booth::api::parse_calibration_apply)},
      {Method::calibration_discard, reader(booth::api::parse_calibration_discard)},
      {Method::calibration_restore, reader(booth::api::parse_calibration_restore)},
      {Method::capture_start, reader(booth::api::parse_capture_start)},
      {Method::capture_cancel, id_reader("capture")},
      {Method::capture_delete, id_reader("capture")},
      {Method::job_list, reader(booth::api::parse_job_list)},
      {Method::job_retry, id_reader("job")},
      {Method::job_cancel, id_reader("job")},
      {Method::avatar_list, reader(booth::api::parse_avatar_list)},
      {Method::avatar_get, id_reader("avatar")},
      {Method::avatar_fetch, reader(booth::api::parse_avatar_fetch)},
      {Method::avatar_delete, id_reader("avatar")}};
  return all;
}

}  // namespace

/// A request is accepted, or refused in one line that says why; what is accepted without its key is accepted again.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const Json message = Json::parse(data, data + size, nullptr, false);
  if (!message.is_object()) return 0;
  const auto name = message.find("method"), given = message.find("params");
  if (name == message.end() || !name->is_string() || given == message.end() || !given->is_object()) return 0;
  const auto* method = booth::api::find_method(name->get_ref<const std::string&>());
  if (method == nullptr) return 0;
  Json params = *given;
  if (method->changes) {
    const auto key = booth::api::take_key(params);
    if (!key && key.error().message.empty()) std::abort();
    if (key && params.contains("key")) std::abort();
  }
  const auto found = readers().find(method->method);
  const Reader read = found == readers().end() ? reader(booth::api::parse_no_params) : found->second;
  const std::string refusal = read(params);
  if (refusal.find('\n') != std::string::npos) std::abort();
  if (refusal != read(params)) std::abort();
  return 0;
}
