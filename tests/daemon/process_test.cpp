#include <gmock/gmock.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <random>
#include <set>

#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::IsEmpty;
using testing::SizeIs;

/// What is said of a capture that ended with the process.
constexpr const char* interrupted = "the booth was stopped while capturing";

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
  void start_boothd() {
    boothd_ = spawn({BOOTHD, "--config", config_, "--reconstruct", reconstruct_.path()}, folder_.path() / "log", true);
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
      for (const Shot& shot : recording->shots) EXPECT_THAT(load_shot(*recording, shot).faults, IsEmpty());
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

TEST_F(Process, KilledAtAnyMomentLosesNothingThatWasDone) {
  constexpr int rounds = 12;
  std::mt19937 random(7);
  std::set<std::string> acknowledged, done;
  reconstruct_.behave("slow");
  for (int round = 0; round < rounds; ++round) {
    start_boothd();
    const Json jobs = call("job.list");
    for (const Json& job : jobs["jobs"]) {
      if (job["state"] != "failed") continue;
      EXPECT_EQ(job["error"]["message"], interrupted) << job;
    }
    acknowledged.insert(capture());
    const auto until = std::chrono::steady_clock::now() + std::chrono::milliseconds(random() % 400);
    while (std::chrono::steady_clock::now() < until)
      if (const Json now = call("job.list"); !now["jobs"].empty() && now["jobs"].back()["state"] != "failed")
        done.insert(now["jobs"].back()["id"]);
    ::kill(boothd_, SIGKILL);
    wait_exit();
    expect_all_whole();
  }
  start_boothd();
  for (const std::string& id : acknowledged)
    if (!done.contains(id) && job(id)["state"] != "failed") done.insert(id);
  for (const std::string& id : done) EXPECT_TRUE(wait_job(id, "done")) << job(id);
  EXPECT_TRUE(wait_until([&] { return traces(".partial").empty(); }));
  std::set<std::string> avatars;
  const Json list = call("avatar.list");
  for (const Json& avatar : list["avatars"]) avatars.insert(avatar["id"]);
  for (const std::string& id : done) EXPECT_EQ(avatars.count(id), 1) << id << " was lost";
  EXPECT_THAT(entries(options_.config.booth.recordings()), SizeIs(avatars.size()));
}

TEST_F(Process, AnAcknowledgedCaptureIsThereOrNamedAsFailed) {
  constexpr int rounds = 10;
  std::mt19937 random(23);
  std::vector<std::string> acknowledged, failed;
  for (int round = 0; round < rounds; ++round) {
    start_boothd();
    // Any instant until it is recorded, and some in the countdown, where it surely is not.
    const bool counting = round % 3 == 0;
    acknowledged.push_back(capture({{"face", counting ? "none" : "auto"}, {"countdown_s", counting ? 5 : 0}}));
    std::this_thread::sleep_for(std::chrono::milliseconds(random() % 60));
    ::kill(boothd_, SIGKILL);
    wait_exit();
  }
  start_boothd();
  for (const std::string& id : acknowledged) {
    ASSERT_NE(job(id)["state"], "not_found") << id << " is forgotten";
    if (job(id)["state"] != "failed") {
      EXPECT_TRUE(wait_job(id, "done")) << job(id);
      continue;
    }
    EXPECT_EQ(job(id)["error"]["message"], interrupted);
    EXPECT_EQ(job(id)["error"]["kind"], "internal");
    EXPECT_EQ(refusal("job.retry", {{"job", id}}), "invalid_state");
    EXPECT_EQ(refusal("capture.cancel", {{"capture", id}}), "invalid_state");
    failed.push_back(id);
  }
  EXPECT_THAT(failed, testing::Contains(acknowledged[0]));
  const Json queue = call("system.status")["queue"];
  EXPECT_THAT(queue, SizeIs(failed.size()));
  EXPECT_EQ(queue[0]["id"], failed[0]);
  call("capture.delete", {{"capture", failed[0]}});
  EXPECT_THAT(traces(failed[0]), IsEmpty());
  EXPECT_EQ(job(failed[0])["state"], "not_found");
}

TEST_F(Process, ACaptureThatTheEndOfTheServiceCancelsIsNamedAfterwards) {
  start_boothd();
  const std::string id = capture({{"countdown_s", 30}});
  ::kill(boothd_, SIGTERM);
  EXPECT_EQ(wait_exit(), 0);
  start_boothd();
  EXPECT_EQ(job(id)["error"]["message"], interrupted);
}

TEST_F(Process, WhatWasDeletedStaysDeletedWhenKilled) {
  constexpr int rounds = 6;
  std::mt19937 random(11);
  reconstruct_.behave("slow");
  std::vector<std::string> deleted;
  for (int round = 0; round < rounds; ++round) {
    start_boothd();
    for (const std::string& id : deleted) EXPECT_THAT(traces(id), IsEmpty());
    deleted.push_back(capture({{"face", "none"}}));
    std::this_thread::sleep_for(std::chrono::milliseconds(random() % 500));  // anywhere between countdown and avatar
    client().send(
        {Json{{"jsonrpc", "2.0"}, {"id", 1}, {"method", "capture.delete"}, {"params", {{"capture", deleted.back()}}}}
             .dump()});
    EXPECT_EQ(client().receive_response().kind(), "");
    ::kill(boothd_, SIGKILL);
    wait_exit();
  }
  start_boothd();
  for (const std::string& id : deleted) EXPECT_THAT(traces(id), IsEmpty());
  EXPECT_TRUE(call("job.list")["jobs"].empty());
}

TEST_F(Process, TheReconstructionDiesWithTheDaemon) {
  reconstruct_.behave("hang");
  start_boothd();
  const std::string id = capture({{"face", "none"}});
  ASSERT_TRUE(wait_until([&] { return job(id)["stage"] == "hull"; }));
  ::kill(boothd_, SIGKILL);
  wait_exit();
  int pid = 0;
  std::ifstream(folder_.path() / "pid") >> pid;
  const auto lives = [&] {
    std::ifstream file("/proc/" + std::to_string(pid) + "/stat");
    const std::string text((std::istreambuf_iterator<char>(file)), {});
    return !text.empty() && text.find(") Z ") == std::string::npos;
  };
  EXPECT_TRUE(wait_until([&] { return !lives(); }));
}

TEST_F(Process, EndsCleanlyOnASignal) {
  reconstruct_.behave("hang");
  for (const int signal : {SIGTERM, SIGINT}) {
    start_boothd();
    capture({{"face", "none"}});
    ::kill(boothd_, signal);
    const int status = wait_exit();
    EXPECT_TRUE(WIFEXITED(status) && WEXITSTATUS(status) == 0) << status;
    expect_all_whole();
  }
  EXPECT_THAT(traces(".partial"), IsEmpty());
}

TEST_F(Process, BoothctlOperatesIt) {
  EXPECT_EQ(run({BOOTHCTL, "--control", options_.config.api.control, "--timeout", "0.2", "status"}).first, 3);
  start_boothd();
  EXPECT_EQ(boothctl({"status"}).first, 0);
  EXPECT_THAT(boothctl({"status"}).second, testing::HasSubstr("ready       yes"));
  EXPECT_EQ(Json::parse(boothctl({"--json", "status"}).second)["state"], "idle");

  const auto [status, output] = boothctl({"capture", "--label", "Zoë", "--countdown", "0.2", "--wait"});
  ASSERT_EQ(status, 0);
  const std::string id = output.substr(0, output.find('\n'));
  EXPECT_EQ(Json::parse(boothctl({"--json", "avatars", "list"}).second)["avatars"][0]["id"], id);
  const fs::path to = folder_.path() / "got";
  EXPECT_EQ(boothctl({"avatars", "fetch", id, "--to", to}).first, 0);
  std::ifstream file(to / "avatar.dae");
  EXPECT_EQ(std::string((std::istreambuf_iterator<char>(file)), {}), "0123456789");
  EXPECT_EQ(boothctl({"avatars", "fetch", id, "nothing", "--to", to}).first, 1);
  EXPECT_THAT(boothctl({"jobs"}).second, testing::HasSubstr("done"));
  EXPECT_EQ(boothctl({"retry", id}).first, 1);
  EXPECT_EQ(boothctl({"avatars", "delete", id}).first, 0);
  EXPECT_TRUE(wait_until([&] { return traces(id).empty(); }));

  reconstruct_.behave("fail");
  EXPECT_EQ(boothctl({"capture", "--wait"}).first, 1);
  EXPECT_EQ(boothctl({"capture", "--face", "pretty"}).first, 2);
  EXPECT_EQ(boothctl({}).first, 2);
  EXPECT_EQ(boothctl({"--help"}).first, 0);
  EXPECT_EQ(boothctl({"shutdown"}).first, 0);
  const int ended = wait_exit();
  EXPECT_TRUE(WIFEXITED(ended) && WEXITSTATUS(ended) == 0);
}

TEST_F(Process, KeysOpenTheBoothToOtherMachines) {
  const fs::path keys = folder_.path() / "keys", mine = folder_.path() / "mine.key";
  EXPECT_EQ(run({BOOTHCTL, "keys", "add", "--folder", keys, "mine"}).first, 1) << "the booth has no key yet";
  ASSERT_EQ(run({BOOTHCTL, "keys", "server", "--folder", keys}).first, 0);
  EXPECT_EQ(run({BOOTHCTL, "keys", "server", "--folder", keys}).first, 1) << "not a second time";
  ASSERT_EQ(run({BOOTHCTL, "keys", "add", "--folder", keys, "--role", "viewer", "--out", mine, "mine"}).first, 0);
  EXPECT_EQ(run({BOOTHCTL, "keys", "add", "--folder", keys, "--role", "god", "other"}).first, 2);
  for (const fs::path& secret : {keys / "server.key", mine}) {
    struct stat status {};
    ASSERT_EQ(::stat(secret.c_str(), &status), 0);
    EXPECT_EQ(status.st_mode & 07777U, 0600U) << secret;
  }
  options_.config.api.server_key = keys / "server.key";
  options_.config.api.client_keys = keys / "clients";
  options_.config.api.remote_control = "tcp://127.0.0.1:" + std::to_string(20000 + ::getpid() % 10000);
  std::ofstream(config_) << write_config(options_.config);
  start_boothd();
  const auto remote = [&](std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), {BOOTHCTL, "--control", options_.config.api.remote_control, "--timeout", "30"});
    return run(arguments);
  };
  EXPECT_EQ(remote({"status"}).first, 2) << "without a key";
  const auto [code, text] = remote({"--key", mine, "--json", "status"});
  EXPECT_EQ(code, 0);
  EXPECT_EQ(Json::parse(text)["state"], "idle");
  EXPECT_EQ(remote({"--key", mine, "shutdown"}).first, 1) << "a viewer may not";
  EXPECT_EQ(Json::parse(run({BOOTHCTL, "--json", "keys", "list", "--folder", keys}).second)["clients"][0]["role"],
            "viewer");
  EXPECT_EQ(run({BOOTHCTL, "keys", "revoke", "--folder", keys, "mine"}).first, 0);
  EXPECT_EQ(run({BOOTHCTL, "keys", "revoke", "--folder", keys, "mine"}).first, 1);
  ASSERT_EQ(boothctl({"shutdown"}).first, 0);
  wait_exit();
}

