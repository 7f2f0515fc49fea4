#include "daemon/api/json_rpc.h"

#include <utility>

#include "daemon/api/json_values.h"
#include "daemon/api/requests.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;

bool is_id(const Json& id) { return id.is_string() || id.is_number() || id.is_null(); }

}  // namespace

std::optional<Refusal> read_request(std::string_view text, Role role, Request& request) {
  if (text.size() > most_request_bytes)
    return Refusal{invalid_request, "the request has " + std::to_string(text.size()) + " bytes, expected at most " +
                                        std::to_string(most_request_bytes)};
  const Json message = Json::parse(text, nullptr, false);
  if (message.is_discarded()) return Refusal{parse_error, "the request is not JSON in UTF-8"};
  if (message.is_array()) return Refusal{invalid_request, "batches are not offered: send one request per message"};
  if (!message.is_object()) return Refusal{invalid_request, "a request is a JSON object"};
  const auto id = message.find("id");
  if (id != message.end()) {
    if (!is_id(*id)) return Refusal{invalid_request, "id: expected a text or a number"};
    request.id = *id;
  }
  const auto version = message.find("jsonrpc");
  if (version == message.end() || *version != "2.0") return Refusal{invalid_request, "jsonrpc: expected \"2.0\""};
  const auto method = message.find("method");
  if (method == message.end() || !method->is_string()) return Refusal{invalid_request, "method: expected a text"};

  request.notification = id == message.end();
  request.method = find_method(method->get_ref<const std::string&>());
  if (request.method == nullptr) return Refusal{unknown_method, "there is no method " + to_text(*method)};
  if (!may(role, request.method->method))
    return Refusal{forbidden, "a key of the role " + std::string(to_string(role)) + " may not call " +
                                  std::string(request.method->name) + "; the role " +
                                  std::string(to_string(least_role(request.method->method))) + " may"};
  const RpcError invalid_params = rpc_error(ErrorCode::invalid_argument);
  if (const auto params = message.find("params"); params != message.end()) request.params = *params;
  if (!request.params.is_object()) return Refusal{invalid_params, "params: expected an object"};
  if (request.method->changes) {
    auto key = take_key(request.params);
    if (!key) return Refusal{invalid_params, key.error().message};
    request.key = std::move(*key);
  }
  return std::nullopt;
}

std::string error_text(const Json& id, const RpcError& error, const std::string& message) {
  return to_text({{"jsonrpc", "2.0"},
                  {"id", id},
                  {"error", {{"code", error.code}, {"message", message}, {"data", {{"kind", error.kind}}}}}});
}

std::string result_text(const Json& id, const Json& result) {
  return to_text({{"jsonrpc", "2.0"}, {"id", id}, {"result", result}});
}

}  // namespace booth::api
