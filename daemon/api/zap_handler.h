#pragma once

#include <chrono>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "daemon/api/curve_keys.h"
#include "daemon/metrics.h"
#include "daemon/pulse.h"

namespace zmq {
class context_t;
}

namespace booth::api {

/// What is answered to one request of the ZeroMQ Authentication Protocol (rfc.zeromq.org/spec/27).
struct ZapAnswer {
  std::string status;  ///< "200": let in; "400": not let in; "500": the request is malformed
  std::string text;
  std::string user_id;  ///< of a client that is let in: its public key
};

/// Frames that are malformed in whatever way get a refusal. Anything but a CURVE key of the directory is refused.
/// @param frames  version, request id, domain, address, identity, mechanism, credentials
ZapAnswer answer_zap(const std::vector<std::string>& frames, const ClientDirectory& clients);

/// The domain that the booth's sockets name.
inline constexpr const char* zap_domain = "booth";

/// Decides who may connect: libzmq asks it for every handshake in its context. A thread of its own, so that no
/// request holds up a handshake, and none the other way round.
class ZapHandler {
 public:
  /// Listens from now on. To be made before any socket of the context is bound with CURVE: without it, libzmq lets
  /// everybody in. Throws zmq::error_t.
  /// @param context, clients, metrics  outlive it
  ZapHandler(zmq::context_t& context, ClientDirectory& clients, Metrics& metrics);
  ~ZapHandler();
  ZapHandler(const ZapHandler&) = delete;
  ZapHandler& operator=(const ZapHandler&) = delete;

  Pulse::TimePoint last_pulse() const;

 private:
  struct Content;
  const std::unique_ptr<Content> content_;
};

}  // namespace booth::api
