#pragma once

#include <string>
#include <vector>

#include "daemon/event.h"
#include "daemon/preview_board.h"

namespace booth::api {

/// The two frames of an event.
struct EncodedEvent {
  std::string topic;
  std::string json;
};
EncodedEvent encode(const NumberedEvent& event, const std::string& boot);

/// The first two frames of a preview's picture; the third is its JPEG.
EncodedEvent encode(const PreviewPicture& picture, const std::string& boot);
std::string preview_topic(const std::string& camera);

/// Every topic that events have, in the order of the interface's contract.
std::vector<std::string> topics();

}  // namespace booth::api
