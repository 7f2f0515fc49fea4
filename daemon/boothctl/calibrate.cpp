#include "daemon/boothctl/calibrate.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <numbers>
#include <optional>
#include <string>

#include "daemon/api/client.h"
#include "daemon/boothctl/command.h"
#include "daemon/boothctl/correct.h"
#include "daemon/identifier.h"
#include "daemon/offline_calibration.h"
#include "pipeline/thread_pool.h"

namespace booth {
namespace {

using Json = nlohmann::json;

std::string text_of(const Json& value) {
  if (value.is_string()) return printable(value.get<std::string>());
  return value.is_null() ? "-" : value.dump();
}

double degrees(double radians) { return radians * 180 / std::numbers::pi; }

/// The booth's calibration, as its interface offers it.
class RemoteCalibration {
 public:
  explicit RemoteCalibration(api::Client& client) : client_(client) { client_.subscribe(); }

  /// @throw Failure
  Json call(const std::string& method, const Json& params = Json::object()) {
    auto answer = client_.call(method, params);
    if (const auto* error = std::get_if<api::CallError>(&answer))
      throw Failure{error->unreachable ? exit_unreachable : exit_refused,
                    error->message + (error->kind.empty() ? "" : " (" + error->kind + ")")};
    return std::get<api::CallReply>(std::move(answer)).result;
  }
  /// With a key of its own, so that a lost answer changes nothing twice.
  Json change(const std::string& method, Json params) {
    params["key"] = "boothctl-" + random_hex(16);
    auto answer = client_.call(method, params);
    if (const auto* error = std::get_if<api::CallError>(&answer); error == nullptr || !error->unreachable) {
      if (error == nullptr) return std::get<api::CallReply>(std::move(answer)).result;
      throw Failure{exit_refused, error->message + " (" + error->kind + ")"};
    }
    return call(method, params);
  }
  /// Starts a task and waits for its result.
  /// @param kept  what calibration.status calls that result, where the event that brings it is lost
  Json task(const std::string& method, const Json& params, const char* kept) {
    constexpr std::chrono::milliseconds patience{1000};
    const std::string task = change(method, params).at("task").get<std::string>();
    int checks_without = 0;
    for (;;) {
      const auto event = client_.next_event(patience);
      if (event && event->topic == "task" && event->fields.value("task", "") == task) {
        const std::string state = event->fields.value("state", "");
        if (state == "done") return event->fields.at("result");
        if (state == "failed") {
          const Json& error = event->fields.at("error");
          throw Failure{exit_refused, text_of(error.at("message")) + " (" + text_of(error.at("kind")) + ")"};
        }
      }
      if (event) continue;
      const Json tasks = call("system.status").at("tasks");
      const bool runs = std::any_of(tasks.begin(), tasks.end(), [&](const Json& t) { return t.at("task") == task; });
      if (runs || ++checks_without < 2) continue;
      Json result = call("calibration.status").at(kept);
      if (result.is_null()) throw Failure{exit_refused, "task " + task + " failed; why was lost"};
      return result;
    }
  }

