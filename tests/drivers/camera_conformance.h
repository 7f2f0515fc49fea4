#pragma once

#include <gtest/gtest.h>

#include <atomic>
#include <functional>
#include <memory>
#include <set>
#include <string>
#include <thread>

#include "drivers/clock.h"
#include "drivers/device_source.h"

namespace booth {

/// A driver at its test: real, simulated or replayed devices.
struct DriverUnderTest {
  std::shared_ptr<DeviceSource> source;
  std::string camera;                        ///< one that answers the trigger
  ShotRole role = ShotRole::body;            ///< that it can be armed for
  std::function<void()> unplug_camera = {};  ///< empty where the test cannot
  std::function<void()> plug_in_camera = {};
};

/// Makes the driver under test, or nothing where its devices are not here: the tests are skipped then.
using DriverFactory = std::function<std::optional<DriverUnderTest>(const Clock&)>;

/// What drivers/camera.h, trigger.h, projector.h and device_source.h promise, asked of any driver:
///   INSTANTIATE_TEST_SUITE_P(Aravis, CameraConformance, testing::Values(DriverFactory(aravis_fake)));
class CameraConformance : public testing::TestWithParam<DriverFactory> {
 protected:
  void SetUp() override {
    auto driver = GetParam()(clock);
    if (!driver) GTEST_SKIP() << "the devices are not here";
    under_test = *driver;
  }

  std::unique_ptr<Camera> open_camera() {
    auto camera = under_test.source->open_camera(under_test.camera);
    EXPECT_TRUE(camera) << camera.error().message;
    return camera ? *std::move(camera) : nullptr;
  }
  std::unique_ptr<Trigger> open_trigger() {
    auto trigger = under_test.source->open_trigger();
    EXPECT_TRUE(trigger) << trigger.error().message;
    return trigger ? *std::move(trigger) : nullptr;
  }
  Result<void> arm(Camera& camera, int count) { return camera.arm({.role = under_test.role}, count); }
  Timestamp soon() const { return clock.now() + seconds(10); }

  static constexpr Timestamp not_long = milliseconds(30);

  MonotonicClock clock;
  DriverUnderTest under_test;
};

TEST_P(CameraConformance, IsDiscovered) {
  const auto found = under_test.source->discover();
  ASSERT_TRUE(found) << found.error().message;
  std::set<std::string> ids;
  for (const CameraInfo& info : *found) EXPECT_TRUE(ids.insert(info.id).second) << info.id << " occurs twice";
  EXPECT_TRUE(ids.contains(under_test.camera));
}

TEST_P(CameraConformance, SaysWhatItIs) {
  const auto camera = open_camera();
  ASSERT_TRUE(camera);
  EXPECT_EQ(camera->info().id, under_test.camera);
  EXPECT_FALSE(camera->info().driver.empty());
  EXPECT_GT(camera->info().width, 0);
  EXPECT_GT(camera->info().height, 0);
}

TEST_P(CameraConformance, OpensOnceAndAgainAfterItWasClosed) {
  auto camera = open_camera();
  ASSERT_TRUE(camera);
  EXPECT_EQ(under_test.source->open_camera(under_test.camera).error().code, ErrorCode::busy);
  camera.reset();
  EXPECT_TRUE(open_camera());
  EXPECT_EQ(under_test.source->open_camera("no-such-camera").error().code, ErrorCode::not_found);
}

TEST_P(CameraConformance, AnswersEveryTriggerInOrder) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  constexpr int count = 3;
  ASSERT_TRUE(arm(*camera, count));
  uint64_t last_id = 0;
  for (int i = 0; i < count; ++i) {
    const auto fired = trigger->fire();
    ASSERT_TRUE(fired) << fired.error().message;
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->camera, under_test.camera);
    EXPECT_EQ(frame->index, i);
    ASSERT_TRUE(frame->pixels);
    EXPECT_EQ(frame->pixels->width, camera->info().width);
    EXPECT_EQ(frame->pixels->height, camera->info().height);
    EXPECT_TRUE(frame->pixels->channels == 1 || frame->pixels->channels == 3);
    EXPECT_NEAR(static_cast<double>(frame->timestamp_ns), static_cast<double>(*fired), 1e9);
    EXPECT_NE(frame->frame_id, last_id);
    last_id = frame->frame_id;
  }
}

TEST_P(CameraConformance, KeepsFramesUntilTheyAreFetched) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(arm(*camera, 2));
  ASSERT_TRUE(trigger->fire());
  std::this_thread::sleep_for(std::chrono::milliseconds(100));
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(camera->wait_frame(soon())->index, 0);
  EXPECT_EQ(camera->wait_frame(soon())->index, 1);
}

TEST_P(CameraConformance, AnswersNoMoreTriggersThanItWasArmedFor) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(arm(*camera, 1));
  ASSERT_TRUE(trigger->fire());
  EXPECT_TRUE(camera->wait_frame(soon()));
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(camera->wait_frame(clock.now() + not_long).error().code, ErrorCode::timeout);
}

