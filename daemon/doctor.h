#pragma once

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "config/booth_config.h"
#include "pipeline/types/result.h"

namespace booth {

enum class FindingLevel {
  ok,
  warning,  ///< it works, but not as well or not for as long as it could
  problem   ///< something will not work
};
std::string_view to_string(FindingLevel level);

struct Finding {
  std::string check;  ///< a stable word: "disk"
  FindingLevel level = FindingLevel::ok;
  std::string message;  ///< what was seen
  std::string advice;   ///< what to do about it, in a sentence; empty when nothing
};

/// The machine that is examined. Tests bring their own.
struct Machine {
  std::filesystem::path root = "/";  ///< of its file system
  std::chrono::system_clock::time_point now;
  bool clock_synchronised = false;
  /// Bytes that a service may still use on the disk of a folder; nothing: the folder cannot be asked for.
  std::function<std::optional<uint64_t>(const std::filesystem::path&)> free_bytes;
};
Machine this_machine();

/// Looks at what the booth needs of the machine, without the booth running. Changes nothing.
///
/// @param config  an error is the first finding; what depends on the configuration is examined as by default then
/// @return at least one finding for each check, in a fixed order
std::vector<Finding> examine(const Machine& machine, const Result<BoothConfig>& config);

}  // namespace booth
