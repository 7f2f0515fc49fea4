#include "daemon/health_monitor.h"

#include <gmock/gmock.h>

#include "tests/daemon/fake_devices.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::AllOf;
using testing::HasSubstr;
using testing::IsEmpty;

/// A booth with cameras that do what a test tells them to, and a background that it has learned itself.
class Health : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    auto read = read_recording(options_.config.replay.recording);
    ASSERT_TRUE(read);
    rig_ = read->rig;
    fake_ = std::make_shared<FakeDevices>(cameras_, clock());
    options_.config.background.quiet_s = 0;
  }
  Result<Devices> devices() override {
    Devices devices;
    devices.source = fake_;
    devices.drivers = {{"fake", fake_}};
    for (const std::string& id : cameras_) devices.cameras.push_back(fake_->see(id).info);
    devices.trigger = "fake";
    devices.rig = rig_;
    return devices;
  }
  void begin() {
    open();
    listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
    ASSERT_TRUE(wait_until([&] {
      const auto reasons = booth_->status().not_ready;
      return reasons.size() == 1 && reasons.front().kind == "no_background";
    })) << call("system.status");
    learn();
  }
  void learn() {
    const std::string task = call("background.learn", {{"frames", 1}})["task"];
    const auto end = listener_->find([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["task"] == task && event.fields["state"] != "running";
    });
    ASSERT_TRUE(end);
    ASSERT_EQ(end->fields["state"], "done") << end->fields;
    ASSERT_TRUE(wait_until([&] { return booth_->status().not_ready.empty(); }));
  }
  void capture_and_publish() {
    capture({{"face", "none"}});
    ASSERT_TRUE(listener_->find("avatar.published"));
  }
  std::vector<std::string> alerts(const std::string& kind) {
    std::vector<std::string> messages;
    for (const SeenEvent& event : listener_->heard("alert"))
      if (event.fields["kind"] == kind) messages.push_back(event.fields["message"]);
    return messages;
  }
  std::optional<SeenEvent> end_of_learning() {
    return listener_->find([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["kind"] == "background" && event.fields["state"] != "running";
    });
  }

  const std::vector<std::string> cameras_{"b0", "b1", "b2", "b3"};
  std::optional<Rig> rig_;
  std::shared_ptr<FakeDevices> fake_;
  std::unique_ptr<Listener> listener_;
};

TEST_F(Health, ACameraThatWasMovedIsNamedWithinItsCapture) {
  begin();
  reconstruct_.behave("moved");
  capture_and_publish();
  EXPECT_THAT(alerts("calibration_drift"),
              testing::ElementsAre(AllOf(HasSubstr("camera b2 "), HasSubstr("3.1 pixels"), HasSubstr("calibrate"))));
  EXPECT_EQ(call("system.status")["calibration"]["moved"], Json({"b2"}));
  // The next capture knows better.
  reconstruct_.behave("good_health");
  capture_and_publish();
  EXPECT_THAT(alerts("calibration_drift"), testing::SizeIs(1));
  EXPECT_THAT(call("system.status")["calibration"]["moved"], IsEmpty());
}

TEST_F(Health, ACameraWhoseBackgroundShiftedIsNamedToo) {
  begin();
  reconstruct_.behave("shifted");
  capture_and_publish();
  EXPECT_THAT(alerts("calibration_drift"),
              testing::ElementsAre(AllOf(HasSubstr("camera b1 "), HasSubstr("0.62 pixels"), HasSubstr("--correct"))));
  EXPECT_EQ(call("system.status")["calibration"]["moved"], Json({"b1"}));
}

TEST_F(Health, AnotherLightIsNoticedAndTheEmptyBoothLearnedAnew) {
  begin();
  reconstruct_.behave("dark");
  capture_and_publish();
  const auto asked = alerts("background_stale");
  ASSERT_THAT(asked, testing::SizeIs(1));
  EXPECT_THAT(asked.front(), AllOf(HasSubstr("1.9"), HasSubstr("4 of 4 cameras")));
  const auto learned = end_of_learning();
  ASSERT_TRUE(learned);
  EXPECT_EQ(learned->fields["state"], "done") << learned->fields;
  EXPECT_TRUE(call("system.status")["background"]["stale"].is_null());
}

