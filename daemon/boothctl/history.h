#pragma once

#include <functional>

#include "daemon/boothctl/report.h"

namespace booth {

/// Adds `boothctl history`: how the booth has been, a line a span of time.
/// @param json, run  as add_keys_command's
void add_history_command(CLI::App& app, const Connect& connect, const bool& json, std::function<void()>& run);

}  // namespace booth
