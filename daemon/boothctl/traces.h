#pragma once

#include <functional>

namespace CLI {
class App;
}

namespace booth {

/// Adds `boothctl traces`: searches the state directory and logs for what is left of a person, without boothd. Fails
/// when there is something.
/// @param json, run  as add_keys_command's
void add_traces_command(CLI::App& app, const bool& json, std::function<void()>& run);

}  // namespace booth