TEST_F(Health, ABoothThatDoesNotLookEmptyIsNotLearnedUnasked) {
  begin();
  const Json before = call("system.status")["background"]["created"];
  for (const std::string& id : cameras_)
    fake_->set_pixels(id,
                      [](Image& image) { std::fill_n(image.samples.begin(), image.samples.size() / 2, uint8_t{9}); });
  reconstruct_.behave("dark");
  capture_and_publish();
  const auto learned = end_of_learning();
  ASSERT_TRUE(learned);
  EXPECT_EQ(learned->fields["state"], "failed");
  EXPECT_THAT(alerts("background_stale"), testing::Contains(HasSubstr("could not learn its background by itself")));
  const Json background = call("system.status")["background"];
  EXPECT_EQ(background["created"], before);
  EXPECT_THAT(background["stale"], HasSubstr("the light has changed"));
  // An operator who says that it is empty is believed.
  learn();
  EXPECT_TRUE(call("system.status")["background"]["stale"].is_null());
}

TEST_F(Health, WhoDoesNotWantItUnaskedIsAsked) {
  options_.config.background.relearn = false;
  begin();
  reconstruct_.behave("dark");
  capture_and_publish();
  const auto asked = listener_->find([](const SeenEvent& event) {
    return event.topic == "alert" &&
           event.fields["message"].get<std::string>().find("boothctl background learn") != std::string::npos;
  });
  ASSERT_TRUE(asked);
  EXPECT_THAT(call("system.status")["background"]["stale"], HasSubstr("the light has changed"));
}

TEST(HealthMonitor, ABackgroundGrowsOld) {
  EventBus events;
  const HealthMonitor monitor({.max_age_h = 24}, events);
  EXPECT_EQ(monitor.staleness(std::nullopt), std::nullopt);
  EXPECT_EQ(monitor.staleness(std::chrono::hours(23)), std::nullopt);
  EXPECT_THAT(monitor.staleness(std::chrono::hours(30)).value_or(""), HasSubstr("30 hours ago"));
  const HealthMonitor patient({.max_age_h = 0}, events);
  EXPECT_EQ(patient.staleness(std::chrono::hours(9999)), std::nullopt);
}

TEST(HealthMonitor, OneDazzledCameraIsNoChangeOfLight) {
  EventBus events;
  HealthMonitor monitor({}, events);
  monitor.report("c", {{.camera = "a", .light_factor = 3}, {.camera = "b"}, {.camera = "c"}});
  EXPECT_EQ(monitor.staleness(std::nullopt), std::nullopt);
  monitor.report("c", {{.camera = "a", .light_factor = 3}, {.camera = "b", .light_factor = 1.6}, {.camera = "c"}});
  EXPECT_TRUE(monitor.staleness(std::nullopt));
  monitor.background_learned();
  EXPECT_EQ(monitor.staleness(std::nullopt), std::nullopt);
}

TEST(HealthMonitor, AShiftedCameraStaysBlamedWhenTheBackgroundIsLearnedAnew) {
  EventBus events;
  HealthMonitor monitor({}, events);
  monitor.report("c", {{.camera = "a"}, {.camera = "b", .shifted = true, .background_px = 0.8}});
  EXPECT_EQ(monitor.moved(), std::vector<std::string>{"b"});
  monitor.background_learned();
  monitor.report("d", {{.camera = "a"}, {.camera = "b"}});
  EXPECT_EQ(monitor.moved(), std::vector<std::string>{"b"});
  monitor.calibrated();
  EXPECT_THAT(monitor.moved(), IsEmpty());
}

TEST(HealthMonitor, ABackgroundFromBeforeTheCalibrationBlamesNobody) {
  EventBus events;
  HealthMonitor monitor({}, events);
  monitor.report("c", {{.camera = "a", .shifted = true, .background_px = 0.8}});
  monitor.calibrated();
  monitor.report("d", {{.camera = "a", .shifted = true, .background_px = 0.8}});
  EXPECT_THAT(monitor.moved(), IsEmpty());
  monitor.background_learned();
  EXPECT_THAT(monitor.moved(), IsEmpty());
  monitor.report("e", {{.camera = "a", .shifted = true, .background_px = 0.8}});
  EXPECT_EQ(monitor.moved(), std::vector<std::string>{"a"});
}

TEST(HealthMonitor, ANewCalibrationStartsWithoutBlame) {
  EventBus events;
  HealthMonitor monitor({}, events);
  monitor.report("c", {{.camera = "a", .moved = true}, {.camera = "b"}});
  EXPECT_EQ(monitor.moved(), std::vector<std::string>{"a"});
  monitor.calibrated();
  EXPECT_THAT(monitor.moved(), IsEmpty());
}

}  // namespace
}  // namespace booth::test
