#pragma once

#include <gmock/gmock.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include "tests/daemon/test_booth.h"

namespace booth::test {

/// The real programs, as processes of their own.
class Process : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    config_ = folder_.path() / "boothd.toml";
    std::ofstream(config_) << write_config(options_.config);
  }
  void TearDown() override {
    if (boothd_ > 0) ::kill(boothd_, SIGKILL), wait_exit();
  }

  /// What it says goes to a file; a daemon's log too.
  static pid_t spawn(const std::vector<std::string>& command, const fs::path& output, bool log = false) {
    const pid_t pid = ::fork();
    if (pid != 0) return pid;
    std::vector<char*> arguments;
    for (const std::string& argument : command) arguments.push_back(const_cast<char*>(argument.c_str()));
    arguments.push_back(nullptr);
    if (::freopen(output.c_str(), "a", stdout) != nullptr && (!log || ::dup2(STDOUT_FILENO, STDERR_FILENO) >= 0))
      ::execv(arguments[0], arguments.data());
    ::_exit(127);
  }
  /// Its exit status, and what it wrote.
  std::pair<int, std::string> run(std::vector<std::string> command) {
    const fs::path output = folder_.path() / "output";
    fs::remove(output);
    int status = 0;
    ::waitpid(spawn(command, output), &status, 0);
    std::ifstream file(output);
    return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, std::string((std::istreambuf_iterator<char>(file)), {})};
  }
  std::pair<int, std::string> boothctl(const std::vector<std::string>& arguments) {
    std::vector<std::string> command{
        BOOTHCTL, "--control", options_.config.api.control, "--events", options_.config.api.events, "--timeout", "30"};
    command.insert(command.end(), arguments.begin(), arguments.end());
    return run(command);
  }
  void start_boothd(const fs::path& program = BOOTHD) {
    boothd_ = spawn({program, "--config", config_, "--reconstruct", reconstruct_.path()}, folder_.path() / "log", true);
    client_ = std::make_unique<RawClient>(options_.config.api.control);
    ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == true; }));
  }
  int wait_exit() {
    int status = 0;
    ::waitpid(boothd_, &status, 0);
    boothd_ = -1;
    return status;
  }
  void expect_all_whole() {
    for (const std::string& id : entries(options_.config.booth.recordings())) {
      if (id.starts_with(".")) continue;  // nobody takes it for a recording
      const auto recording = read_recording(options_.config.booth.recordings() / id);
      ASSERT_TRUE(recording) << recording.error().message;
      for (const Shot& shot : recording->shots) EXPECT_THAT(load_shot(*recording, shot).faults, testing::IsEmpty());
    }
    for (const std::string& id : entries(options_.config.booth.avatars())) {
      if (!id.starts_with(".")) {
        EXPECT_TRUE(fs::exists(options_.config.booth.avatars() / id / "metadata.json")) << id;
      }
    }
  }

  fs::path config_;
  pid_t boothd_ = -1;
};

}  // namespace booth::test
