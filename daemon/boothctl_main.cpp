// boothctl: the operator's hands on the booth.

#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "config/booth_config.h"
#include "daemon/api/client.h"
#include "daemon/api/requests.h"
#include "daemon/boothctl/calibrate.h"
#include "daemon/boothctl/command.h"
#include "daemon/boothctl/doctor.h"
#include "daemon/boothctl/history.h"
#include "daemon/boothctl/keys.h"
#include "daemon/boothctl/report.h"
#include "daemon/boothctl/traces.h"
#include "daemon/identifier.h"
#include "pipeline/calibration/board_pdf.h"
#include "pipeline/export/sha256.h"
#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;
using SteadyClock = std::chrono::steady_clock;

constexpr const char* exit_codes =
    "Exit status: 0 done; 1 the booth refused or it failed; 2 wrong usage; 3 the booth cannot be reached, or does not "
    "answer in time.";

std::string text_of(const Json& value) {
  if (value.is_string()) return printable(value.get<std::string>());
  if (value.is_null()) return "-";
  return value.dump();
}
std::string text_of(const Json& object, const char* key) {
  const auto found = object.find(key);
  return found == object.end() ? "-" : text_of(*found);
}

std::string percent(double fraction) { return std::to_string(static_cast<int>(100 * fraction)) + " %"; }

/// How far a reconstruction is: one line that is drawn over itself on a terminal, else a line a stage.
class ProgressLine {
 public:
  explicit ProgressLine(bool silent) : silent_(silent), terminal_(::isatty(STDERR_FILENO) != 0) {}

  void draw(const std::string& stage, double fraction) {
    if (silent_) return;
    if (!terminal_) {
      if (stage != stage_) std::cerr << stage << "\n";
      stage_ = stage;
      return;
    }
    constexpr int width = 40;
    const int filled = static_cast<int>(width * std::clamp(fraction, 0.0, 1.0));
    std::string bar;
    for (int i = 0; i < width; ++i) bar += i < filled ? "█" : "·";
    std::fprintf(stderr, "\r\033[K%s %5s  %s", bar.c_str(), percent(fraction).c_str(), stage.c_str());
    drawn_ = true;
  }
  /// A sentence of its own.
  void say(const std::string& text) {
    if (silent_) return;
    clear();
    std::cerr << text << "\n";
  }
  void clear() {
    if (drawn_) std::fputs("\r\033[K", stderr);
    drawn_ = false;
  }

 private:
  const bool silent_, terminal_;
  std::string stage_;
  bool drawn_ = false;
};

struct Options {
  std::string control = ApiConfig{}.control, events = ApiConfig{}.events;
  double timeout_s = 5;
  bool json = false;
  std::string key_file, server_key;  ///< of tcp:// endpoints

  /// @throw Failure
  std::optional<api::ClientCredentials> credentials() const {
    if (key_file.empty()) {
      for (const std::string& endpoint : {control, events})
        if (endpoint.starts_with("tcp://"))
          throw Failure{exit_usage, endpoint + ": needs --key, a file that boothctl keys add made"};
      return std::nullopt;
    }
    auto read = api::read_client_credentials(key_file);
    if (!read) throw Failure{exit_refused, read.error().message};
    if (!server_key.empty()) read->server_key = server_key;
    if (!api::is_curve_key(read->server_key))
      throw Failure{exit_usage, "--server-key: expected the booth's public key, 40 characters in Z85"};
    return std::move(*read);
  }
};

class Operator {
 public:
  explicit Operator(const Options& options)
      : options_(options),
        client_(options.control, options.events,
                std::chrono::milliseconds(static_cast<int64_t>(1000 * options.timeout_s)), options.credentials()) {}

  void status();
  void capture(const Json& params, bool wait);
  void jobs();
  void change(const std::string& method, const Json& params);
  void list_avatars(size_t limit);
  void fetch(const std::string& avatar, std::vector<std::string> files, const fs::path& folder);
  void watch();
  void task(const std::string& method, const Json& params);
  void preview(const std::string& camera, int max_width, const fs::path& file);
  api::Client& client() { return client_; }

