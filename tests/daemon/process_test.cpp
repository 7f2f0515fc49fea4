#include <random>
#include <set>

#include "tests/daemon/booth_programs.h"

namespace booth::test {
namespace {

using testing::IsEmpty;
using testing::SizeIs;

/// What is said of a capture that ended with the process.
constexpr const char* interrupted = "the booth was stopped while capturing";

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

/// As an upgrade does: the old program is told to stop while jobs wait and one runs, and another takes over.
TEST_F(Process, AnUpgradeInTheMiddleOfAQueueFinishesEveryJobOnce) {
  start_boothd();
  const std::string before = capture({{"face", "none"}});
  ASSERT_TRUE(wait_job(before, "done"));
  const auto published = fs::last_write_time(options_.config.booth.avatars() / before / "avatar.dae");
  reconstruct_.behave("hang");
  std::vector<std::string> queue;
  for (int i = 0; i < 3; ++i) {
    queue.push_back(capture({{"face", "none"}}));
    ASSERT_TRUE(wait_until(
        [&] { return call("system.status")["ready"] == true && job(queue.back())["state"] != "not_found"; }));
  }
  ASSERT_TRUE(wait_job(queue[0], "running"));
  EXPECT_EQ(job(queue[2])["state"], "queued");
  ::kill(boothd_, SIGTERM);
  const int status = wait_exit();
  ASSERT_TRUE(WIFEXITED(status) && WEXITSTATUS(status) == 0) << status;
  const size_t calls = reconstruct_.calls();

  reconstruct_.behave("good");
  const fs::path newer = folder_.path() / "newer";
  fs::copy_file(BOOTHD, newer);
  start_boothd(newer);
  for (const std::string& id : queue) EXPECT_TRUE(wait_job(id, "done")) << job(id);
  EXPECT_EQ(reconstruct_.calls(), calls + queue.size()) << "each job ran once more, what was done did not";
  EXPECT_EQ(fs::last_write_time(options_.config.booth.avatars() / before / "avatar.dae"), published);
  std::multiset<std::string> avatars;
  const Json list = call("avatar.list");
  for (const Json& avatar : list["avatars"]) avatars.insert(avatar["id"]);
  queue.push_back(before);
  EXPECT_EQ(avatars, std::multiset<std::string>(queue.begin(), queue.end()));
  expect_all_whole();
  EXPECT_TRUE(wait_until([&] { return traces(".partial").empty(); }));
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

TEST_F(Process, RefusesABadConfiguration) {
  EXPECT_EQ(run({BOOTHD, "--config", config_, "--reconstruct", reconstruct_.path(), "--check"}).first, 0);
  std::ofstream(config_) << "[jobs]\nworkers = 0\n[disk]\nreserve = 1\n";
  EXPECT_EQ(run({BOOTHD, "--config", config_, "--check"}).first, 2);
  EXPECT_EQ(run({BOOTHD, "--config", config_}).first, 2);
  EXPECT_EQ(run({BOOTHD, "--config", folder_.path() / "nothing"}).first, 2);
}

}  // namespace
}  // namespace booth::test
