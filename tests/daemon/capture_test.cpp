#include <gmock/gmock.h>

#include "replay/durable_folder.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;

constexpr int patterns = 8;  ///< of the tiny recording: 2·2 for its columns, 2·1 for its rows, white, black

class Capture : public TestBooth {
 protected:
  void start_listening() {
    start();
    listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
  }
  Listener& listener() { return *listener_; }
  /// The kind of the failure, or "done".
  std::string end_of(const std::string& id) {
    const auto end = listener().find(
        [&](const SeenEvent& event) { return event.topic.starts_with("capture.") && event.fields["capture"] == id; });
    if (!end) return "nothing";
    return end->topic == "capture.done" ? "done" : end->fields["kind"].get<std::string>();
  }
  void expect_nothing_left(const std::string& id) {
    EXPECT_TRUE(wait_until([&] { return traces(id).empty(); })) << traces(id)[0];
    EXPECT_TRUE(wait_until([&] { return call("system.status")["state"] == "idle"; }));
    EXPECT_EQ(call("system.status")["ready"], true);
  }
  Recording recording(const std::string& id) {
    auto read = read_recording(options_.config.booth.recordings() / id);
    EXPECT_TRUE(read) << read.error().message;
    return read ? *read : Recording{};
  }
  std::unique_ptr<Listener> listener_;
};

TEST_F(Capture, BecomesARecordingAJobAndAnAvatar) {
  start_listening();
  const std::string id = capture({{"label", "Zoë"}});
  const auto published = listener().find("avatar.published");
  ASSERT_TRUE(published);
  EXPECT_EQ(published->fields["avatar"], id);
  EXPECT_EQ(published->fields["capture"], id);
  EXPECT_EQ(published->fields["job"], id);
  EXPECT_EQ(published->fields["label"], "Zoë");
  EXPECT_EQ(published->fields["files"], Json({"avatar.dae", "metadata.json"}));

  const auto shots = listener().heard("shot");
  ASSERT_THAT(shots, SizeIs(1 + patterns));
  EXPECT_EQ(shots[0].fields["role"], "body");
  EXPECT_EQ(shots[0].fields["cameras"], 6);
  EXPECT_THAT(shots[0].fields["missing"], IsEmpty());
  EXPECT_DOUBLE_EQ(shots[0].fields["skew_us"].get<double>(), 210);
  for (int i = 0; i < patterns; ++i) {
    EXPECT_EQ(shots[i + 1].fields["role"], "gray_code");
    EXPECT_EQ(shots[i + 1].fields["index"], i);
    EXPECT_EQ(shots[i + 1].fields["of"], patterns);
    EXPECT_EQ(shots[i + 1].fields["cameras"], 2);
  }
  double fraction = 0;
  for (const SeenEvent& progress : listener().heard("job.progress")) {
    EXPECT_GE(progress.fields["fraction"], fraction);
    fraction = progress.fields["fraction"];
  }
  EXPECT_EQ(fraction, 1);

  const Recording taken = recording(id);
  EXPECT_EQ(taken.id, id);
  EXPECT_EQ(taken.label, "Zoë");
  EXPECT_EQ(taken.face, "auto");
  ASSERT_NE(taken.find(ShotRole::background), nullptr);
  ASSERT_NE(taken.find(ShotRole::body), nullptr);
  ASSERT_NE(taken.find(ShotRole::gray_code), nullptr);
  EXPECT_THAT(taken.find(ShotRole::background)->frames, SizeIs(6));
  EXPECT_THAT(taken.find(ShotRole::body)->frames, SizeIs(6));
  EXPECT_THAT(taken.find(ShotRole::gray_code)->frames, SizeIs(2 * patterns));
  EXPECT_THAT(load_shot(taken, *taken.find(ShotRole::gray_code)).faults, IsEmpty());
  EXPECT_EQ(job(id)["avatar"], id);
  EXPECT_EQ(job(id)["fraction"], 1);
}

TEST_F(Capture, WithoutAFaceTakesNoPatterns) {
  start_listening();
  for (const char* face : {"none", "passive"}) {
    const std::string id = capture({{"face", face}});
    EXPECT_EQ(end_of(id), "done");
    EXPECT_EQ(recording(id).find(ShotRole::gray_code), nullptr);
    EXPECT_EQ(recording(id).face, face);
  }
}

