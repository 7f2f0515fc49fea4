// Captures with live cameras: what goes wrong with them, and what an operator hears of it.

#include <gmock/gmock.h>

#include <algorithm>
#include <set>
#include <thread>

#include "daemon/projector_delay.h"
#include "pipeline/image/codec.h"
#include "replay/recording_file.h"
#include "replay/replay_devices.h"
#include "tests/daemon/fake_devices.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;
using testing::SizeIs;
using testing::UnorderedElementsAre;
using Kind = FakeAnswer::Kind;

constexpr int patterns = 8;
const std::vector<std::string> all_cameras{"b0", "b1", "b2", "b3", "f0", "f1"};

class Live : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    auto read = read_recording(options_.config.replay.recording);
    ASSERT_TRUE(read);
    rig_ = read->rig;
    fake_ = std::make_shared<FakeDevices>(all_cameras, clock());
  }
  Result<Devices> devices() override {
    Devices devices;
    devices.source = fake_;
    devices.drivers = {{"fake", fake_}};
    devices.warnings = warnings_;
    for (const std::string& id : configured_) devices.cameras.push_back(fake_->see(id).info);
    devices.trigger = "fake";
    devices.projector = "beamer";
    devices.rig = rig_;
    return devices;
  }
  /// A booth that has learned its background and is ready.
  void begin() {
    open();
    listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
    ASSERT_TRUE(wait_until([&] { return kinds() == std::vector<std::string>{"no_background"}; }))
        << call("system.status");
    const SeenEvent learned = end_of_task(call("background.learn", {{"frames", 1}})["task"]);
    ASSERT_EQ(learned.fields["state"], "done") << learned.fields;
    ASSERT_TRUE(wait_until([&] { return kinds().empty(); }));
  }
  std::vector<std::string> kinds() {
    std::vector<std::string> found;
    for (const Reason& reason : booth_->status().not_ready) found.push_back(reason.kind);
    return found;
  }
  std::string reasons() {
    std::string text;
    for (const Reason& reason : booth_->status().not_ready) text += reason.message + "\n";
    return text;
  }
  SeenEvent end_of_task(const std::string& task) {
    const auto end = listener_->find([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["task"] == task && event.fields["state"] != "running";
    });
    return end.value_or(SeenEvent{"nothing", {}});
  }
  /// The kind of the failure, or "done"; its message is in failure_.
  std::string end_of(const std::string& id) {
    const auto end = listener_->find(
        [&](const SeenEvent& event) { return event.topic.starts_with("capture.") && event.fields["capture"] == id; });
    if (!end) return "nothing";
    failure_ = end->fields.value("message", "");
    return end->topic == "capture.done" ? "done" : end->fields["kind"].get<std::string>();
  }
  std::vector<Json> shots(const std::string& id) {
    std::vector<Json> found;
    for (const SeenEvent& event : listener_->heard("shot"))
      if (event.fields["capture"] == id) found.push_back(event.fields);
    return found;
  }
  std::string alerts() {
    std::string text;
    for (const SeenEvent& event : listener_->heard("alert")) text += event.fields["message"].get<std::string>() + "\n";
    return text;
  }
  Json camera(const std::string& id) {
    const Json status = call("system.status");
    for (const Json& camera : status["cameras"])
      if (camera["id"] == id) return camera;
    return {};
  }
  Recording recording(const std::string& id) {
    auto read = read_recording(options_.config.booth.recordings() / id);
    EXPECT_TRUE(read) << read.error().message;
    return read ? *read : Recording{};
  }
  static FakeDevices::Script only(const std::string& camera, ShotRole role, const FakeAnswer& answer,
                                  std::optional<int> trigger = {}) {
    return [=](const std::string& asked, ShotRole asked_role, int number) {
      return asked == camera && asked_role == role && trigger.value_or(number) == number ? answer : FakeAnswer{};
    };
  }

  fs::path write_onlooker() const;

  std::vector<std::string> configured_ = all_cameras;
  std::optional<Rig> rig_;
  std::shared_ptr<FakeDevices> fake_;
  const std::shared_ptr<WarningRelay> warnings_ = std::make_shared<WarningRelay>();
  std::unique_ptr<Listener> listener_;
  std::string failure_;
};

