#pragma once

#include <chrono>
#include <memory>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "daemon/api/curve_keys.h"

namespace booth::api {

/// Why a call brought no result.
struct CallError {
  bool unreachable = false;  ///< nobody answered in time
  int code = 0;              ///< of the booth's refusal
  std::string kind, message;
};

struct CallReply {
  nlohmann::json result;
  std::vector<uint8_t> bytes;  ///< of the second frame, where there is one
};

struct ReceivedEvent {
  std::string topic;
  nlohmann::json fields;
  std::vector<uint8_t> bytes = {};  ///< of a preview: its JPEG
};

/// The other side of the interface: one client, for one thread.
class Client {
 public:
  /// Connects when the booth is there; endpoints as in the configuration. Throws std::runtime_error for ones that are
  /// none.
  /// @param credentials  of tcp:// endpoints, which take nobody without
  Client(const std::string& control, const std::string& events, std::chrono::milliseconds patience,
         const std::optional<ClientCredentials>& credentials = std::nullopt);
  ~Client();

  std::variant<CallReply, CallError> call(const std::string& method, const nlohmann::json& params);

  /// From now on, or soon; next_event() waits for what comes.
  void subscribe();
  std::optional<ReceivedEvent> next_event(std::chrono::milliseconds patience);

 private:
  struct Sockets;
  std::unique_ptr<Sockets> sockets_;
  const std::string events_endpoint_;
  const std::chrono::milliseconds patience_;
  uint64_t calls_ = 0;
};

}  // namespace booth::api