TEST_F(Capture, CountsDown) {
  start_listening();
  const std::string id = capture({{"countdown_s", 1.5}});
  EXPECT_EQ(call("system.status")["state"], "countdown");
  EXPECT_EQ(call("system.status")["capture"], id);
  EXPECT_EQ(end_of(id), "done");
  std::vector<double> left;
  for (const SeenEvent& tick : listener().heard("countdown")) left.push_back(tick.fields["remaining_s"]);
  EXPECT_THAT(left, ElementsAre(1.5, 1, 0));
  std::vector<std::string> states;
  for (const SeenEvent& state : listener().heard("state"))
    if (states.empty() || states.back() != state.fields["state"]) states.push_back(state.fields["state"]);
  EXPECT_THAT(states, ElementsAre("countdown", "capturing", "idle"));
}

TEST_F(Capture, OneAtATime) {
  start_listening();
  const std::string id = capture({{"countdown_s", 60}});
  EXPECT_EQ(refusal("capture.start"), "busy");
  const Json status = call("system.status");
  EXPECT_EQ(status["ready"], false);
  EXPECT_EQ(status["not_ready"][0]["kind"], "busy");
  call("capture.cancel", {{"capture", id}});
  EXPECT_EQ(end_of(id), "cancelled");
  expect_nothing_left(id);
  EXPECT_EQ(refusal("capture.cancel", {{"capture", id}}), "invalid_state");
  EXPECT_EQ(end_of(capture()), "done");
}

TEST_F(Capture, MayBeStartedAgainAsSoonAsTheLastIsDone) {
  start_listening();
  for (int i = 0; i < 5; ++i) EXPECT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_EQ(refusal("capture.cancel", {{"capture", listener().heard("capture.done")[0].fields["capture"]}}),
            "invalid_state");
}

TEST_F(Capture, CancelledWhileAPatternIsAwaitedLeavesNothing) {
  options_.config.replay.faults = {{.kind = ReplayFault::Kind::missing, .role = ShotRole::gray_code}};
  options_.config.capture.frame_timeout_ms = 60'000;
  start_listening();
  const std::string id = capture();
  ASSERT_TRUE(listener().find("shot"));
  call("capture.cancel", {{"capture", id}});
  EXPECT_EQ(end_of(id), "cancelled");
  expect_nothing_left(id);
}

TEST_F(Capture, AMissingCameraIsNamedAndTheCaptureGoesOn) {
  options_.config.replay.faults = {{.kind = ReplayFault::Kind::missing, .camera = "b2", .role = ShotRole::body}};
  start_listening();
  const std::string id = capture({{"face", "none"}});
  EXPECT_EQ(end_of(id), "done");
  EXPECT_EQ(listener().heard("shot")[0].fields["missing"], Json({"b2"}));
  EXPECT_THAT(recording(id).find(ShotRole::body)->frames, SizeIs(5));
  const Json camera = call("system.status")["cameras"][2];
  EXPECT_EQ(camera["state"], "degraded");
  EXPECT_EQ(camera["dropped"], 2) << "the shot's trigger, and the one in its place";
  EXPECT_THAT(camera["message"].get<std::string>(), HasSubstr("no frame"));
}

TEST_F(Capture, ALateFrameIsMissing) {
  options_.config.replay.faults = {
      {.kind = ReplayFault::Kind::late, .camera = "b1", .role = ShotRole::body, .capture = 0, .delay_ms = 5000}};
  start_listening();
  EXPECT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_EQ(listener().heard("shot")[0].fields["missing"], Json({"b1"}));
  EXPECT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_THAT(listener().heard("shot")[1].fields["missing"], IsEmpty());
  EXPECT_EQ(call("system.status")["cameras"][1]["state"], "online") << "well again";
}

TEST_F(Capture, ADamagedFrameIsMissingAndNotWaitedFor) {
  options_.config.replay.faults = {{.kind = ReplayFault::Kind::corrupt, .camera = "b3", .role = ShotRole::body}};
  options_.config.capture.frame_timeout_ms = 60'000;
  start_listening();
  EXPECT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_EQ(listener().heard("shot")[0].fields["missing"], Json({"b3"}));
}

TEST_F(Capture, TooFewBodyCamerasFail) {
  options_.config.replay.faults = {{.kind = ReplayFault::Kind::missing, .camera = "b0", .role = ShotRole::body},
                                   {.kind = ReplayFault::Kind::missing, .camera = "b1", .role = ShotRole::body}};
  start_listening();
  const std::string id = capture();
  EXPECT_EQ(end_of(id), "camera_unavailable");
  EXPECT_THAT(listener().heard("capture.failed")[0].fields["message"].get<std::string>(), HasSubstr("b0, b1"));
  expect_nothing_left(id);
  EXPECT_THAT(call("job.list")["jobs"], IsEmpty());
}