TEST_F(Live, ACaptureIsARecordingThatReplaysIdentically) {
  begin();
  int grey = 0;
  fake_->play([&grey](const std::string& id, ShotRole role, int) {
    return role == ShotRole::body ? FakeAnswer{.grey = 10 * (id[1] - '0') + ++grey} : FakeAnswer{};
  });
  const std::string id = capture();
  ASSERT_EQ(end_of(id), "done") << failure_;
  const Recording taken = recording(id);
  ASSERT_THAT(taken.find(ShotRole::body)->frames, SizeIs(6));
  ASSERT_THAT(taken.find(ShotRole::gray_code)->frames, SizeIs(2 * patterns));
  ASSERT_THAT(taken.find(ShotRole::background)->frames, SizeIs(6));
  for (const FrameSet& set : load_shot(taken, *taken.find(ShotRole::gray_code)).sets)
    for (const Frame& frame : set.frames) EXPECT_EQ(frame.pixels->at(3, 3), set.index);

  stop();
  options_.config.replay.recording = options_.config.booth.recordings() / id;
  options_.config.booth.state_directory = folder_.path() / "second";
  auto replayed = Booth::open(options_, open_devices(options_.config, clock_), clock_);
  ASSERT_TRUE(replayed) << replayed.error().message;
  ASSERT_TRUE(wait_until([&] { return (*replayed)->status().not_ready.empty(); }));
  const auto second = (*replayed)->start_capture({});
  ASSERT_TRUE(second) << second.error().message;
  ASSERT_TRUE(wait_until([&] { return (*replayed)->avatars().find(*second).has_value(); }));
  const Recording again = *read_recording(options_.config.booth.recordings() / *second);
  for (const ShotRole role : {ShotRole::background, ShotRole::body, ShotRole::gray_code}) {
    const auto frames = load_shot(taken, *taken.find(role)).sets;
    const auto others = load_shot(again, *again.find(role)).sets;
    ASSERT_EQ(frames.size(), others.size());
    for (size_t i = 0; i < frames.size(); ++i)
      for (size_t j = 0; j < frames[i].frames.size(); ++j) {
        EXPECT_EQ(frames[i].frames[j].camera, others[i].frames[j].camera);
        EXPECT_EQ(frames[i].frames[j].pixels->samples, others[i].frames[j].pixels->samples);
      }
  }
}

TEST_F(Live, EveryCameraHearsOfItsTriggers) {
  begin();
  ASSERT_EQ(end_of(capture({{"face", "none"}})), "done");
  for (const std::string& id : all_cameras) {
    const auto noted = fake_->see(id).noted;
    ASSERT_THAT(noted, SizeIs(1)) << id;
    EXPECT_EQ(noted[0].first, 0);
  }
}

TEST_F(Live, ACameraThatMissesATriggerGetsASecondChance) {
  begin();
  fake_->play(only("b2", ShotRole::body, {.kind = Kind::nothing}, 0));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  const Json shot = shots(id).at(0);
  EXPECT_THAT(shot["missing"], IsEmpty());
  EXPECT_EQ(shot["retries"], 1);
  EXPECT_EQ(shot["cameras"], 6);
  EXPECT_THAT(shot["offsets_us"], SizeIs(6));
  EXPECT_EQ(camera("b2")["state"], "online");
  EXPECT_EQ(camera("b2")["dropped"], 1);
  EXPECT_EQ(call("system.metrics")["shot_retries"], 1);
}

TEST_F(Live, FramesOfAShotAreOfOneTrigger) {
  begin();
  // Each trigger misses another camera: the frames of the two must not be mixed.
  fake_->play([](const std::string& id, ShotRole role, int trigger) {
    const bool misses = role == ShotRole::body && ((id == "b1" && trigger == 0) || (id == "b2" && trigger == 1));
    return FakeAnswer{.kind = misses ? Kind::nothing : Kind::frame, .grey = 50 + trigger};
  });
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_EQ(shots(id).at(0)["missing"], Json({"b1"}));
  std::set<int> greys;
  const Recording taken = recording(id);
  for (const FrameSet& set : load_shot(taken, *taken.find(ShotRole::body)).sets)
    for (const Frame& frame : set.frames) greys.insert(frame.pixels->at(0, 0));
  EXPECT_THAT(greys, SizeIs(1));
}

TEST_F(Live, WithoutRetriesThereIsOneTrigger) {
  options_.config.capture.retries = 0;
  begin();
  const int before = fake_->triggers();
  fake_->play(only("b2", ShotRole::body, {.kind = Kind::nothing}));
  ASSERT_EQ(end_of(capture({{"face", "none"}})), "done");
  EXPECT_EQ(fake_->triggers(), before + 1);
}

TEST_F(Live, TooFewCamerasFailWithTheirNames) {
  options_.config.capture.min_cameras = 4;
  begin();
  fake_->play(only("b3", ShotRole::body, {.kind = Kind::nothing}));
  EXPECT_EQ(end_of(capture({{"face", "none"}})), "camera_unavailable");
  EXPECT_EQ(failure_, "only 3 body cameras delivered, at least 4 are needed; missing: b3");
}

