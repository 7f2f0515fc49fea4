#include "daemon/boothctl/report.h"

#include <libdeflate.h>
#include <sys/utsname.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <cstdio>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <iostream>
#include <iterator>
#include <map>
#include <nlohmann/json.hpp>
#include <string>
#include <utility>
#include <vector>

#include "config/booth_config.h"
#include "daemon/boothctl/command.h"
#include "daemon/doctor.h"
#include "daemon/prometheus.h"
#include "daemon/redaction.h"
#include "replay/durable_folder.h"
#include "replay/recording.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

constexpr size_t most_log_bytes = size_t{4} << 20;
constexpr int most_history_hours = 10000;  ///< all that there is
constexpr int most_history_samples = 500;

/// Files by name, as a gzipped archive of tar (POSIX ustar).
std::vector<uint8_t> pack(const std::map<std::string, std::string>& files) {
  constexpr size_t block = 512;
  struct Header {
    std::array<char, 100> name{};
    std::array<char, 8> mode{}, uid{}, gid{};
    std::array<char, 12> size{}, time{};
    std::array<char, 8> checksum{};
    char type = '0';
    std::array<char, 100> link{};
    std::array<char, 8> magic{'u', 's', 't', 'a', 'r', '\0', '0', '0'};
    std::array<char, 247> rest{};
  };
  static_assert(sizeof(Header) == block);
  std::string archive;
  const auto octal = [](auto& field, uint64_t value) {
    std::snprintf(field.data(), field.size(), "%0*llo", static_cast<int>(field.size() - 1),
                  static_cast<unsigned long long>(value));
  };
  for (const auto& [name, content] : files) {
    Header header;
    std::copy_n(name.begin(), std::min(name.size(), header.name.size() - 1), header.name.begin());
    octal(header.mode, 0600);
    octal(header.uid, 0);
    octal(header.gid, 0);
    octal(header.size, content.size());
    octal(header.time, static_cast<uint64_t>(std::time(nullptr)));
    header.checksum.fill(' ');  // that it is added up with
    std::array<unsigned char, block> bytes{};
    std::memcpy(bytes.data(), &header, block);
    uint64_t sum = 0;
    for (const unsigned char byte : bytes) sum += byte;
    std::snprintf(header.checksum.data(), header.checksum.size(), "%06llo", static_cast<unsigned long long>(sum));
    std::array<char, block> text{};
    std::memcpy(text.data(), &header, block);
    archive.append(text.data(), block).append(content);
    archive.resize((archive.size() + block - 1) / block * block, '\0');
  }
  archive.append(2 * block, '\0');
  constexpr int level = 9;
  const std::unique_ptr<libdeflate_compressor, void (*)(libdeflate_compressor*)> compressor(
      libdeflate_alloc_compressor(level), libdeflate_free_compressor);
  if (compressor == nullptr) throw Failure{exit_refused, "no memory for the report"};
  std::vector<uint8_t> packed(libdeflate_gzip_compress_bound(compressor.get(), archive.size()));
  packed.resize(
      libdeflate_gzip_compress(compressor.get(), archive.data(), archive.size(), packed.data(), packed.size()));
  return packed;
}

/// What a program says; what it complains of too.
std::string output_of(const char* command) {
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(::popen(command, "r"), ::pclose);
  std::string text;
  std::array<char, 4096> piece{};
  while (pipe != nullptr && text.size() < most_log_bytes) {
    const size_t size = std::fread(piece.data(), 1, piece.size(), pipe.get());
    if (size == 0) break;
    text.append(piece.data(), size);
  }
  return text;
}

std::string versions() {
  utsname system{};
  ::uname(&system);
  const auto release = read_file("/etc/os-release", most_log_bytes);
  return std::string("boothctl ") + BOOTH_VERSION + "\n" + system.sysname + " " + system.release + " " +
         system.machine + "\n" + (release ? std::string(release->begin(), release->end()) : "");
}

