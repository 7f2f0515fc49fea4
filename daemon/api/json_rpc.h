#pragma once

#include <cstddef>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <string_view>

#include "daemon/api/errors.h"
#include "daemon/api/methods.h"
#include "daemon/api/roles.h"

namespace booth::api {

/// The longest text of a request.
constexpr size_t most_request_bytes = 64 * 1024;

/// A request that may be carried out; its parameters are yet to be read.
struct Request {
  nlohmann::json id;          ///< null: it has none, or none that can be told
  bool notification = false;  ///< nobody waits for an answer
  const MethodEntry* method = nullptr;
  nlohmann::json params = nlohmann::json::object();  ///< an object, without `key`
  std::optional<std::string> key;
};

/// Why a request is not carried out.
struct Refusal {
  RpcError error;
  std::string message;
};

/// Checks what every request has (jsonrpc.org/specification, without batches), and that the role may make it.
///
/// @param text     what came from the client, any bytes
/// @param request  becomes the request; of one that is refused, its id and whether it is a notification, where these
///                 can be told
std::optional<Refusal> read_request(std::string_view text, Role role, Request& request);

// Answers, on one line.
std::string error_text(const nlohmann::json& id, const RpcError& error, const std::string& message);
std::string result_text(const nlohmann::json& id, const nlohmann::json& result);

}  // namespace booth::api