TEST_F(Process, TheReportHoldsNothingOfTheVisitors) {
  start_boothd();
  const std::string label = "Zoë Müller-Lüdenscheidt";
  const std::string id = capture({{"face", "none"}, {"label", label}});
  ASSERT_TRUE(wait_job(id, "done"));
  reconstruct_.behave("fail");
  const std::string failed = capture({{"face", "none"}, {"label", "Erwin Lindemann"}});
  ASSERT_TRUE(wait_job(failed, "failed"));
  // As if something had let a label slip into the log.
  std::ofstream(folder_.path() / "log", std::ios::app) << "a line about " << label << "\n";
  const fs::path report = folder_.path() / "report.tar.gz", unpacked = folder_.path() / "unpacked";
  const auto said = boothctl({"report", "--to", report, "--config", config_, "--log", folder_.path() / "log"});
  ASSERT_EQ(said.first, 0);
  fs::create_directories(unpacked);
  ASSERT_EQ(run({"/bin/tar", "-xzf", report, "-C", unpacked}).first, 0);
  EXPECT_THAT(entries(unpacked),
              testing::UnorderedElementsAre("boothd.toml", "describe.json", "doctor.json", "history.json", "log.txt",
                                            "metrics.json", "status.json", "versions.txt"));
  for (const std::string& name : entries(unpacked)) {
    std::ifstream file(unpacked / name);
    const std::string text((std::istreambuf_iterator<char>(file)), {});
    EXPECT_THAT(text, testing::Not(IsEmpty())) << name;
    for (const std::string& private_text : {label, std::string("Lindemann"), id, failed})
      EXPECT_THAT(text, testing::Not(testing::HasSubstr(private_text))) << name;
  }
  std::ifstream log(unpacked / "log.txt");
  const std::string text((std::istreambuf_iterator<char>(log)), {});
  EXPECT_THAT(text, testing::HasSubstr("capture-1"));

  EXPECT_THAT(boothctl({"metrics", "--prometheus"}).second,
              testing::HasSubstr("# TYPE booth_request_seconds histogram"));
  EXPECT_THAT(boothctl({"history"}).second,
              testing::AllOf(testing::HasSubstr("started 1 times; captures "), testing::HasSubstr(" threads")));
  ASSERT_EQ(boothctl({"shutdown"}).first, 0);
  wait_exit();
  EXPECT_EQ(run({BOOTHCTL, "--control", options_.config.api.control, "--timeout", "0.2", "report", "--to", report,
                 "--config", config_, "--log", config_})
                .first,
            0)
      << "also without the booth";
}

