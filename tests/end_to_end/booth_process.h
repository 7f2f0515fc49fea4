#pragma once

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>

#include <fstream>
#include <sstream>

#include "replay/recording_file.h"
#include "tests/daemon/test_booth.h"

extern char** environ;

namespace booth::test {

/// What a program printed is in `output` afterwards. @return the process; the test fails where it cannot be started
inline pid_t spawn(const std::vector<std::string>& command, const fs::path& output) {
  std::vector<char*> arguments;
  for (const std::string& argument : command) arguments.push_back(const_cast<char*>(argument.c_str()));
  arguments.push_back(nullptr);
  posix_spawn_file_actions_t actions;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_addopen(&actions, STDOUT_FILENO, output.c_str(), O_WRONLY | O_CREAT | O_APPEND, 0644);
  posix_spawn_file_actions_adddup2(&actions, STDOUT_FILENO, STDERR_FILENO);
  pid_t pid = -1;
  EXPECT_EQ(::posix_spawn(&pid, arguments[0], &actions, nullptr, arguments.data(), environ), 0) << command[0];
  posix_spawn_file_actions_destroy(&actions);
  return pid;
}

inline int wait_exit(pid_t pid) {
  int status = 0;
  ::waitpid(pid, &status, 0);
  return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

inline std::string text_of(const fs::path& file) {
  std::stringstream text;
  text << std::ifstream(file, std::ios::binary).rdbuf();
  return text.str();
}

/// The real boothd, as a process of its own, in a scratch folder.
class BoothProcess {
 public:
  explicit BoothProcess(const fs::path& folder) : folder_(folder) { fs::create_directories(state() / "calibration"); }
  ~BoothProcess() { stop(); }
  BoothProcess(const BoothProcess&) = delete;
  BoothProcess& operator=(const BoothProcess&) = delete;

  fs::path state() const { return folder_ / "state"; }
  fs::path log() const { return folder_ / "log"; }
  std::string control() const { return "ipc://" + (folder_ / "control").string(); }
  std::string events() const { return "ipc://" + (folder_ / "events").string(); }

  /// @param sections     of the configuration, [booth], [api] and [disk] aside
  /// @param reconstruct  the program that makes avatars
  void start(const std::string& sections, const fs::path& reconstruct) {
    const fs::path config = folder_ / "boothd.toml";
    std::ofstream(config) << "[booth]\nstate_directory = \"" << state().string() << "\"\n[api]\ncontrol = \""
                          << control() << "\"\nevents = \"" << events() << "\"\n[disk]\nreserve_mib = 0\n"
                          << sections;
    pid_ = spawn({BOOTHD, "--config", config, "--reconstruct", reconstruct}, log());
    client_ = std::make_unique<RawClient>(control());
    call("system.status");
    listener_ = std::make_unique<Listener>(events());
  }
  /// Its exit status.
  int stop() {
    if (pid_ < 0) return 0;
    ::kill(pid_, SIGTERM);
    return wait_exit(std::exchange(pid_, -1));
  }

  RawClient& client() { return *client_; }
  Listener& listener() { return *listener_; }
  Json call(const std::string& method, const Json& params = Json::object()) {
    const Response response = client_->call(method, params);
    EXPECT_TRUE(response.message.contains("result")) << method << ": " << response.message << "\n" << text_of(log());
    return response.message.value("result", Json());
  }
  /// The kinds of the reasons why no capture can start.
  std::vector<std::string> not_ready() {
    std::vector<std::string> kinds;
    const Json status = call("system.status");
    for (const Json& reason : status["not_ready"]) kinds.push_back(reason["kind"]);
    return kinds;
  }
  bool all_online() {
    const Json status = call("system.status");
    return std::all_of(status["cameras"].begin(), status["cameras"].end(),
                       [](const Json& camera) { return camera["state"] == "online"; });
  }
  Json camera(const std::string& id) {
    const Json status = call("system.status");
    for (const Json& camera : status["cameras"])
      if (camera["id"] == id) return camera;
    return {};
  }
  /// The last event of a task.
  Json end_of_task(const std::string& task) {
    const auto end = listener_->find([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["task"] == task && event.fields["state"] != "running";
    });
    return end ? end->fields : Json();
  }
  /// The event that ended a capture: its topic and fields.
  SeenEvent end_of_capture(const std::string& id) {
    const auto end = listener_->find(
        [&](const SeenEvent& event) { return event.topic.starts_with("capture.") && event.fields["capture"] == id; });
    return end.value_or(SeenEvent{"nothing", {}});
  }
  /// The reports of a capture's shots.
  std::vector<Json> shots(const std::string& id) {
    std::vector<Json> found;
    for (const SeenEvent& event : listener_->heard("shot"))
      if (event.fields["capture"] == id) found.push_back(event.fields);
    return found;
  }

 private:
  const fs::path folder_;
  pid_t pid_ = -1;
  std::unique_ptr<RawClient> client_;
  std::unique_ptr<Listener> listener_;
};

/// Two recordings hold the same pictures of these roles, pixel by pixel.
inline void expect_same_pictures(const Recording& expected, const Recording& actual,
                                 const std::vector<ShotRole>& roles) {
  for (const ShotRole role : roles) {
    const Shot* from = expected.find(role);
    const Shot* to = actual.find(role);
    ASSERT_TRUE(from != nullptr && to != nullptr) << to_string(role);
    ASSERT_EQ(from->frames.size(), to->frames.size()) << to_string(role);
    EXPECT_EQ(from->pattern.has_value(), to->pattern.has_value());
    for (const FrameRecord& record : from->frames) {
      const auto match = std::find_if(to->frames.begin(), to->frames.end(), [&](const FrameRecord& other) {
        return other.camera == record.camera && other.index == record.index;
      });
      ASSERT_NE(match, to->frames.end()) << record.camera << " " << record.index;
      const auto wanted = load_frame(expected, record), got = load_frame(actual, *match);
      ASSERT_TRUE(wanted && got) << record.camera << " " << record.index;
      EXPECT_TRUE(wanted->pixels->samples == got->pixels->samples)
          << to_string(role) << ": " << record.camera << " " << record.index;
    }
  }
}

/// Two avatars are the same, byte by byte, but for what names them and says when they were made.
inline void expect_same_avatar(const fs::path& expected, const fs::path& actual) {
  std::vector<std::string> names, others;
  for (const auto& entry : fs::directory_iterator(expected)) names.push_back(entry.path().filename());
  for (const auto& entry : fs::directory_iterator(actual)) others.push_back(entry.path().filename());
  std::sort(names.begin(), names.end());
  std::sort(others.begin(), others.end());
  ASSERT_EQ(names, others);
  for (const std::string& name : names) {
    std::string one = text_of(expected / name), other = text_of(actual / name);
    if (name == "avatar.dae") {
      const auto without_dates = [](std::string& text) {
        for (const auto& [from, to] : {std::pair{"<created>", "</created>"}, std::pair{"<modified>", "</modified>"}}) {
          const size_t begin = text.find(from), end = text.find(to);
          if (begin != std::string::npos && end != std::string::npos) text.erase(begin, end - begin);
        }
      };
      without_dates(one);
      without_dates(other);
    }
    if (name == "metadata.json") {
      Json first = Json::parse(one), second = Json::parse(other);
      for (const char* own : {"id", "created", "capture", "recording", "label", "files", "timings", "stage_seconds"}) {
        first.erase(own);
        second.erase(own);
      }
      EXPECT_EQ(first, second);
      continue;
    }
    EXPECT_TRUE(one == other) << name << " differs";
  }
}

}  // namespace booth::test