 private:
  api::Client& client_;
};

/// What a shot showed and what is still thin.
void print_look(const Json& look) {
  std::cout << "shot " << text_of(look.at("shots")) << "\n";
  for (const Json& camera : look.at("cameras")) {
    std::printf("  %-14s %3d corners, %2d shots so far, %3.0f %% of its picture", text_of(camera.at("id")).c_str(),
                camera.at("corners").get<int>(), camera.at("views").get<int>(),
                100 * camera.at("covered").get<double>());
    std::cout << std::flush << (camera.at("enough") == true ? "  enough" : "") << "\n";
    if (camera.at("blurred") == true) std::cout << "    blurred: hold the board still, and check the focus\n";
  }
  if (const Json& projector = look.at("projector"); !projector.is_null() && projector.at("views") != 0)
    std::cout << "  " << text_of(projector.at("id")) << ": lit " << text_of(projector.at("corners")) << " corners, "
              << text_of(projector.at("views")) << " shots so far\n";
  if (look.contains("missing") && !look.at("missing").empty()) {
    std::cout << "  no picture came from";
    for (const Json& camera : look.at("missing")) std::cout << " " << text_of(camera);
    std::cout << "\n";
  }
  for (const Json& warning : look.at("warnings")) std::cout << "  note: " << text_of(warning) << "\n";
  if (look.at("enough") == true)
    std::cout << "There is enough" << (look.at("floor") == true ? "" : ", but for the board on the floor") << ".\n";
  else
    std::cout << "Next: " << text_of(look.at("wants")) << "\n";
  if (!look.at("cameras").empty()) {
    const std::string picture = look.at("cameras").front().at("picture").get<std::string>();
    std::cout << "Pictures: " << printable(picture.substr(0, picture.rfind('/'))) << "\n";
  }
}

void print_solution(const Json& solution) {
  Json devices = solution.at("cameras");
  if (!solution.at("projector").is_null()) devices.push_back(solution.at("projector"));
  for (const Json& device : devices) {
    if (device.at("solved") != true) continue;
    std::printf("  %-14s %.3f px, position within %.2f mm, direction within %.4f deg, %d shots\n",
                text_of(device.at("id")).c_str(), device.at("rms_px").get<double>(),
                1000 * device.at("center_sigma_m").get<double>(),
                degrees(device.at("rotation_sigma_rad").get<double>()), device.at("views").get<int>());
  }
  std::fflush(stdout);
  for (const Json& message : solution.at("messages")) std::cout << "  note: " << text_of(message) << "\n";
  std::cout << text_of(solution.at("verdict")) << ": " << text_of(solution.at("reason")) << "\n"
            << "Report: " << text_of(solution.at("report")) << "\n";
}

/// Leads an operator through a calibration, question by question.
class Guide {
 public:
  explicit Guide(api::Client& client) : booth_(client) {}

  void run() {
    const Json status = booth_.call("calibration.status");
    if (!status.at("look").is_null()) {
      std::cout << "A calibration is under way.\n";
      print_look(status.at("look"));
      floor_ = status.at("look").at("floor").get<bool>();
      enough_ = status.at("look").at("enough").get<bool>();
    }
    std::cout << "Hold the printed board where the subject stands, so that several cameras see it, and still.\n"
                 "Turn and tilt it differently for each shot, all around, near and far.\n";
    for (;;) {
      const auto answer = ask();
      if (!answer || *answer == "q") {
        std::cout << "The shots are kept: boothctl calibrate goes on with them.\n";
        return;
      }
      try {
        if (*answer == "s" ? solve() : other(*answer)) return;
      } catch (const Failure& failure) {
        if (failure.status == exit_unreachable) throw;
        std::cout << printable(failure.message) << "\n";
      }
    }
  }

 private:
  std::optional<std::string> ask() {
    std::cout << "\n[Enter] a shot   [f] the board lies on the floor, its lower edge towards where the subject looks\n"
                 "[p] a shot, lit by the projector too   [s] solve"
              << (enough_ ? floor_ ? " (there is enough)" : " (there is enough; take one on the floor first)" : "")
              << "   [d] discard all shots   [q] leave\n> " << std::flush;
    std::string line;
    if (!std::getline(std::cin, line)) return std::nullopt;
    const auto from = line.find_first_not_of(" \t\r");
    return from == std::string::npos ? "" : line.substr(from, 1);
  }
  /// @return whether the calibration is over
  bool other(const std::string& answer) {
    if (answer == "d") {
      booth_.change("calibration.discard", Json::object());
      std::cout << "All shots are discarded.\n";
      floor_ = enough_ = false;
    } else if (answer.empty() || answer == "f" || answer == "p") {
      const Json look =
          booth_.task("calibration.capture", {{"floor", answer == "f"}, {"patterns", answer == "p"}}, "look");
      print_look(look);
      floor_ = look.at("floor").get<bool>();
      enough_ = look.at("enough").get<bool>();
    } else {
      std::cout << "What is " << printable(answer) << "?\n";
    }
    return false;
  }
  bool solve() {
    if (!floor_)
      std::cout << "The board was not on the floor yet: floor and origin stay where they were, or are guessed.\n";
    std::cout << "Solving …\n" << std::flush;
    const Json solution = booth_.task("calibration.solve", Json::object(), "solution");
    print_solution(solution);
    if (solution.at("verdict") == "bad") {
      std::cout << "A bad calibration is not applied: mend what it says, take more shots, and solve again.\n";
      return false;
    }
    std::cout << "Put it in force? The one before is kept. [y/N] " << std::flush;
    std::string line;
    if (!std::getline(std::cin, line) || (line != "y" && line != "Y" && line != "yes")) {
      std::cout << "Nothing is changed.\n";
      return false;
    }
    booth_.change("calibration.apply", Json::object());
    std::cout << "The booth is calibrated. With boothctl calibrate restore the calibration before comes back.\n";
    return true;
  }

