#include "daemon/boothctl/doctor.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <filesystem>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <string>

#include "daemon/boothctl/command.h"
#include "daemon/doctor.h"

namespace booth {
namespace {

using Json = nlohmann::json;

void tell(const std::vector<Finding>& findings, bool json) {
  if (json) {
    Json list = Json::array();
    for (const Finding& finding : findings)
      list.push_back({{"check", finding.check},
                      {"level", to_string(finding.level)},
                      {"message", finding.message},
                      {"advice", finding.advice.empty() ? Json(nullptr) : Json(finding.advice)}});
    std::cout << Json{{"findings", list}}.dump(2, ' ', false, Json::error_handler_t::replace) << "\n";
    return;
  }
  constexpr size_t level_width = 9, check_width = 16;
  for (const Finding& finding : findings) {
    std::string begin(to_string(finding.level));
    begin.resize(level_width, ' ');
    begin += finding.check;
    begin.resize(level_width + check_width, ' ');
    std::cout << begin << finding.message << "\n";
    if (!finding.advice.empty()) std::cout << std::string(level_width + check_width, ' ') << finding.advice << "\n";
  }
}

}  // namespace

void add_doctor_command(CLI::App& app, const bool& json, std::function<void()>& run) {
  struct Options {
    std::string config = "/etc/booth/boothd.toml", root = "/";
  };
  const auto options = std::make_shared<Options>();
  auto* doctor = app.add_subcommand("doctor", "examine the machine, and say what to do about each finding");
  doctor->add_option("--config", options->config, "the booth's configuration")->capture_default_str();
  doctor->add_option("--root", options->root, "of another system's files, mounted there")->capture_default_str();
  doctor->callback([&run, &json, options] {
    run = [&json, options] {
      Machine machine = this_machine();
      machine.root = options->root;
      const auto findings =
          examine(machine, load_config(machine.root / std::filesystem::path(options->config).relative_path()));
      tell(findings, json);
      const auto problems = std::count_if(findings.begin(), findings.end(), [](const Finding& finding) {
        return finding.level == FindingLevel::problem;
      });
      if (problems > 0) throw Failure{exit_refused, "problems: " + std::to_string(problems)};
    };
  });
}

}  // namespace booth
