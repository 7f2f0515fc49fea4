#pragma once

#include <functional>
#include <memory>
#include <string>

#include "config/booth_config.h"
#include "daemon/booth.h"
#include "daemon/pulse.h"
#include "pipeline/types/result.h"

namespace booth::api {

/// The booth's interface: JSON-RPC 2.0 over ZeroMQ, and its events. One thread of its own serves both sockets.
class Server {
 public:
  /// Binds the sockets; clients are served from then on.
  /// @param booth      outlives the server
  /// @param shut_down  called from the server's thread when a client asks for it; must not wait
  /// @error io  an endpoint cannot be bound; invalid_argument  one that is not allowed
  static Result<std::unique_ptr<Server>> start(const ApiConfig& config, Booth& booth, std::function<void()> shut_down);
  /// Answers what is ready, then closes; clients that do not read lose what they have not read.
  ~Server();
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;

  Pulse::TimePoint last_pulse() const;

 private:
  struct Content;
  explicit Server(std::unique_ptr<Content> content);
  std::unique_ptr<Content> content_;
};

}  // namespace booth::api
