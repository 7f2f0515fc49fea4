#pragma once

#include <functional>

namespace CLI {
class App;
}

namespace booth {

/// Adds `boothctl keys`: makes, lists and revokes the keys of remote clients. Works without boothd, on its files.
/// @param json  whether answers are JSON; outlives the parsing
/// @param run   is set to what the operator asked for
void add_keys_command(CLI::App& app, const bool& json, std::function<void()>& run);

}  // namespace booth
