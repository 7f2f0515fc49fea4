#pragma once

#include <functional>

namespace CLI {
class App;
}

namespace booth {

namespace api {
class Client;
}

/// Adds `boothctl calibrate`: alone, a guide through a calibration; its subcommands are the single steps, for scripts;
/// with --recording, a calibration from recordings, without boothd.
/// @param json     whether answers are JSON; outlives the parsing
/// @param offline  is set to what the operator asked for, where it needs no booth
/// @param online   likewise, where it does
void add_calibrate_command(CLI::App& app, const bool& json, std::function<void()>& offline,
                           std::function<void(api::Client&)>& online);

}  // namespace booth