  RemoteCalibration booth_;
  bool floor_ = false, enough_ = false;
};

struct CalibrateOptions {
  OfflineCalibrationOptions recordings;
  bool floor = false, patterns = false, drop_unseen = false, force = false, keep_shots = false;
  std::string name;
};

void print_replaced(const Json& replaced) {
  for (const Json& rig : replaced)
    std::cout << text_of(rig.at("name")) << "  in force since " << text_of(rig.at("created")) << "\n";
}

void print_status(const Json& status) {
  if (!status.at("look").is_null()) print_look(status.at("look"));
  if (!status.at("solution").is_null()) print_solution(status.at("solution"));
  if (status.at("look").is_null() && status.at("solution").is_null()) std::cout << "No calibration is under way.\n";
  if (!status.at("replaced").empty()) std::cout << "Earlier ones:\n";
  print_replaced(status.at("replaced"));
}

void show(const Json& result, bool json, void (*print)(const Json&)) {
  if (json)
    std::cout << result.dump(2) << "\n";
  else
    print(result);
}

void calibrate_offline(const OfflineCalibrationOptions& options, bool json) {
  if (options.recordings.empty() || options.out.empty())
    throw Failure{exit_usage, "calibrate: --recording and --out go together"};
  ThreadPool pool;
  const auto solved = calibrate_recordings(options, pool.work());
  if (!solved) throw Failure{exit_refused, solved.error().message};
  if (json) {
    std::cout << Json{{"verdict", to_string(solved->verdict)},
                      {"reason", solved->reason},
                      {"rms_px", solved->rms_px},
                      {"messages", solved->messages},
                      {"out", options.out.string()}}
                     .dump(2)
              << "\n";
    return;
  }
  for (const DeviceQuality& device : solved->devices)
    if (device.solved)
      std::printf("%-12s %.3f px, %d views, position within %.2f mm, direction within %.4f deg\n", device.id.c_str(),
                  device.rms_px, device.views, 1000 * device.pose.center_m, degrees(device.pose.rotation_rad));
  std::fflush(stdout);
  for (const std::string& message : solved->messages) std::cout << "note: " << printable(message) << "\n";
  std::cout << to_string(solved->verdict) << ": " << printable(solved->reason) << "\n";
}

}  // namespace

void add_calibrate_command(CLI::App& app, const bool& json, std::function<void()>& offline,
                           std::function<void(api::Client&)>& online) {
  const auto options = std::make_shared<CalibrateOptions>();
  auto* calibrate = app.add_subcommand(
      "calibrate", "calibrate the cameras: alone it leads through it, its subcommands are the steps, for scripts");
  OfflineCalibrationOptions& recordings = options->recordings;
  auto* boards = calibrate->add_option("--recording", recordings.recordings,
                                       "not the booth, but recordings with a board shot; may be repeated");
  const CorrectCommand correct(*calibrate);
  correct.option()->excludes(boards);
  calibrate->add_option("--out", recordings.out,
                        "with --recording or --correct, the folder to make: rig.json, report.html and figures");
  calibrate->add_option("--floor", recordings.floor_index,
                        "with --recording, the index in the first board shot at which the board lies on the floor; "
                        "otherwise the rig stays where the recording's lies");
  calibrate->add_flag("--keep-unseen", recordings.keep_unseen,
                      "with --recording, cameras that never saw the board keep the recording's calibration");
  calibrate->require_subcommand(0, 1);
  calibrate->callback([&, options, calibrate, correct] {
    if (!calibrate->get_subcommands().empty()) return;
    if (correct.wanted()) {
      offline = [options, correct] {
        if (options->recordings.out.empty()) throw Failure{exit_usage, "calibrate: --correct needs --out"};
        if (const auto done = correct.run(options->recordings.out); !done)
          throw Failure{exit_refused, done.error().message};
      };
      return;
    }
    if (!options->recordings.recordings.empty() || !options->recordings.out.empty()) {
      offline = [&json, options] { calibrate_offline(options->recordings, json); };
      return;
    }
    online = [&json](api::Client& client) {
      if (json) throw Failure{exit_usage, "calibrate: asks people; for scripts there are its subcommands"};
      Guide(client).run();
    };
  });

  const auto add = [&](const char* name, const char* help, auto work) {
    auto* command = calibrate->add_subcommand(name, help);
    command->callback([&online, &json, options, work] {
      online = [&json, options, work](api::Client& client) {
        RemoteCalibration booth(client);
        work(booth, *options, json);
      };
    });
    return command;
  };
  auto* capture = add("capture", "take one shot of the board; tells what each camera saw and what is thin",
                      [](RemoteCalibration& booth, const CalibrateOptions& o, bool as_json) {
                        show(booth.task("calibration.capture", {{"floor", o.floor}, {"patterns", o.patterns}}, "look"),
                             as_json, print_look);
                      });
  capture->add_flag("--on-floor", options->floor, "the board lies on the floor where the subject stands");
  capture->add_flag("--patterns", options->patterns, "the projector lights it too, so that it is calibrated along");
  auto* solve = add(
      "solve", "solve the cameras from the shots taken; nothing is applied yet",
      [](RemoteCalibration& booth, const CalibrateOptions& o, bool as_json) {
        show(booth.task("calibration.solve", {{"keep_unseen", !o.drop_unseen}}, "solution"), as_json, print_solution);
      });
  solve->add_flag("--drop-unseen", options->drop_unseen,
                  "cameras that never saw the board are left out, not kept as they were");
  const auto change = [](const char* method, Json (*params)(const CalibrateOptions&)) {
    return [method, params](RemoteCalibration& booth, const CalibrateOptions& o, bool as_json) {
      const Json result = booth.change(method, params(o));
      if (as_json) std::cout << result.dump(2) << "\n";
    };
  };
  add("apply", "put the solved calibration in force; the one before is kept",
      change("calibration.apply",
             [](const CalibrateOptions& o) {
               return Json{{"force", o.force}};
             }))
      ->add_flag("--force", options->force, "also a bad one");
  add("discard", "drop the shots and what was solved",
      change("calibration.discard",
             [](const CalibrateOptions& o) {
               return Json{{"shots", !o.keep_shots}};
             }))
      ->add_flag("--keep-shots", options->keep_shots, "only what was solved");
  add("restore", "put the calibration in force that was so before; once more undoes that",
      change("calibration.restore",
             [](const CalibrateOptions& o) {
               return o.name.empty() ? Json::object() : Json{{"name", o.name}};
             }))
      ->add_option("NAME", options->name, "of an earlier one, as calibrate status lists them");
  add("status", "the shots taken so far, what was solved, and the earlier calibrations",
      [](RemoteCalibration& booth, const CalibrateOptions&, bool as_json) {
        show(booth.call("calibration.status"), as_json, print_status);
      });
}

}  // namespace booth
