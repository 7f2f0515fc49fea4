#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <vector>

#include "daemon/api/methods.h"
#include "daemon/booth.h"
#include "pipeline/types/result.h"

namespace booth::api {

/// What a request is answered with: a result, and for some methods the bytes of a second frame.
struct Reply {
  nlohmann::json result = nlohmann::json::object();
  std::optional<std::vector<uint8_t>> bytes = {};
};
using Answer = Result<Reply>;

/// Takes the answer of one request, once, from any thread, at once or later.
using Responder = std::function<void(Answer)>;

/// Carries out requests: parameters to a request struct, to the booth, to a reply. Never waits: what has to wait for
/// the disk runs elsewhere and responds later.
class Dispatcher {
 public:
  /// @param shut_down  called when somebody asks for it; from the thread that calls dispatch()
  Dispatcher(Booth& booth, std::function<void()> shut_down) : booth_(booth), shut_down_(std::move(shut_down)) {}

  /// @param params  an object, without `key`
  /// @return what may be answered should the response take long: the change is made, only its traces on the disk are
  ///         not what they should be yet
  std::optional<Reply> dispatch(Method method, const nlohmann::json& params, const Responder& respond);

 private:
  template <class Request>
  static bool refused(const Result<Request>& request, const Responder& respond);
  void on_disk(const Responder& respond, std::function<Answer()> work);

  Answer describe() const;
  Answer status() const;
  Answer metrics() const;
  Answer history(const nlohmann::json& params) const;
  Answer list_jobs(const nlohmann::json& params);
  Answer list_avatars(const nlohmann::json& params);
  std::optional<Reply> start_capture(const nlohmann::json& params, const Responder& respond);
  Answer start_preview(const nlohmann::json& params);
  Answer stop_preview(const nlohmann::json& params);
  Answer learn_background(const nlohmann::json& params);
  void get_avatar(const nlohmann::json& params, const Responder& respond);
  void fetch_avatar(const nlohmann::json& params, const Responder& respond);
  void calibrate(Method method, const nlohmann::json& params, const Responder& respond);
  std::optional<Reply> change_job(Method method, const nlohmann::json& params, const Responder& respond);
  std::optional<Reply> remove(Method method, const nlohmann::json& params, const Responder& respond);

  Booth& booth_;
  const std::function<void()> shut_down_;
};

}  // namespace booth::api