TEST_F(Capture, AMissedPatternIsShownAgain) {
  options_.config.replay.faults = {
      {.kind = ReplayFault::Kind::missing, .camera = "f0", .role = ShotRole::gray_code, .index = 3}};
  start_listening();
  const std::string id = capture();
  EXPECT_EQ(end_of(id), "done");
  const Recording taken = recording(id);
  EXPECT_THAT(taken.find(ShotRole::gray_code)->frames, SizeIs(2 * patterns));
  for (const FrameSet& set : load_shot(taken, *taken.find(ShotRole::gray_code)).sets)
    for (const Frame& frame : set.frames) EXPECT_EQ(frame.pixels->at(0, 0), set.index) << "the right pattern";
}

TEST_F(Capture, ADeadFaceCameraDoesNotHoldUpTheOther) {
  options_.config.replay.faults = {{.kind = ReplayFault::Kind::missing, .camera = "f1", .role = ShotRole::gray_code}};
  start_listening();
  const std::string id = capture();
  EXPECT_EQ(end_of(id), "done");
  EXPECT_THAT(recording(id).find(ShotRole::gray_code)->frames, SizeIs(patterns));
}

TEST_F(Capture, ALostCameraComesBack) {
  options_.config.replay.faults = {
      {.kind = ReplayFault::Kind::lost, .camera = "b1", .role = ShotRole::body, .capture = 0, .delay_ms = 300}};
  start_listening();
  EXPECT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_EQ(listener().heard("shot")[0].fields["missing"], Json({"b1"}));
  EXPECT_TRUE(wait_until([&] { return call("system.status")["cameras"][1]["state"] == "online"; }));
  ASSERT_TRUE(listener().find([](const SeenEvent& event) {
    return event.topic == "camera" && event.fields["camera"] == "b1" && event.fields["state"] == "online";
  }));
  EXPECT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_THAT(listener().heard("shot")[1].fields["missing"], IsEmpty());
}

TEST_F(Capture, WithoutEnoughCamerasTheBoothSaysSo) {
  options_.config.capture.min_cameras = 5;
  auto opened = Booth::open(options_, open_devices(options_.config, clock_), clock_);
  ASSERT_TRUE(opened);
  const auto refused = (*opened)->start_capture({});
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::device_lost);
  EXPECT_EQ((*opened)->status().not_ready[0].kind, "camera_unavailable");
}

TEST_F(Capture, AFullDiskIsSaidBefore) {
  options_.config.disk.reserve_mib = 10'000'000;
  auto opened = Booth::open(options_, open_devices(options_.config, clock_), clock_);
  ASSERT_TRUE(opened);
  ASSERT_TRUE(wait_until([&] { return (*opened)->status().not_ready.size() == 1; }));
  EXPECT_EQ((*opened)->status().not_ready[0].kind, "disk_full");
  EXPECT_EQ((*opened)->start_capture({}).error().code, ErrorCode::disk_full);
}

TEST_F(Capture, WithoutDevicesTheBoothIsAtFault) {
  options_.config.replay.recording = folder_.path() / "nothing";
  auto opened = Booth::open(options_, open_devices(options_.config, clock_), clock_);
  ASSERT_TRUE(opened);
  EXPECT_EQ((*opened)->status().state, BoothState::fault);
  EXPECT_EQ((*opened)->start_capture({}).error().code, ErrorCode::not_ready);
  EXPECT_EQ((*opened)->start_capture({.face = FaceMode::active}).error().code, ErrorCode::not_ready);
}

TEST_F(Capture, ABoothWithoutProjectorRefusesActiveFaces) {
  options_.config.replay.recording = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";
  start_listening();
  EXPECT_EQ(refusal("capture.start", {{"face", "active"}}), "unsupported");
  EXPECT_TRUE(call("system.status").at("projector").is_null());
  const std::string id = capture();
  EXPECT_EQ(end_of(id), "done");
  // The pictures are those that were played, byte for byte.
  for (const Shot& shot : recording(id).shots)
    for (const FrameRecord& frame : shot.frames) {
      const auto taken = read_file(options_.config.booth.recordings() / id / frame.file, 10'000'000);
      const Recording played = *read_recording(options_.config.replay.recording);
      const auto original = read_file(played.folder / played.find(shot.role)->frames.front().file, 10'000'000);
      ASSERT_TRUE(taken && original);
      if (frame.camera == played.find(shot.role)->frames.front().camera) {
        EXPECT_EQ(*taken, *original);
      }
    }
}

TEST_F(Capture, DeletedWhileItRunsLeavesNothing) {
  start_listening();
  const std::string id = capture({{"countdown_s", 30}});
  EXPECT_EQ(call("capture.delete", {{"capture", id}}), Json::object());
  EXPECT_EQ(end_of(id), "cancelled");
  expect_nothing_left(id);
  EXPECT_EQ(call("capture.delete", {{"capture", id}}), Json::object());
}

