#include "daemon/boothctl/traces.h"

#include <CLI/CLI.hpp>
#include <filesystem>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

#include "config/booth_config.h"
#include "daemon/boothctl/command.h"
#include "daemon/trace_search.h"

namespace booth {
namespace {

using Json = nlohmann::json;

struct Options {
  std::string config = "/etc/booth/boothd.toml";
  std::vector<std::string> words, logs;
};

void search(const Options& options, bool json) {
  const auto config = load_config(options.config);
  if (!config) throw Failure{exit_usage, config.error().message};
  const auto found = find_traces(config->booth.state_directory, options.words);
  if (!found) throw Failure{exit_refused, found.error().message};
  std::vector<std::string> paths;
  for (const auto& path : *found) paths.push_back(path.string());
  for (const std::string& log : options.logs) {
    const auto traced = has_trace(log, options.words);
    if (!traced) throw Failure{exit_refused, traced.error().message};
    if (*traced) paths.push_back(log);
  }
  if (json) std::cout << Json{{"traces", paths}}.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
  for (const std::string& path : paths)
    if (!json) std::cout << path << "\n";
  if (!paths.empty()) throw Failure{exit_refused, "traces are left: " + std::to_string(paths.size())};
  if (!json) std::cout << "nothing is left in " << config->booth.state_directory.string() << "\n";
}

}  // namespace

void add_traces_command(CLI::App& app, const bool& json, std::function<void()>& run) {
  const auto options = std::make_shared<Options>();
  auto* traces = app.add_subcommand("traces", "search all that the booth stores for what is left of a person");
  traces->add_option("words", options->words, "ids of avatars and captures, a label")->required();
  traces->add_option("--log", options->logs, "a file to search too, such as an excerpt of the journal");
  traces->add_option("--config", options->config, "the booth's configuration")->capture_default_str();
  traces->callback([&run, &json, options] { run = [&json, options] { search(*options, json); }; });
}

}  // namespace booth