 private:
  api::CallReply call(const std::string& method, const Json& params);
  Json call_with_key(const std::string& method, Json params);
  void wait_for_avatar(const std::string& capture);
  bool note(const api::ReceivedEvent& event, const std::string& capture, ProgressLine& line);
  bool is_over(const std::string& capture);
  void fetch_file(const std::string& avatar, const std::string& file, const fs::path& folder);

  const Options options_;
  api::Client client_;
};

api::CallReply Operator::call(const std::string& method, const Json& params) {
  auto answer = client_.call(method, params);
  if (const auto* error = std::get_if<api::CallError>(&answer))
    throw Failure{error->unreachable ? exit_unreachable : exit_refused,
                  error->message + (error->kind.empty() ? "" : " (" + error->kind + ")")};
  return std::get<api::CallReply>(std::move(answer));
}

/// With a key of its own a request may be repeated when its answer is lost on the way.
Json Operator::call_with_key(const std::string& method, Json params) {
  params["key"] = "boothctl-" + random_hex(16);
  auto answer = client_.call(method, params);
  if (const auto* error = std::get_if<api::CallError>(&answer); error == nullptr || !error->unreachable) {
    if (error == nullptr) return std::get<api::CallReply>(std::move(answer)).result;
    throw Failure{exit_refused, error->message + " (" + error->kind + ")"};
  }
  return call(method, params).result;
}

void Operator::status() {
  const Json status = call("system.status", Json::object()).result;
  if (options_.json) {
    std::cout << status.dump(2) << "\n";
    return;
  }
  std::cout << "state       " << text_of(status, "state") << " since " << text_of(status, "state_since") << "\n";
  std::cout << "ready       " << (status.value("ready", false) ? "yes" : "no") << "\n";
  for (const Json& reason : status.at("not_ready"))
    std::cout << "            " << text_of(reason, "kind") << ": " << text_of(reason, "message") << "\n";
  if (!status.at("capture").is_null()) std::cout << "capture     " << text_of(status, "capture") << "\n";
  for (const Json& camera : status.at("cameras")) {
    std::cout << "camera      " << text_of(camera, "id") << " (" << text_of(camera, "role") << ") "
              << text_of(camera, "state") << ", " << text_of(camera, "frames") << " frames, "
              << text_of(camera, "dropped") << " dropped";
    if (!camera.at("message").is_null()) std::cout << ": " << text_of(camera, "message");
    std::cout << "\n";
    for (const Json& warning : camera.at("warnings")) std::cout << "            " << warning.get<std::string>() << "\n";
  }
  for (const char* device : {"projector", "trigger"}) {
    const Json& found = status.at(device);
    std::printf("%-11s ", device);
    std::cout << std::flush << (found.is_null() ? "none" : text_of(found, "state"));
    if (!found.is_null() && !found.at("message").is_null()) std::cout << ": " << text_of(found, "message");
    std::cout << "\n";
  }
  const Json& calibration = status.at("calibration");
  std::cout << "calibration " << (calibration.value("loaded", false) ? "loaded" : "none");
  if (!calibration.at("rms_px").is_null()) std::cout << ", worst camera " << text_of(calibration, "rms_px") << " px";
  for (const Json& camera : calibration.value("moved", Json::array()))
    std::cout << "; " << camera.get<std::string>() << " was moved since: calibrate anew";
  const Json& background = status.at("background");
  std::cout << "\nbackground  " << (background.value("learned", false) ? "learned" : "not learned");
  if (background.contains("stale") && !background.at("stale").is_null())
    std::cout << "; " << text_of(background, "stale") << ": learn it again";
  std::cout << "\n";
  for (const Json& job : status.at("queue"))
    std::cout << "job         " << text_of(job, "id") << " " << text_of(job, "state") << " " << text_of(job, "stage")
              << " " << percent(job.value("fraction", 0.0)) << "\n";
  constexpr double gibibyte = 1024.0 * 1024 * 1024;
  const Json& disk = status.at("disk");
  std::printf("disk        %.1f GiB free, at least %.1f GiB needed\n", disk.at("free_bytes").get<double>() / gibibyte,
              disk.at("limit_bytes").get<double>() / gibibyte);
}