TEST_P(CameraConformance, WithoutATriggerThereIsNoFrame) {
  const auto camera = open_camera();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 1));
  const Timestamp deadline = clock.now() + not_long;
  EXPECT_EQ(camera->wait_frame(deadline).error().code, ErrorCode::timeout);
  EXPECT_GE(clock.now(), deadline);
  EXPECT_EQ(camera->wait_frame(clock.now() - seconds(1)).error().code, ErrorCode::timeout);
}

TEST_P(CameraConformance, ATriggerBeforeItWasArmedIsNotAnswered) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(trigger->fire());
  ASSERT_TRUE(arm(*camera, 1));
  EXPECT_EQ(camera->wait_frame(clock.now() + not_long).error().code, ErrorCode::timeout);
}

TEST_P(CameraConformance, ArmingAnewDropsOldFrames) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(arm(*camera, 2));
  ASSERT_TRUE(trigger->fire());
  EXPECT_TRUE(camera->wait_frame(soon()));
  ASSERT_TRUE(trigger->fire());
  ASSERT_TRUE(arm(*camera, 1));
  EXPECT_EQ(camera->wait_frame(clock.now() + not_long).error().code, ErrorCode::timeout);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(camera->wait_frame(soon())->index, 0);
}

TEST_P(CameraConformance, IsNotArmedForNothing) {
  const auto camera = open_camera();
  ASSERT_TRUE(camera);
  EXPECT_EQ(arm(*camera, 0).error().code, ErrorCode::invalid_argument);
  EXPECT_EQ(arm(*camera, -1).error().code, ErrorCode::invalid_argument);
  EXPECT_EQ(camera->wait_frame(soon()).error().code, ErrorCode::cancelled);
}

TEST_P(CameraConformance, StopWakesWhoeverWaits) {
  const auto camera = open_camera();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 1));
  const Timestamp far = clock.now() + seconds(600);
  std::atomic<bool> waiting = false;
  std::jthread stopper([&] {
    while (!waiting) std::this_thread::yield();
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
    camera->stop();
  });
  waiting = true;
  EXPECT_EQ(camera->wait_frame(far).error().code, ErrorCode::cancelled);
  EXPECT_EQ(camera->wait_frame(far).error().code, ErrorCode::cancelled);
  camera->stop();
}

TEST_P(CameraConformance, WorksAgainAfterStop) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  for (int round = 0; round < 3; ++round) {
    ASSERT_TRUE(arm(*camera, 2));
    ASSERT_TRUE(trigger->fire());
    EXPECT_EQ(camera->wait_frame(soon())->index, 0);
    camera->stop();
    EXPECT_EQ(camera->wait_frame(soon()).error().code, ErrorCode::cancelled);
  }
}

TEST_P(CameraConformance, PreviewsWithoutATriggerAndTakesTriggersAfterwards) {
  const auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(camera->arm({.role = under_test.role, .mode = CaptureMode::preview}, 1));
  int last = -1;
  for (int i = 0; i < 3; ++i) {
    const Timestamp asked = clock.now();
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_GT(frame->index, last);
    last = frame->index;
    EXPECT_EQ(frame->pixels->width, camera->info().width);
    EXPECT_GT(frame->timestamp_ns, asked - seconds(1));
  }
  ASSERT_TRUE(arm(*camera, 1));
  EXPECT_EQ(camera->wait_frame(clock.now() + not_long).error().code, ErrorCode::timeout) << "the preview is over";
  ASSERT_TRUE(trigger->fire());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 0);
}

TEST_P(CameraConformance, IsPresentWhileItIsOpen) {
  const auto camera = open_camera();
  ASSERT_TRUE(camera);
  EXPECT_TRUE(camera->check_presence());
}

TEST_P(CameraConformance, PixelsOutliveTheCamera) {
  auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(arm(*camera, 1));
  ASSERT_TRUE(trigger->fire());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame);
  camera.reset();
  under_test.source.reset();
  EXPECT_EQ(frame->pixels->samples.size(),
            static_cast<size_t>(frame->pixels->width * frame->pixels->height * frame->pixels->channels));
}

TEST_P(CameraConformance, ALostCameraSaysSoAndComesBack) {
  if (!under_test.unplug_camera) GTEST_SKIP() << "this camera cannot be unplugged by a program";
  auto camera = open_camera();
  const auto trigger = open_trigger();
  ASSERT_TRUE(camera && trigger);
  ASSERT_TRUE(arm(*camera, 1));
  {
    const std::jthread unplugger([&] { under_test.unplug_camera(); });
    EXPECT_EQ(camera->wait_frame(clock.now() + seconds(600)).error().code, ErrorCode::device_lost);
  }
  EXPECT_EQ(arm(*camera, 1).error().code, ErrorCode::device_lost);
  EXPECT_EQ(camera->check_presence().error().code, ErrorCode::device_lost);
  EXPECT_EQ(under_test.source->open_camera(under_test.camera).error().code, ErrorCode::device_lost);
  camera.reset();
  EXPECT_EQ(under_test.source->open_camera(under_test.camera).error().code, ErrorCode::device_lost);
  under_test.plug_in_camera();
  camera = open_camera();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 1));
  ASSERT_TRUE(trigger->fire());
  EXPECT_TRUE(camera->wait_frame(soon()));
}

}  // namespace booth
