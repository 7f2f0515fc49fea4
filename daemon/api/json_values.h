#pragma once

#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "daemon/event.h"

namespace booth::api {

/// A value that is not there is null, not absent.
inline nlohmann::json text_or_null(const std::string& text) {
  return text.empty() ? nlohmann::json(nullptr) : nlohmann::json(text);
}

inline nlohmann::json to_json(const Reason& reason) { return {{"kind", reason.kind}, {"message", reason.message}}; }

inline nlohmann::json to_json(const std::vector<Reason>& reasons) {
  nlohmann::json list = nlohmann::json::array();
  for (const Reason& reason : reasons) list.push_back(to_json(reason));
  return list;
}

/// On one line. Bytes that are not UTF-8, as a file name may have, are replaced by U+FFFD.
inline std::string to_text(const nlohmann::json& json) {
  return json.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
}

}  // namespace booth::api