TEST_F(Live, LateFramesAreNotTaken) {
  options_.config.capture.frame_timeout_ms = 100;
  begin();
  fake_->play(only("b0", ShotRole::body, {.delay = seconds(30)}));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_EQ(shots(id).at(0)["missing"], Json({"b0"}));
  EXPECT_THAT(camera("b0")["message"].get<std::string>(), HasSubstr("no frame came for a trigger"));
}

TEST_F(Live, DamagedFramesAreTakenAgain) {
  begin();
  fake_->play(only("b0", ShotRole::body, {.kind = Kind::corrupt}, 0));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_THAT(shots(id).at(0)["missing"], IsEmpty());
  EXPECT_EQ(shots(id).at(0)["retries"], 1);
}

TEST_F(Live, ACameraThatCountsWrongIsPutRightByTime) {
  begin();
  // It missed the first trigger and calls the second one its first.
  fake_->play([](const std::string& id, ShotRole role, int trigger) {
    if (id != "b1" || role != ShotRole::body) return FakeAnswer{};
    return trigger == 0 ? FakeAnswer{.kind = Kind::nothing} : FakeAnswer{.index_off = -1};
  });
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_THAT(shots(id).at(0)["missing"], IsEmpty());
  EXPECT_THAT(alerts(), HasSubstr("b1: its frame 0 was exposed at trigger 1"));
}

TEST_F(Live, FramesThatAnswerNoTriggerAreNotUsed) {
  begin();
  fake_->play(only("b1", ShotRole::body, {.offset = -seconds(2)}));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_EQ(shots(id).at(0)["missing"], Json({"b1"}));
  EXPECT_THAT(alerts(), HasSubstr("b1: its frame 0 was not exposed at any trigger: check its trigger line"));
}

