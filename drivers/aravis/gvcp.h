#pragma once

#include <netinet/in.h>

#include <array>
#include <chrono>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "drivers/aravis/aravis_settings.h"
#include "pipeline/types/result.h"

namespace booth {

/// What Aravis does not do of the GigE Vision Control Protocol. Source: AIA, "GigE Vision, Video Streaming and Device
/// Control Over Ethernet Standard", version 2.0, 2011, part 3.

/// The IPv4 address of a host name or of dotted digits.
std::optional<in_addr> resolve_host(const std::string& host);
std::string to_text(in_addr address);
/// The own address from which that one is reached. @error io  no route to it
Result<in_addr> own_address_towards(in_addr address);

/// Whether a camera answers at that address within a third of `patience`, asked up to three times.
bool gvcp_answers(in_addr address, std::chrono::milliseconds patience);

/// An action command: header, keys, mask and, for a scheduled one, the instant.
/// @param request      number of the command, not 0; acknowledges carry it
/// @param action_time  device clock, ns; nothing: at once
std::vector<uint8_t> action_command(const AravisActionSettings& settings, uint16_t request,
                                    std::optional<uint64_t> action_time);

/// The answer to an action command that a camera sent.
struct ActionAcknowledge {
  in_addr from{};
  uint16_t status = 0;  ///< 0: done
};
/// @return nothing where the bytes are no acknowledge of that request
std::optional<ActionAcknowledge> parse_action_acknowledge(const std::vector<uint8_t>& bytes, in_addr from,
                                                          uint16_t request);

/// Sends action commands and listens for their acknowledges.
class ActionSender {
 public:
  /// One socket for each own network address where a destination is the limited broadcast.
  /// @error invalid_argument  a destination that is no host; io  no socket
  static Result<ActionSender> create(const AravisActionSettings& settings);
  ActionSender(ActionSender&& other) noexcept;
  ActionSender& operator=(ActionSender&&) = delete;
  ~ActionSender();

  /// Sends the command to every destination. @error io  nothing could be sent
  Result<void> send(std::optional<uint64_t> action_time);
  /// Collects acknowledges of the last command until these cameras have answered or the time is over. Others on the
  /// network may answer, too.
  std::vector<ActionAcknowledge> await(const std::vector<in_addr>& cameras, std::chrono::milliseconds patience) const;

 private:
  struct Route {
    int socket;
    sockaddr_in to;
  };
  explicit ActionSender(AravisActionSettings settings) : settings_(std::move(settings)) {}
  Result<void> add_route(std::optional<in_addr> from, in_addr to);

  AravisActionSettings settings_;
  std::vector<Route> routes_;
  uint16_t request_ = 0;
};

}  // namespace booth
