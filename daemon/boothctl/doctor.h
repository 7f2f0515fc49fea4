#pragma once

#include <functional>

namespace CLI {
class App;
}

namespace booth {

/// Adds `boothctl doctor`: examines the machine, without boothd. Fails when there is a problem.
/// @param json, run  as add_keys_command's
void add_doctor_command(CLI::App& app, const bool& json, std::function<void()>& run);

}  // namespace booth
