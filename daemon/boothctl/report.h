#pragma once

#include <functional>
#include <memory>

#include "daemon/api/client.h"

namespace CLI {
class App;
}

namespace booth {

/// Connects as the options of the command line say. @throw Failure
using Connect = std::function<std::unique_ptr<api::Client>()>;

/// Adds `boothctl report`: packs what support needs, and nothing of the visitors. Works without boothd, with less.
/// @param run  as add_keys_command's
void add_report_command(CLI::App& app, const Connect& connect, std::function<void()>& run);

/// Adds `boothctl metrics`: the booth's measurements, for people and for Prometheus.
/// @param json, run  as add_keys_command's
void add_metrics_command(CLI::App& app, const Connect& connect, const bool& json, std::function<void()>& run);

}  // namespace booth