std::string findings_json(const std::vector<Finding>& findings) {
  Json list = Json::array();
  for (const Finding& finding : findings)
    list.push_back({{"check", finding.check},
                    {"level", to_string(finding.level)},
                    {"message", finding.message},
                    {"advice", finding.advice}});
  return list.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

/// What the visitors are called, as far as the booth's files and the booth itself know.
std::vector<std::string> labels(const fs::path& recordings, const Json& avatars) {
  std::vector<std::string> found;
  std::error_code code;
  for (fs::directory_iterator entry(recordings, code), end; !code && entry != end; entry.increment(code))
    if (const auto recording = read_recording(entry->path()); recording && !recording->label.empty())
      found.push_back(recording->label);
  for (const Json& avatar : avatars)
    if (avatar.at("label").is_string()) found.push_back(avatar.at("label").get<std::string>());
  return found;
}

struct ReportOptions {
  std::string to, config = "/etc/booth/boothd.toml", log;
};

void make_report(const ReportOptions& options, const Connect& connect) {
  std::map<std::string, std::string> files{{"versions.txt", versions()}};
  const auto config = load_config(options.config);
  files["doctor.json"] = findings_json(examine(this_machine(), config));
  // Keys are in files of their own, which it names only.
  files["boothd.toml"] = config ? write_config(*config) : config.error().message + "\n";

  Json avatars = Json::array();
  const auto ask = [&](api::Client& client, const char* method, const Json& params = Json::object()) {
    const auto answer = client.call(method, params);
    if (const auto* error = std::get_if<api::CallError>(&answer)) return Json{{"error", error->message}};
    return std::get<api::CallReply>(answer).result;
  };
  const auto client = connect();
  const Json status = ask(*client, "system.status");
  files["status.json"] = status.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
  if (!status.contains("error")) {
    files["metrics.json"] = ask(*client, "system.metrics").dump(2) + "\n";
    files["history.json"] =
        ask(*client, "system.history", {{"hours", most_history_hours}, {"limit", most_history_samples}}).dump(2) + "\n";
    files["describe.json"] = ask(*client, "system.describe").dump(2) + "\n";
    avatars = ask(*client, "avatar.list").value("avatars", Json::array());
  }
  if (options.log.empty()) {
    files["log.txt"] = output_of("journalctl --unit boothd --lines 5000 --output short-iso --no-pager 2>&1");
  } else {
    const auto log = read_file(options.log, most_log_bytes);
    if (!log) throw Failure{exit_refused, log.error().message};
    files["log.txt"] = std::string(log->begin(), log->end());
  }

  Redaction redaction(labels((config ? *config : BoothConfig{}).booth.recordings(), avatars));
  for (auto& [name, content] : files) content = redaction.apply(content);
  const std::vector<uint8_t> packed = pack(files);
  if (const auto written = write_file_atomically(options.to, packed); !written)
    throw Failure{exit_refused, written.error().message};
  std::cout << options.to << ": ";
  for (const auto& [name, content] : files) std::cout << name << (name == files.rbegin()->first ? "\n" : ", ");
}

void tell_metrics(const Connect& connect, const std::string& file, bool prometheus, bool json) {
  const auto answer = connect()->call("system.metrics", Json::object());
  if (const auto* error = std::get_if<api::CallError>(&answer))
    throw Failure{error->unreachable ? exit_unreachable : exit_refused, error->message};
  const Json& metrics = std::get<api::CallReply>(answer).result;
  std::string text;
  if (prometheus)
    text = prometheus_text(metrics.get<std::map<std::string, double>>());
  else if (json)
    text = metrics.dump(2) + "\n";
  else
    for (const auto& [name, value] : metrics.items()) text += name + " " + value.dump() + "\n";
  if (file.empty()) {
    std::cout << text;
    return;
  }
  if (const auto written = write_file_atomically(file, text); !written)
    throw Failure{exit_refused, written.error().message};
}

}  // namespace

void add_report_command(CLI::App& app, const Connect& connect, std::function<void()>& run) {
  const auto options = std::make_shared<ReportOptions>();
  auto* report = app.add_subcommand("report", "pack what support needs, and nothing of the visitors, as a .tar.gz");
  report->add_option("--to", options->to, "the file")->required();
  report->add_option("--config", options->config, "the booth's configuration")->capture_default_str();
  report->add_option("--log", options->log, "a file with its log; the journal when left out");
  report->callback([&run, &connect, options] { run = [&connect, options] { make_report(*options, connect); }; });
}

void add_metrics_command(CLI::App& app, const Connect& connect, const bool& json, std::function<void()>& run) {
  struct Options {
    std::string to;
    bool prometheus = false;
  };
  const auto options = std::make_shared<Options>();
  auto* metrics = app.add_subcommand("metrics", "the booth's measurements");
  metrics->add_flag("--prometheus", options->prometheus, "in Prometheus' text format");
  metrics->add_option("--to", options->to, "a file, replaced as a whole, such as node_exporter's textfile");
  metrics->callback([&run, &connect, &json, options] {
    run = [&connect, &json, options] { tell_metrics(connect, options->to, options->prometheus, json); };
  });
}

}  // namespace booth