/// What is deleted is gone from all that the booth stores; what it logs never had a name in it.
TEST_F(Process, NothingIsLeftOfWhoWasDeleted) {
  constexpr const char* label = "Zo\xc3\xab Quisling";
  const auto traces = [&](const std::vector<std::string>& words) {
    std::vector<std::string> command{"traces", "--config", config_};
    command.insert(command.end(), words.begin(), words.end());
    return boothctl(command);
  };
  start_boothd();
  std::vector<std::string> ids;
  for (const char* behaviour : {"good", "fail", "crash"}) {
    reconstruct_.behave(behaviour);
    ids.push_back(capture({{"face", "none"}, {"label", label}, {"key", std::string("press-") + behaviour}}));
    ASSERT_TRUE(wait_until([&] { return job(ids.back())["state"] == (ids.size() == 1 ? "done" : "failed"); }));
  }
  EXPECT_EQ(traces({ids[0]}).first, 1);
  EXPECT_THAT(traces({label}).second, testing::HasSubstr(ids[1]));
  EXPECT_EQ(call("avatar.delete", {{"avatar", ids[0]}}), Json::object());
  for (const std::string& id : ids) call("capture.delete", {{"capture", id}});
  ASSERT_TRUE(wait_until([&] { return entries(options_.config.booth.state_directory / "deleting").empty(); }));
  const auto [status, output] = traces({ids[0], ids[1], ids[2], label});
  EXPECT_EQ(status, 0) << output;
  EXPECT_EQ(traces({label, "--log", folder_.path() / "log"}).first, 0) << "a label is in the log";
  EXPECT_EQ(traces({ids[0], "--log", folder_.path() / "log"}).first, 1) << "the log is searched";
  EXPECT_EQ(traces({"press-good"}).first, 1) << "the clients' own words are kept for a day";
}

TEST_F(Process, RefusesABadConfiguration) {
  EXPECT_EQ(run({BOOTHD, "--config", config_, "--reconstruct", reconstruct_.path(), "--check"}).first, 0);
  std::ofstream(config_) << "[jobs]\nworkers = 0\n[disk]\nreserve = 1\n";
  EXPECT_EQ(run({BOOTHD, "--config", config_, "--check"}).first, 2);
  EXPECT_EQ(run({BOOTHD, "--config", config_}).first, 2);
  EXPECT_EQ(run({BOOTHD, "--config", folder_.path() / "nothing"}).first, 2);
}

}  // namespace
}  // namespace booth::test