void Operator::capture(const Json& params, bool wait) {
  if (wait) client_.subscribe();  // before it starts, so that nothing is missed
  const std::string capture = call_with_key("capture.start", params).at("capture").get<std::string>();
  if (wait) return wait_for_avatar(capture);
  std::cout << (options_.json ? Json{{"capture", capture}}.dump(2) : capture) << "\n";
}

void Operator::wait_for_avatar(const std::string& capture) {
  constexpr std::chrono::milliseconds patience{1000};
  ProgressLine line(options_.json);
  line.say("capture " + capture);
  auto asked = SteadyClock::now();
  bool published = false;
  while (!published) {
    const auto event = client_.next_event(patience);
    if (event) published = note(*event, capture, line);
    // Events may be lost; the booth's lists are not.
    if (!published && SteadyClock::now() - asked >= patience) {
      published = is_over(capture);
      asked = SteadyClock::now();
    }
  }
  line.clear();
  std::cout << (options_.json ? Json{{"capture", capture}, {"avatar", capture}}.dump(2) : capture) << "\n";
}

/// @return whether the avatar is there
bool Operator::note(const api::ReceivedEvent& event, const std::string& capture, ProgressLine& line) {
  const Json& fields = event.fields;
  if (!fields.is_object() || fields.value("capture", std::string()) != capture) return false;
  if (event.topic == "countdown") line.say(text_of(fields, "remaining_s"));
  if (event.topic == "shot" && fields.at("role") == "body")
    line.say("shot: " + text_of(fields, "cameras") + " cameras" +
             (fields.at("missing").empty() ? "" : ", missing " + fields.at("missing").dump()));
  if (event.topic == "shot" && fields.at("role") == "gray_code")
    line.draw("patterns", (fields.at("index").get<double>() + 1) / fields.at("of").get<double>());
  if (event.topic == "job.progress") line.draw(text_of(fields, "stage"), fields.value("fraction", 0.0));
  if (event.topic == "capture.failed") {
    line.clear();
    throw Failure{exit_refused, text_of(fields, "message") + " (" + text_of(fields, "kind") + ")"};
  }
  if (event.topic == "job.failed" || event.topic == "job.cancelled") {
    line.clear();
    const Json& error = fields.at("error");
    throw Failure{exit_refused, text_of(error, "message") + " (" + text_of(error, "kind") + ")"};
  }
  return event.topic == "avatar.published";
}

bool Operator::is_over(const std::string& capture) {
  const Json status = call("system.status", Json::object()).result;
  if (status.at("capture") == capture) return false;
  const Json jobs = call("job.list", Json::object()).result.at("jobs");
  for (const Json& job : jobs) {
    if (job.at("capture") != capture) continue;
    const std::string state = job.at("state").get<std::string>();
    if (state == "failed" || state == "cancelled") throw Failure{exit_refused, text_of(job.at("error"), "message")};
    return state == "done";
  }
  throw Failure{exit_refused, "capture " + capture + " failed, or was deleted"};
}

void Operator::jobs() {
  const Json jobs = call("job.list", Json::object()).result;
  if (options_.json) {
    std::cout << jobs.dump(2) << "\n";
    return;
  }
  for (const Json& job : jobs.at("jobs")) {
    std::cout << text_of(job, "id") << "  " << text_of(job, "state") << "  " << percent(job.value("fraction", 0.0));
    if (!job.at("stage").is_null()) std::cout << "  " << text_of(job, "stage");
    if (!job.at("error").is_null())
      std::cout << "  " << text_of(job.at("error"), "kind") << ": " << text_of(job.at("error"), "message");
    std::cout << "\n";
  }
}