TEST_F(Live, ALargeSkewIsSaid) {
  begin();
  fake_->play(only("b1", ShotRole::body, {.offset = milliseconds(150)}));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_GE(shots(id).at(0)["skew_us"], 150'000);
  EXPECT_THAT(alerts(), HasSubstr("to b1; at most 100 ms are allowed (capture.max_skew_ms)"));
}

TEST_F(Live, ACameraThatDiesInAShotComesBackWithATestFrame) {
  begin();
  fake_->play(only("b1", ShotRole::body, {.kind = Kind::lost}));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_EQ(shots(id).at(0)["missing"], Json({"b1"}));
  EXPECT_EQ(shots(id).at(0)["retries"], 0) << "there is nobody to wait for";
  EXPECT_EQ(camera("b1")["state"], "offline");
  EXPECT_EQ(camera("b1")["fault"], "temporary");

  fake_->play({});
  fake_->change("b1", [](auto& channel) { channel.blind = true; });
  fake_->plug_in("b1");
  ASSERT_TRUE(wait_until([&] { return fake_->see("b1").opened >= 2; }));
  EXPECT_EQ(camera("b1")["state"], "offline") << "it has shown nothing yet";
  fake_->change("b1", [](auto& channel) { channel.blind = false; });
  ASSERT_TRUE(wait_until([&] { return camera("b1")["state"] == "online"; }));
  const std::string second = capture({{"face", "none"}});
  ASSERT_EQ(end_of(second), "done") << failure_;
  EXPECT_THAT(shots(second).at(0)["missing"], IsEmpty());
}

TEST_F(Live, AMissedPatternIsShownAgainAndNoOther) {
  begin();
  fake_->play(only("f1", ShotRole::gray_code, {.kind = Kind::nothing}, 3));
  const std::string id = capture();
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_THAT(fake_->shown(), ElementsAre(0, 1, 2, 3, 3, 4, 5, 6, 7, -1));
  EXPECT_EQ(shots(id).at(1 + 3)["retries"], 1);
  EXPECT_THAT(recording(id).find(ShotRole::gray_code)->frames, SizeIs(2 * patterns));
}

TEST_F(Live, AFaceCameraThatDiesInTheSequenceLeavesTheOther) {
  begin();
  fake_->play(only("f1", ShotRole::gray_code, {.kind = Kind::lost}, 3));
  const std::string id = capture();
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_THAT(recording(id).find(ShotRole::gray_code)->frames, SizeIs(patterns + 3));
  EXPECT_EQ(shots(id).at(1 + 5)["missing"], Json({"f1"}));
  EXPECT_EQ(fake_->shown().back(), -1) << "dark";

  fake_->play({});
  fake_->plug_in("f1");
  ASSERT_TRUE(wait_until([&] { return camera("f1")["state"] == "online"; }));
  const std::string second = capture();
  ASSERT_EQ(end_of(second), "done") << failure_;
  EXPECT_THAT(recording(second).find(ShotRole::gray_code)->frames, SizeIs(2 * patterns));
}

TEST_F(Live, WhatAFaceCameraMissedWhileItWasAwayIsShownAgainAndNothingElse) {
  begin();
  fake_->play(only("f1", ShotRole::gray_code, {.kind = Kind::lost}, 3));
  const std::string id = capture();
  ASSERT_TRUE(wait_until([&] { return !fake_->see("f1").plugged; }));
  fake_->play({});
  fake_->plug_in("f1");
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_THAT(fake_->shown(), ElementsAre(0, 1, 2, 3, 4, 5, 6, 7, 3, 4, 5, 6, 7, -1));
  const Recording taken = recording(id);
  ASSERT_THAT(taken.find(ShotRole::gray_code)->frames, SizeIs(2 * patterns));
  for (const FrameSet& set : load_shot(taken, *taken.find(ShotRole::gray_code)).sets)
    for (const Frame& frame : set.frames) EXPECT_EQ(frame.pixels->at(3, 3), set.index) << frame.camera;
  const auto reports = shots(id);
  ASSERT_THAT(reports, SizeIs(1 + patterns + 5));
  EXPECT_EQ(reports[1 + 3]["missing"], Json({"f1"}));
  for (size_t i = 1 + patterns; i < reports.size(); ++i) {
    EXPECT_THAT(reports[i]["missing"], IsEmpty());
    EXPECT_EQ(reports[i]["retries"], 1);
  }
}

TEST_F(Live, WithoutAnyFaceCameraTheSequenceEndsAtOnce) {
  begin();
  fake_->play([](const std::string& id, ShotRole role, int trigger) {
    const bool dies = id[0] == 'f' && role == ShotRole::gray_code && trigger == 2;
    return FakeAnswer{.kind = dies ? Kind::lost : Kind::frame};
  });
  const std::string id = capture({{"face", "active"}});
  EXPECT_EQ(end_of(id), "camera_unavailable");
  EXPECT_EQ(failure_, "no camera takes the projected patterns: f0, f1");
  EXPECT_EQ(fake_->shown().back(), -1);
  // The journal's entry goes after the events.
  EXPECT_TRUE(wait_until([&] { return traces(id).empty(); })) << testing::PrintToString(traces(id));
}

TEST_F(Live, WhereTheFaceNeedNotBeProjectedTheCaptureGoesOnWithout) {
  begin();
  fake_->play([](const std::string& id, ShotRole role, int) {
    return FakeAnswer{.kind = id[0] == 'f' && role == ShotRole::gray_code ? Kind::lost : Kind::frame};
  });
  const std::string id = capture();
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_EQ(recording(id).find(ShotRole::gray_code), nullptr);
  EXPECT_THAT(alerts(), HasSubstr("the face is made without the projector: no camera takes"));
}

TEST_F(Live, AProjectorThatFailsIsNamedAndOpenedAnew) {
  begin();
  fake_->break_projector_at(3);
  EXPECT_EQ(end_of(capture({{"face", "active"}})), "camera_unavailable");
  EXPECT_EQ(failure_, "the projector failed: its lamp is broken");
  EXPECT_EQ(fake_->shown().back(), -1);
  fake_->break_projector_at(100);
  ASSERT_TRUE(wait_until([&] { return booth_->status().projector->state == DeviceState::online; }));
  EXPECT_EQ(end_of(capture({{"face", "active"}})), "done") << failure_;
}

TEST_F(Live, ATriggerThatFailsIsAReason) {
  begin();
  fake_->break_trigger(Error{ErrorCode::device_lost, "/dev/gpiochip0: is not there"});
  EXPECT_EQ(end_of(capture()), "camera_unavailable");
  EXPECT_EQ(failure_, "the trigger did not fire: /dev/gpiochip0: is not there");
  ASSERT_TRUE(wait_until([&] { return !kinds().empty(); }));
  EXPECT_THAT(reasons(), HasSubstr("the trigger is offline: "));
  EXPECT_EQ(refusal("capture.start"), "camera_unavailable");
  fake_->break_trigger({});
  EXPECT_TRUE(wait_until([&] { return kinds().empty(); }));
}

TEST_F(Live, AnUnpluggedCameraIsNoticedWithoutACapture) {
  options_.config.capture.min_cameras = 4;
  begin();
  fake_->unplug("b2");
  ASSERT_TRUE(wait_until([&] { return kinds() == std::vector<std::string>{"camera_unavailable"}; }));
  EXPECT_THAT(reasons(), HasSubstr("3 body cameras are online, at least 4 are needed. Offline: b2: b2: is not there"));
  const Response refused = client().call("capture.start");
  EXPECT_EQ(refused.kind(), "camera_unavailable");
  EXPECT_THAT(refused.message["error"]["message"].get<std::string>(), HasSubstr("b2"));
  fake_->plug_in("b2");
  EXPECT_TRUE(wait_until([&] { return kinds().empty(); }));
}

TEST_F(Live, FaultsThatDoNotMendThemselvesAreToldFromThoseThatMay) {
  options_.config.capture.min_cameras = 2;
  fake_->change("b0", [](auto& channel) {
    channel.refusal = Error{ErrorCode::invalid_argument, "b0: exposure_us: 99, the camera takes 100 … 20000"};
  });
  fake_->change("b1", [](auto& channel) { channel.plugged = false; });
  begin();
  ASSERT_TRUE(wait_until([&] { return camera("b1")["message"] != "not opened yet"; }));
  EXPECT_EQ(camera("b0")["fault"], "permanent");
  EXPECT_EQ(camera("b0")["message"], "b0: exposure_us: 99, the camera takes 100 … 20000");
  EXPECT_EQ(camera("b1")["fault"], "temporary");
}

TEST_F(Live, ACameraOfAnotherSizeIsNotUsed) {
  fake_->change("b0", [](auto& channel) { channel.width = 24; });
  begin();
  EXPECT_EQ(camera("b0")["state"], "offline");
  EXPECT_EQ(camera("b0")["fault"], "permanent");
  EXPECT_EQ(camera("b0")["message"],
            "it delivers 24 × 8 pixels, but was calibrated with 16 × 8: set its region, or calibrate it again");
}

TEST_F(Live, WithoutACalibrationThereIsAReasonAndStillAPreview) {
  rig_.reset();
  open();
  ASSERT_TRUE(wait_until([&] { return kinds() == std::vector<std::string>{"not_calibrated", "no_background"}; }));
  EXPECT_EQ(refusal("capture.start"), "not_calibrated");
  EXPECT_EQ(refusal("background.learn"), "not_calibrated");
  listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
  call("preview.start", {{"camera", "b0"}});
  EXPECT_TRUE(listener_->find("preview.b0"));
}

TEST_F(Live, ACameraThatTheCalibrationDoesNotKnowIsAReason) {
  rig_->cameras.erase(rig_->cameras.begin() + 1);
  rig_->cameras.back().role = CameraRole::body;
  open();
  ASSERT_TRUE(wait_until([&] { return kinds().size() == 3; }));
  EXPECT_THAT(reasons(), HasSubstr("the calibration does not know b1"));
  EXPECT_THAT(reasons(), HasSubstr("f1 has another role now"));
  EXPECT_EQ(refusal("capture.start"), "not_calibrated");
}

TEST_F(Live, TransportStatisticsAreInTheMetrics) {
  begin();
  EXPECT_TRUE(wait_until([&] { return call("system.metrics").value("camera_b0_n_missing_packets", 0) == 3; }));
}

TEST_F(Live, WhatDriversWarnOfIsAnAlertAndInTheCamerasStatus) {
  warnings_->warn("camera b9: before anybody listened");
  begin();
  fake_->change("b0", [](auto& channel) { channel.warnings = {"packet_size: packets of more than 576 bytes …"}; });
  ASSERT_TRUE(wait_until([&] { return camera("b0")["warnings"].size() == 1; }));
  EXPECT_EQ(camera("b0")["state"], "online");
  EXPECT_THAT(camera("b1")["warnings"], IsEmpty());
  fake_->change("b0", [](auto& channel) { channel.warnings.clear(); });
  EXPECT_TRUE(wait_until([&] { return camera("b0")["warnings"].empty(); }));
  warnings_->warn("camera b0: did not acknowledge the action command");
  const auto alert = listener_->find([](const SeenEvent& event) {
    return event.topic == "alert" && event.fields["message"] == "camera b0: did not acknowledge the action command";
  });
  ASSERT_TRUE(alert);
  EXPECT_EQ(alert->fields["severity"], "warning");
  EXPECT_EQ(call("system.metrics")["driver_warnings"], 2);
}

TEST_F(Live, DiscoverTellsOfEveryCamera) {
  configured_.pop_back();
  rig_->cameras.pop_back();
  begin();
  const Json result = end_of_task(call("camera.discover")["task"]).fields["result"];
  ASSERT_THAT(result["cameras"], SizeIs(7));
  std::map<std::string, bool> configured;
  for (const Json& camera : result["cameras"]) configured[camera["id"]] = camera["configured"];
  EXPECT_TRUE(configured["f0"]);
  EXPECT_FALSE(configured["f1"]);
  EXPECT_FALSE(configured["stranger"]);
  EXPECT_EQ(result["cameras"][0]["serial"], "S-b0");
  EXPECT_THAT(call("system.status")["tasks"], IsEmpty());
}

TEST_F(Live, TheTriggerTestTellsWhoAnswersAndWhen) {
  begin();
  fake_->play([](const std::string& id, ShotRole, int) {
    return FakeAnswer{.kind = id == "b3" ? Kind::nothing : Kind::frame, .offset = milliseconds(id[1] - '0')};
  });
  const SeenEvent end = end_of_task(call("trigger.test")["task"]);
  ASSERT_EQ(end.fields["state"], "done") << end.fields;
  EXPECT_EQ(end.fields["result"]["missing"], Json({"b3"}));
  EXPECT_EQ(end.fields["result"]["offsets_us"]["b2"], 2000);
  EXPECT_EQ(end.fields["result"]["skew_us"], 2000);
  EXPECT_EQ(call("system.status")["state"], "idle");
}

TEST_F(Live, TheProjectorsDelayIsMeasuredAndKept) {
  options_.delay_calibration = {.max_delay_ms = 80, .repeats = 1};
  begin();
  fake_->set_latency(milliseconds(20));
  const SeenEvent end = end_of_task(call("projector.calibrate")["task"]);
  ASSERT_EQ(end.fields["state"], "done") << end.fields;
  EXPECT_EQ(end.fields["kind"], "projector_calibration");
  const Json result = end.fields["result"];
  EXPECT_EQ(result["camera"], "f0");
  EXPECT_EQ(result["contrast"], 190);
  EXPECT_GE(result["measured_us"], 20'000);
  EXPECT_GE(result["delay_us"], result["measured_us"].get<int>() + 16'000) << "one refresh for safety";
  const auto kept = read_projector_delay(projector_delay_file(options_.config.booth.state_directory));
  ASSERT_TRUE(kept);
  EXPECT_EQ(kept->projector, "beamer");
  EXPECT_EQ(kept->delay_us, result["delay_us"]);
  EXPECT_EQ(fake_->shown().back(), -1) << "dark";
  ASSERT_TRUE(wait_until([&] { return kinds().empty(); }));
  EXPECT_EQ(end_of(capture()), "done") << failure_;
}

TEST_F(Live, AProjectorThatNoCameraSeesIsNotCalibrated) {
  options_.delay_calibration = {.max_delay_ms = 10, .repeats = 1};
  begin();
  fake_->set_latency(seconds(100));
  const SeenEvent end = end_of_task(call("projector.calibrate")["task"]);
  EXPECT_EQ(end.fields["state"], "failed");
  EXPECT_EQ(end.fields["error"]["message"],
            "f0: does not see the light of beamer; darken the booth, or expose longer; "
            "f1: does not see the light of beamer; darken the booth, or expose longer");
  EXPECT_FALSE(read_projector_delay(projector_delay_file(options_.config.booth.state_directory)));
}

TEST_F(Live, TheBackgroundIsLearnedFromSeveralFrames) {
  begin();
  fake_->play(only("b1", ShotRole::background, {.kind = Kind::nothing}, 1));
  const std::string task = call("background.learn", {{"frames", 3}})["task"];
  EXPECT_EQ(refusal("capture.start"), "busy");
  EXPECT_EQ(refusal("trigger.test"), "busy");
  const SeenEvent end = end_of_task(task);
  ASSERT_EQ(end.fields["state"], "done") << end.fields;
  EXPECT_EQ(end.fields["result"]["frames"], 3);
  EXPECT_THAT(end.fields["result"]["missing"], IsEmpty());
  std::vector<std::string> states;
  for (const SeenEvent& event : listener_->heard("state")) states.push_back(event.fields["state"]);
  EXPECT_THAT(states, Contains("learning_background"));
  const std::string id = capture({{"face", "none"}});
  ASSERT_EQ(end_of(id), "done") << failure_;
  EXPECT_THAT(recording(id).find(ShotRole::background)->frames, SizeIs(3 * 6));
}

TEST_F(Live, TheBackgroundIsNotLearnedWhileSomethingMoves) {
  begin();
  const auto learned = call("system.status")["background"];
  // The picture's mean is what others are compared with: a change must be in a part of it.
  std::atomic<int> frames = 0;
  fake_->set_pixels("b2", [&](Image& image) {
    const int edge = frames++ % 2 == 0 ? 4 : 12;
    for (int y = 0; y < image.height; ++y)
      for (int x = 0; x < image.width; ++x) image.at(x, y) = x < edge ? 200 : 50;
  });
  const SeenEvent end = end_of_task(call("background.learn", {{"frames", 3}})["task"]);
  EXPECT_EQ(end.fields["state"], "failed");
  EXPECT_EQ(end.fields["error"]["message"],
            "something moved in front of b2: the booth must be empty and its light steady; learn the background again");
  EXPECT_EQ(call("system.status")["background"], learned) << "the old one stays";
  EXPECT_EQ(call("system.status")["ready"], true);
}

TEST_F(Live, SomebodyWhoStandsStillWhileItIsLearnedIsSuspected) {
  begin();
  for (const std::string& id : all_cameras)
    fake_->set_pixels(id, [](Image& image) {
      for (int y = 0; y < image.height; ++y)
        for (int x = 6; x < 10; ++x) image.at(x, y) = 220;
    });
  const SeenEvent end = end_of_task(call("background.learn", {{"frames", 2}})["task"]);
  ASSERT_EQ(end.fields["state"], "done") << end.fields;
  EXPECT_THAT(end.fields["result"]["warnings"].dump(), HasSubstr("looks different from when it was learned last"));
}

TEST_F(Live, ThePreviewIsUprightSmallAndFresh) {
  rig_->cameras[0].mount_rotation_deg = 90;
  begin();
  call("preview.start", {{"camera", "b0"}, {"fps", 30}, {"max_width", 4}});
  for (int i = 0; i < 3; ++i) {
    const auto seen = listener_->find("preview.b0");
    ASSERT_TRUE(seen);
    EXPECT_EQ(seen->fields["camera"], "b0");
    EXPECT_EQ(seen->fields["width"], 4);
    EXPECT_EQ(seen->fields["height"], 8);
    const std::vector<uint8_t> jpeg(seen->bytes.begin(), seen->bytes.end());
    const auto image = decode_image(jpeg);
    ASSERT_TRUE(image) << image.error().message;
    EXPECT_EQ(image->width, 4);
    EXPECT_EQ(image->height, 8);
  }
  const auto heard = listener_->heard("preview.b0");
  EXPECT_EQ(heard.back().fields["sequence"].get<uint64_t>() - heard.front().fields["sequence"].get<uint64_t>(),
            heard.size() - 1);
  call("preview.stop", {{"camera", "b0"}});
  EXPECT_TRUE(wait_until([&] { return !fake_->see("b0").armed; }));
}

TEST_F(Live, APreviewMakesWayForACapture) {
  begin();
  for (const std::string& id : all_cameras) call("preview.start", {{"camera", id}, {"fps", 30}});
  ASSERT_TRUE(listener_->find("preview.f1"));
  for (int i = 0; i < 3; ++i) {
    const std::string id = capture();
    ASSERT_EQ(end_of(id), "done") << failure_;
    for (const Json& shot : shots(id)) {
      EXPECT_THAT(shot["missing"], IsEmpty());
      EXPECT_EQ(shot["retries"], 0);
    }
    ASSERT_TRUE(listener_->find("preview.b0")) << "it goes on";
  }
}

TEST_F(Live, AWatchedCameraThatIsUnpluggedGoesOnWhenItIsBack) {
  begin();
  call("preview.start", {{"camera", "b0"}});
  ASSERT_TRUE(listener_->find("preview.b0"));
  fake_->unplug("b0");
  ASSERT_TRUE(wait_until([&] { return camera("b0")["state"] == "offline"; }));
  fake_->plug_in("b0");
  ASSERT_TRUE(wait_until([&] { return camera("b0")["state"] == "online"; }));
  ASSERT_TRUE(listener_->find([](const SeenEvent& event) {
    return event.topic == "camera" && event.fields["camera"] == "b0" && event.fields["state"] == "online";
  }));
  EXPECT_TRUE(listener_->find("preview.b0"));
}

TEST_F(Live, TheEndOfACaptureAndTheNextOnesBeginningDoNotOvertakeEachOther) {
  begin();
  constexpr int captures = 20;
  std::string last;
  for (int i = 0; i < captures; ++i) {
    // As soon as the booth takes the next one, which is before the last one's end is announced.
    Result<std::string> started = Error{};
    ASSERT_TRUE(wait_until([&] { return (started = booth_->start_capture({.face = FaceMode::none})).ok(); }));
    last = *started;
  }
  ASSERT_EQ(end_of(last), "done");
  ASSERT_TRUE(wait_until([&] { return booth_->status().state == BoothState::idle; }));
  booth_->events().publish(Alert{Severity::info, "test", "that was all"});
  ASSERT_TRUE(
      listener_->find([](const SeenEvent& event) { return event.fields.value("message", "") == "that was all"; }));
  std::vector<std::string> states;
  for (const SeenEvent& event : listener_->heard("state"))
    if (event.fields["state"] != event.fields["previous"]) states.push_back(event.fields["state"]);
  // Those of the background's learning come first.
  const auto first = std::find(states.begin(), states.end(), "capturing");
  states.erase(states.begin(), first);
  ASSERT_THAT(states, SizeIs(2 * captures));
  for (size_t i = 0; i < states.size(); ++i) EXPECT_EQ(states[i], i % 2 == 0 ? "capturing" : "idle");
}

/// With a clock that the test turns, slower than the real one, so that a busy machine does not matter.
class OnTime : public Live {
 protected:
  const Clock& clock() override { return hand_clock_; }
  void SetUp() override {
    Live::SetUp();
    options_.config.capture = CaptureConfig{};  // the promise holds with the defaults
    turner_ = std::jthread([this](const std::stop_token& stop) {
      while (!stop.stop_requested()) {
        std::this_thread::sleep_for(std::chrono::milliseconds(5));
        hand_clock_.advance(milliseconds(1));
      }
    });
  }
  HandClock hand_clock_;
  std::jthread turner_;
};

TEST_F(OnTime, WhatAShotHasIsClearWithin500Milliseconds) {
  begin();
  fake_->play([](const std::string& id, ShotRole role, int) {
    if (role != ShotRole::body) return FakeAnswer{};
    if (id == "b0") return FakeAnswer{.kind = Kind::nothing};
    return FakeAnswer{.delay = id == "b1" ? seconds(3) : milliseconds(30)};
  });
  const std::string id = capture({{"face", "none"}});
  EXPECT_EQ(end_of(id), "camera_unavailable") << "3 cameras are needed";
  EXPECT_THAT(failure_, HasSubstr("missing: b0, b1"));
  const Json shot = shots(id).at(0);
  EXPECT_EQ(shot["retries"], 1);
  EXPECT_EQ(shot["missing"], Json({"b0", "b1"}));
  EXPECT_LE(shot["decided_ms"], 500);
  EXPECT_GE(shot["decided_ms"], 400) << "both triggers had their time";
}

/// A program in place of booth-calibrate that has looked as soon as it is asked: these pictures are too small for any
/// board.
fs::path Live::write_onlooker() const {
  const fs::path program = folder_.path() / "onlooker";
  std::ofstream(program) << "#!/bin/sh\necho '{\"shots\": 1}' > \"$2/look.json\"\n";
  fs::permissions(program, fs::perms::owner_all);
  return program;
}

TEST_F(Live, AShotOfTheBoardHasTheProjectedPatternsToo) {
  options_.calibrate_command = write_onlooker();
  begin();
  const SeenEvent end = end_of_task(call("calibration.capture", {{"patterns", true}, {"floor", true}})["task"]);
  ASSERT_EQ(end.fields["state"], "done") << end.fields;
  EXPECT_EQ(end.fields["result"]["shots"], 1);
  EXPECT_THAT(fake_->shown(), ElementsAre(0, 1, 2, 3, 4, 5, 6, 7, -1));
  const auto shot = read_recording(options_.config.booth.rig().parent_path() / "session" / "shots" / "001");
  ASSERT_TRUE(shot) << shot.error().message;
  const Shot* board = shot->find(ShotRole::calibration_board);
  const Shot* lit = shot->find(ShotRole::gray_code);
  ASSERT_TRUE(board != nullptr && lit != nullptr);
  EXPECT_EQ(board->name, "floor");
  EXPECT_THAT(board->frames, SizeIs(all_cameras.size()));
  EXPECT_EQ(lit->name, "board-0") << "of the board as it lies in the first picture";
  EXPECT_THAT(lit->frames, SizeIs(2 * patterns)) << "of the face cameras";
}

TEST_F(Live, AShotOfTheBoardThatNobodyDeliversNamesTheCameras) {
  options_.calibrate_command = write_onlooker();
  begin();
  fake_->play([](const std::string&, ShotRole role, int) {
    return FakeAnswer{.kind = role == ShotRole::calibration_board ? Kind::nothing : Kind::frame};
  });
  const SeenEvent end = end_of_task(call("calibration.capture")["task"]);
  EXPECT_EQ(end.fields["state"], "failed");
  EXPECT_EQ(end.fields["error"]["kind"], "camera_unavailable");
  EXPECT_THAT(end.fields["error"]["message"].get<std::string>(), HasSubstr("b0, b1, b2, b3, f0, f1"));
  EXPECT_TRUE(call("system.status")["calibration"]["session"].is_null());
}

TEST_F(Live, ABoothThatWasNeverCalibratedTakesShotsOfTheBoard) {
  options_.calibrate_command = write_onlooker();
  rig_.reset();
  open();
  listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
  ASSERT_TRUE(wait_until([&] { return kinds() == std::vector<std::string>{"not_calibrated", "no_background"}; }));
  const SeenEvent end = end_of_task(call("calibration.capture")["task"]);
  ASSERT_EQ(end.fields["state"], "done") << end.fields;
  const auto shot = read_recording(options_.config.booth.rig().parent_path() / "session" / "shots" / "001");
  ASSERT_TRUE(shot) << shot.error().message;
  ASSERT_THAT(shot->rig.cameras, SizeIs(all_cameras.size()));
  for (const RigCamera& camera : shot->rig.cameras) {
    EXPECT_EQ(camera.intrinsics.width, FakeDevices::width);
    EXPECT_EQ(camera.role == CameraRole::face, camera.id[0] == 'f') << camera.id;
  }
}

}  // namespace
}  // namespace booth::test
