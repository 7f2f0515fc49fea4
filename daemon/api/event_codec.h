#pragma once

#include <string>
#include <vector>

#include "daemon/event.h"

namespace booth::api {

/// The two frames of an event.
struct EncodedEvent {
  std::string topic;
  std::string json;
};
EncodedEvent encode(const NumberedEvent& event, const std::string& boot);

/// Every topic that encode() gives, in the order of the interface's contract.
std::vector<std::string> topics();

}  // namespace booth::api