void Operator::change(const std::string& method, const Json& params) {
  const Json result = call_with_key(method, params);
  if (options_.json) std::cout << result.dump(2) << "\n";
}

void Operator::list_avatars(size_t limit) {
  constexpr size_t page = 500;
  Json avatars = Json::array();
  while (avatars.size() < limit) {
    Json params{{"limit", std::min(page, limit - avatars.size())}};
    if (!avatars.empty()) params["before"] = avatars.back().at("id");
    const Json found = call("avatar.list", params).result.at("avatars");
    if (found.empty()) break;
    avatars.insert(avatars.end(), found.begin(), found.end());
  }
  if (options_.json) {
    std::cout << Json{{"avatars", avatars}}.dump(2) << "\n";
    return;
  }
  for (const Json& avatar : avatars)
    std::cout << text_of(avatar, "id") << "  " << text_of(avatar, "created") << "  " << text_of(avatar, "triangles")
              << " triangles  " << text_of(avatar, "label") << "\n";
}

void Operator::fetch(const std::string& avatar, std::vector<std::string> files, const fs::path& folder) {
  if (files.empty()) {
    const Json metadata = call("avatar.get", {{"avatar", avatar}}).result;
    files.emplace_back("metadata.json");
    for (const auto& [name, file] : metadata.at("files").items()) files.push_back(name);
  }
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) throw Failure{exit_refused, folder.string() + ": cannot be made: " + code.message()};
  for (const std::string& file : files) fetch_file(avatar, file, folder);
  if (options_.json) std::cout << Json{{"avatar", avatar}, {"files", files}}.dump(2) << "\n";
}

void Operator::fetch_file(const std::string& avatar, const std::string& file, const fs::path& folder) {
  // What the booth calls its files must not lead out of the folder.
  if (!is_safe_id(file)) throw Failure{exit_refused, file + ": not a plain file name"};
  std::vector<uint8_t> bytes;
  std::string sha256;
  for (;;) {
    const auto piece =
        call("avatar.fetch",
             {{"avatar", avatar}, {"file", file}, {"offset", bytes.size()}, {"length", api::most_fetch_bytes}});
    sha256 = piece.result.at("sha256").get<std::string>();
    bytes.insert(bytes.end(), piece.bytes.begin(), piece.bytes.end());
    if (piece.bytes.empty() || bytes.size() >= piece.result.at("size").get<uint64_t>()) break;
  }
  if (sha256_hex(bytes) != sha256)
    throw Failure{exit_refused, file + ": damaged on the way, its SHA-256 does not match"};
  if (const auto written = write_file_atomically(folder / file, bytes); !written)
    throw Failure{exit_refused, written.error().message};
}

/// Starts a task, waits for its end and shows its result.
void Operator::task(const std::string& method, const Json& params) {
  constexpr std::chrono::milliseconds patience{1000};
  client_.subscribe();
  const std::string task = call_with_key(method, params).at("task").get<std::string>();
  ProgressLine line(options_.json);
  int checks_without = 0;
  for (;;) {
    const auto event = client_.next_event(patience);
    if (event && event->topic == "task" && event->fields.value("task", std::string()) == task) {
      const Json& fields = event->fields;
      const std::string state = fields.value("state", std::string());
      line.draw(text_of(fields, "kind"), fields.value("fraction", 0.0));
      if (state == "running") continue;
      line.clear();
      if (state != "done")
        throw Failure{exit_refused,
                      text_of(fields.at("error"), "message") + " (" + text_of(fields.at("error"), "kind") + ")"};
      std::cout << fields.at("result").dump(2) << "\n";
      return;
    }
    if (event) continue;
    // Its last event may have been lost.
    const Json tasks = call("system.status", Json::object()).result.at("tasks");
    const bool runs = std::any_of(tasks.begin(), tasks.end(), [&](const Json& t) { return t.at("task") == task; });
    if (!runs && ++checks_without > 1) throw Failure{exit_refused, "task " + task + " is over; its result was lost"};
  }
}

