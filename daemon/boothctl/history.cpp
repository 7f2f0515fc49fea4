#include "daemon/boothctl/history.h"

#include <CLI/CLI.hpp>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <string>

#include "daemon/boothctl/command.h"
#include "daemon/health_history.h"

namespace booth {
namespace {

using Json = nlohmann::json;

constexpr double mebibyte = 1024.0 * 1024;
constexpr double gibibyte = 1024.0 * mebibyte;

struct Options {
  int hours = 24;
  int limit = 24;
};

template <class... Values>
std::string format(const char* how, Values... values) {
  std::string text(static_cast<size_t>(std::snprintf(nullptr, 0, how, values...)), '\0');
  std::snprintf(text.data(), text.size() + 1, how, values...);
  return text;
}

/// What a camera has to tell: that it was away, or missed triggers.
std::string describe(const std::string& id, const HealthSample::Camera& camera) {
  std::string text;
  if (camera.offline_s > 0) text += format(" offline %.0f min", camera.offline_s / 60);
  if (camera.dropped > 0)
    text += format("%s %llu of %llu dropped", text.empty() ? "" : ",", static_cast<unsigned long long>(camera.dropped),
                   static_cast<unsigned long long>(camera.frames + camera.dropped));
  return text.empty() ? text : "; " + printable(id) + text;
}

std::string describe(const Json& told) {
  const auto sample = health_sample_from(told);
  if (!sample) throw Failure{exit_refused, "the booth answers with a sample that is none"};
  const HealthTotals& totals = sample->totals;
  std::string line = printable(told.at("begin").get<std::string>());
  const double share = sample->observed_s > 0 ? 100 * sample->ready_s / sample->observed_s : 0;
  line += format("  ran %.0f min, ready %.0f %%", sample->observed_s / 60, share);
  if (sample->starts > 0) line += format(", started %llu times", static_cast<unsigned long long>(sample->starts));
  line += format("; captures %.0f", totals.captures_done);
  if (totals.captures_failed > 0) line += format(" and %.0f failed", totals.captures_failed);
  line += format("; jobs %.0f", totals.jobs_done);
  if (totals.jobs_failed > 0) line += format(" and %.0f failed", totals.jobs_failed);
  if (const double jobs = totals.jobs_done + totals.jobs_failed; jobs > 0)
    line += format(", %.1f s each", totals.job_seconds / jobs);
  if (sample->most_queued > 0)
    line += format(", up to %llu waiting", static_cast<unsigned long long>(sample->most_queued));
  line += format("; %.1f GiB free; memory %.0f MiB, %llu descriptors, %llu threads",
                 static_cast<double>(sample->least_free_bytes) / gibibyte,
                 static_cast<double>(sample->most_resident_bytes) / mebibyte,
                 static_cast<unsigned long long>(sample->most_descriptors),
                 static_cast<unsigned long long>(sample->most_threads));
  for (const auto& [id, camera] : sample->cameras) line += describe(id, camera);
  return line;
}

void tell_history(const Connect& connect, const Options& options, bool json) {
  const auto answer = connect()->call("system.history", {{"hours", options.hours}, {"limit", options.limit}});
  if (const auto* error = std::get_if<api::CallError>(&answer))
    throw Failure{error->unreachable ? exit_unreachable : exit_refused, error->message};
  const Json& told = std::get<api::CallReply>(answer).result;
  if (json) {
    std::cout << told.dump(2) << "\n";
    return;
  }
  for (const Json& sample : told.at("samples")) std::cout << describe(sample) << "\n";
}

}  // namespace

void add_history_command(CLI::App& app, const Connect& connect, const bool& json, std::function<void()>& run) {
  const auto options = std::make_shared<Options>();
  auto* history = app.add_subcommand("history", "how the booth has been, over restarts");
  history->add_option("--hours", options->hours, "back from now")->check(CLI::Range(1, 10000))->capture_default_str();
  history->add_option("--limit", options->limit, "lines, each over a longer time where they are fewer")
      ->check(CLI::Range(1, 500))
      ->capture_default_str();
  history->callback([&run, &connect, &json, options] {
    run = [&connect, &json, options] { tell_history(connect, *options, json); };
  });
}

}  // namespace booth