TEST_F(Capture, DeletedAtAnyMomentLeavesNothing) {
  start_listening();
  for (int i = 0; i < 15; ++i) {
    const std::string id = capture({{"face", "none"}});
    std::this_thread::sleep_for(std::chrono::milliseconds(3 * i));
    EXPECT_EQ(call("capture.delete", {{"capture", id}}), Json::object());
    ASSERT_TRUE(wait_until([&] { return traces(id).empty(); })) << traces(id)[0];
    ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == true; }));
    EXPECT_EQ(job(id)["state"], "not_found");
  }
  EXPECT_THAT(call("avatar.list")["avatars"], IsEmpty());
}

TEST_F(Capture, IsWrittenDownFromItsAcknowledgementToItsEnd) {
  start_listening();
  const fs::path folder = options_.config.booth.captures_under_way();
  const std::string cancelled = capture({{"countdown_s", 30}});
  EXPECT_THAT(entries(folder), ElementsAre(cancelled));
  EXPECT_EQ(refusal("capture.start"), "busy");
  EXPECT_THAT(entries(folder), ElementsAre(cancelled)) << "nothing of one that was refused";
  call("capture.cancel", {{"capture", cancelled}});
  EXPECT_EQ(end_of(cancelled), "cancelled");
  EXPECT_TRUE(wait_until([&] { return entries(folder).empty(); }));
  ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == true; }));
  EXPECT_EQ(end_of(capture()), "done");
  EXPECT_TRUE(wait_until([&] { return entries(folder).empty(); }));
}

TEST_F(Capture, WhatCannotBeWrittenDownIsRefused) {
  start_listening();
  fs::remove(options_.config.booth.captures_under_way());
  EXPECT_EQ(refusal("capture.start"), "internal");
  EXPECT_EQ(call("system.status")["state"], "idle");
  fs::create_directory(options_.config.booth.captures_under_way());
  EXPECT_EQ(end_of(capture()), "done");
}

TEST_F(Capture, OnlyTheLatestInterruptedCapturesAreKept) {
  const fs::path folder = options_.config.booth.captures_under_way();
  fs::create_directories(folder);
  for (int i = 0; i < 120; ++i) std::ofstream(folder / ("capture-" + std::to_string(1000 + i)));
  start_listening();
  const Json jobs = call("job.list")["jobs"];
  ASSERT_THAT(jobs, SizeIs(100));
  EXPECT_EQ(jobs[0]["id"], "capture-1020");
  EXPECT_EQ(jobs[99]["state"], "failed");
  EXPECT_THAT(entries(folder), IsEmpty());
}

TEST_F(Capture, TwoBoothsInOneProcess) {
  start_listening();
  BoothOptions other = options_;
  other.config.booth.state_directory = folder_.path() / "other";
  other.config.api.control = "ipc://" + (folder_.path() / "other-control").string();
  other.config.api.events = "ipc://" + (folder_.path() / "other-events").string();
  auto booth = Booth::open(other, open_devices(other.config, clock_), clock_);
  ASSERT_TRUE(booth);
  auto server = api::Server::start(other.config.api, **booth, [] {});
  ASSERT_TRUE(server);
  RawClient second(other.config.api.control);
  ASSERT_TRUE(wait_until([&] { return second.call("system.status").result()["ready"] == true; }));
  const std::string mine = capture();
  const std::string theirs = second.call("capture.start").result()["capture"];
  ASSERT_TRUE(wait_job(mine, "done"));
  ASSERT_TRUE(wait_until([&] { return second.call("avatar.list").result()["avatars"].size() == 1; }));
  EXPECT_EQ(job(theirs)["state"], "not_found");
}

TEST_F(Capture, AStateDirectoryBelongsToOneBooth) {
  start_listening();
  const auto second = Booth::open(options_, open_devices(options_.config, clock_), clock_);
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, ErrorCode::busy);
}

TEST_F(Capture, StoppingCancelsACountdownAndSaysSo) {
  start_listening();
  const std::string id = capture({{"countdown_s", 30}});
  std::jthread drain([this] { booth_->drain(); });
  EXPECT_EQ(end_of(id), "cancelled");
  EXPECT_THAT(listener().heard("state"), Contains(testing::Truly([](const SeenEvent& event) {
                return event.fields["state"] == "stopping" && event.fields["ready"] == false;
              })));
  EXPECT_EQ(refusal("capture.start"), "not_ready");
  drain.join();
  EXPECT_EQ(call("system.status")["state"], "stopping");
}

}  // namespace
}  // namespace booth::test