void Operator::preview(const std::string& camera, int max_width, const fs::path& file) {
  const auto patience = std::chrono::milliseconds(static_cast<int64_t>(1000 * options_.timeout_s));
  client_.subscribe();
  call_with_key("preview.start", {{"camera", camera}, {"fps", 10}, {"max_width", max_width}});
  std::optional<api::ReceivedEvent> picture;
  const auto deadline = SteadyClock::now() + patience;
  while (!picture && SteadyClock::now() < deadline) {
    auto event = client_.next_event(std::chrono::milliseconds(200));
    if (event && event->topic == "preview." + camera) picture = std::move(event);
  }
  call_with_key("preview.stop", {{"camera", camera}});
  if (!picture) throw Failure{exit_refused, camera + ": showed nothing; see boothctl status"};
  if (const auto written = write_file_atomically(file, picture->bytes); !written)
    throw Failure{exit_refused, written.error().message};
  if (options_.json) std::cout << picture->fields.dump(2) << "\n";
}

void Operator::watch() {
  constexpr std::chrono::milliseconds silence{3500};  // three heartbeats
  client_.subscribe();
  bool heard = false;
  for (;;) {
    const auto event = client_.next_event(silence);
    if (!event) {
      if (!heard) throw Failure{exit_unreachable, "nothing is heard of the booth; is boothd running?"};
      throw Failure{exit_unreachable, "the booth has fallen silent"};
    }
    heard = true;
    if (!event->fields.is_object()) continue;
    if (options_.json) {
      Json line = event->fields;
      line["topic"] = event->topic;
      std::cout << line.dump() << std::endl;
      continue;
    }
    std::cout << text_of(event->fields, "time") << "  " << event->topic;
    for (const auto& [name, value] : event->fields.items())
      if (name != "time" && name != "boot" && name != "sequence") std::cout << "  " << name << "=" << text_of(value);
    std::cout << std::endl;
  }
}

struct BoardOptions {
  std::string pdf, paper = "A3", dictionary;
  std::optional<int> squares_x, squares_y;
  std::optional<double> square_mm, marker_mm;
};

/// Writes a board to print. What is not given suits the paper.
void write_board(const BoardOptions& options) {
  const auto paper = std::find_if(paper_sizes.begin(), paper_sizes.end(),
                                  [&](const auto& known) { return known.second == options.paper; });
  CalibrationBoard board = board_for(paper->first);
  board.squares_x = options.squares_x.value_or(board.squares_x);
  board.squares_y = options.squares_y.value_or(board.squares_y);
  if (options.square_mm) board.square_m = *options.square_mm / 1000;
  board.marker_m = options.marker_mm ? *options.marker_mm / 1000 : 0.75 * board.square_m;
  if (!options.dictionary.empty()) board.dictionary = options.dictionary;
  const auto pdf = board_pdf(board, paper->first);
  if (!pdf) throw Failure{exit_refused, pdf.error().message};
  if (const auto written = write_file_atomically(options.pdf, std::string_view(*pdf)); !written)
    throw Failure{exit_refused, written.error().message};
  std::cout << "board = { squares_x = " << board.squares_x << ", squares_y = " << board.squares_y
            << ", square_m = " << board.square_m << ", marker_m = " << board.marker_m << ", dictionary = \""
            << board.dictionary << "\" }\n";
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  using booth::Json;
  booth::Options options;
  CLI::App app("Operates the booth.", "boothctl");
  app.footer(booth::exit_codes);
  app.set_version_flag("--version", BOOTH_VERSION);
  app.add_option("--control,--endpoint", options.control, "where boothd takes requests")->capture_default_str();
  app.add_option("--events", options.events, "where boothd tells what happens")->capture_default_str();
  app.add_option("--timeout", options.timeout_s, "seconds to wait for an answer")
      ->capture_default_str()
      ->check(CLI::Range(0.1, 3600.0));
  app.add_flag("--json", options.json, "answers as JSON, for scripts");
  app.add_option("--key", options.key_file,
                 "for tcp:// endpoints: this client's key file, as boothctl keys add makes it");
  app.add_option("--server-key", options.server_key, "the booth's public key, when it is not that of the key file");
  app.require_subcommand(1);
  app.fallthrough();

  std::function<void(booth::Operator&)> action;
  app.add_subcommand("status", "what the booth does, and every reason why it is not ready")->callback([&] {
    action = [](booth::Operator& op) { op.status(); };
  });

  std::string face = "auto", label;
  double countdown_s = 0;
  bool wait = false;
  auto* capture = app.add_subcommand("capture", "take a capture; prints its id, with --wait the avatar's");
  capture->add_option("--face", face, "how the face is made")
      ->check(CLI::IsMember({"active", "passive", "none", "auto"}))
      ->capture_default_str();
  capture->add_option("--label", label, "who or what it shows");
  capture->add_option("--countdown", countdown_s, "seconds before the picture")->check(CLI::Range(0.0, 60.0));
  capture->add_flag("--wait", wait, "until the avatar is published, showing how far it is");
  capture->callback([&] {
    action = [&](booth::Operator& op) {
      Json params{{"face", face}, {"countdown_s", countdown_s}};
      if (!label.empty()) params["label"] = label;
      op.capture(params, wait);
    };
  });

  app.add_subcommand("jobs", "the reconstructions, oldest first")->callback([&] {
    action = [](booth::Operator& op) { op.jobs(); };
  });
  std::string id;
  const auto changing = [&](CLI::App* parent, const char* name, const char* help, const char* method,
                            const char* member) {
    auto* command = parent->add_subcommand(name, help);
    command->add_option("ID", id)->required();
    command->callback([&action, &id, method, member] {
      action = [&id, method, member](booth::Operator& op) { op.change(method, {{member, id}}); };
    });
  };
  changing(&app, "retry", "start a failed or cancelled job again", "job.retry", "job");
  changing(&app, "cancel", "end a queued or running job", "job.cancel", "job");

  auto* avatars = app.add_subcommand("avatars", "the published avatars");
  avatars->require_subcommand(1);
  size_t limit = 50;
  auto* list = avatars->add_subcommand("list", "newest first");
  list->add_option("--limit", limit, "at most so many")->capture_default_str();
  list->callback([&] { action = [&](booth::Operator& op) { op.list_avatars(limit); }; });
  std::vector<std::string> files;
  std::string folder;
  auto* fetch = avatars->add_subcommand("fetch", "copy an avatar's files, checked by their SHA-256");
  fetch->add_option("ID", id)->required();
  fetch->add_option("FILE", files, "all when none is named");
  fetch->add_option("--to", folder, "folder, made where it is missing")->required();
  fetch->callback([&] { action = [&](booth::Operator& op) { op.fetch(id, files, folder); }; });
  changing(avatars, "delete", "delete an avatar, its recording and every trace of the person", "avatar.delete",
           "avatar");

  app.add_subcommand("discover", "every camera that the drivers can see, configured or not")->callback([&] {
    action = [](booth::Operator& op) { op.task("camera.discover", Json::object()); };
  });
  std::string file;
  int max_width = 1024;
  auto* preview = app.add_subcommand("preview", "what a camera sees now, as a JPEG file");
  preview->add_option("CAMERA", id)->required();
  preview->add_option("--to", file, "the file")->required();
  preview->add_option("--max-width", max_width, "pixels")->check(CLI::Range(1, 65536))->capture_default_str();
  preview->callback([&] { action = [&](booth::Operator& op) { op.preview(id, max_width, file); }; });
  auto* background = app.add_subcommand("background", "the empty booth");
  background->require_subcommand(1);
  std::optional<int> frames;
  auto* learn = background->add_subcommand("learn", "learn it: nobody may be in the booth");
  learn->add_option("--frames", frames, "pictures of each camera")->check(CLI::Range(1, 100));
  learn->callback([&] {
    action = [&](booth::Operator& op) {
      op.task("background.learn", frames ? Json{{"frames", *frames}} : Json::object());
    };
  });
  auto* trigger = app.add_subcommand("trigger", "what makes the cameras expose");
  trigger->require_subcommand(1);
  trigger->add_subcommand("test", "fire once; tells which cameras answer, and when")->callback([&] {
    action = [](booth::Operator& op) { op.task("trigger.test", Json::object()); };
  });
  std::function<void()> offline;  // of a command that needs no booth
  booth::BoardOptions board_options;
  auto* board = app.add_subcommand("board", "a calibration board to print, as a PDF true to scale");
  board->add_option("--pdf", board_options.pdf, "the file")->required();
  board->add_option("--paper", board_options.paper, "its size")
      ->check(CLI::IsMember({"A4", "A3", "A2", "A1", "A0"}))
      ->capture_default_str();
  board->add_option("--squares-x", board_options.squares_x, "squares across; 8 when left out")
      ->check(CLI::Range(3, 100));
  board->add_option("--squares-y", board_options.squares_y, "squares along; 11 when left out")
      ->check(CLI::Range(3, 100));
  board->add_option("--square-mm", board_options.square_mm, "edge of a square; as fits the paper when left out")
      ->check(CLI::Range(1.0, 1000.0));
  board
      ->add_option("--marker-mm", board_options.marker_mm, "edge of a marker; three quarters of a square when left out")
      ->check(CLI::Range(1.0, 1000.0));
  board->add_option("--dictionary", board_options.dictionary, "of the markers; DICT_5X5_250 when left out");
  board->callback([&] { offline = [&] { booth::write_board(board_options); }; });
  std::function<void(booth::api::Client&)> online;  // of one that speaks with the booth itself
  booth::add_calibrate_command(app, options.json, offline, online);
  booth::add_doctor_command(app, options.json, offline);
  const booth::Connect connect = [&options] {
    return std::make_unique<booth::api::Client>(
        options.control, options.events, std::chrono::milliseconds(static_cast<int64_t>(1000 * options.timeout_s)),
        options.credentials());
  };
  booth::add_report_command(app, connect, offline);
  booth::add_metrics_command(app, connect, options.json, offline);
  booth::add_history_command(app, connect, options.json, offline);
  booth::add_keys_command(app, options.json, offline);
  booth::add_traces_command(app, options.json, offline);
  auto* projector = app.add_subcommand("projector", "what lights the face with patterns");
  projector->require_subcommand(1);
  projector
      ->add_subcommand("calibrate",
                       "measure its delay by a face camera, with nothing moving in front of it, and keep it")
      ->callback([&] { action = [](booth::Operator& op) { op.task("projector.calibrate", Json::object()); }; });
  app.add_subcommand("watch", "what happens, as it happens")->callback([&] {
    action = [](booth::Operator& op) { op.watch(); };
  });
  app.add_subcommand("shutdown", "let boothd finish and end")->callback([&] {
    action = [](booth::Operator& op) { op.change("system.shutdown", Json::object()); };
  });

  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? booth::exit_ok : booth::exit_usage;
  }
  try {
    if (offline) {
      offline();
      return booth::exit_ok;
    }
    booth::Operator op(options);
    if (online)
      online(op.client());
    else
      action(op);
    return booth::exit_ok;
  } catch (const booth::Failure& failure) {
    std::cerr << "boothctl: " << failure.message << "\n";
    return failure.status;
  } catch (const std::exception& fault) {
    std::cerr << "boothctl: " << fault.what() << "\n";
    return booth::exit_refused;
  }
}
