// USB3 Vision cameras by Aravis, triggered by a GPIO line.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "drivers/aravis/aravis_source.h"
#include "drivers/clock.h"
#include "drivers/gpio/gpio_devices.h"
#include "tests/virtual_booth/guest/guest_booth.h"
#include "tests/virtual_booth/guest/usb3_vision_peer.h"

namespace booth {
namespace {

using testing::HasSubstr;

constexpr int width = 320, height = 240;
constexpr uint32_t exposure_register = 0x8050, gain_register = 0x805c;

std::shared_ptr<const Image> picture(int seed) {
  auto image = std::make_shared<Image>(width, height, 1);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) image->at(x, y) = static_cast<uint8_t>(x * 7 + y * 13 + seed * 29);
  return image;
}

class Usb3Vision : public testing::Test {
 protected:
  void SetUp() override {
    booth.at_trigger([this](const GpioPeer::Edge&) { peer.expose(); });
    plug_in();
    auto opened = open_gpio_trigger({.trigger = {.chip = booth.gpio().chip(), .line = "0"}}, clock);
    ASSERT_TRUE(opened) << opened.error().message;
    trigger = *std::move(opened);
  }
  void TearDown() override { booth.at_trigger({}); }

  /// Until libusb has heard of it, too.
  void plug_in() {
    ASSERT_TRUE(peer.plug_in());
    const auto cameras = source(settings());
    const Timestamp patience = soon();
    while (clock.now() < patience) {
      const auto found = cameras->discover();
      if (found && !found->empty()) return;
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
    FAIL() << "it is not discovered";
  }

  static AravisCameraSettings settings() {
    return {.id = "usb3", .serial = "U3V-1", .exposure_us = 4000, .gain_db = 6, .pixel_format = "Mono8"};
  }
  std::shared_ptr<AravisSource> source(const AravisCameraSettings& camera) {
    auto created = AravisSource::create({.cameras = {camera}, .action = {}}, clock);
    EXPECT_TRUE(created) << created.error().message;
    return *created;
  }
  Error refusal(const AravisCameraSettings& camera) {
    const auto opened = source(camera)->open_camera("usb3");
    return opened ? Error{ErrorCode::internal, "it was opened"} : opened.error();
  }
  void fire(Camera& camera, int index) {
    const auto fired = trigger->fire();
    ASSERT_TRUE(fired) << fired.error().message;
    camera.note_trigger(index, *fired);
  }
  Timestamp soon() const { return clock.now() + seconds(60); }

  GuestBooth& booth = GuestBooth::instance();
  const MonotonicClock clock;
  const std::vector<std::shared_ptr<const Image>> pictures{picture(0), picture(1), picture(2)};
  Usb3VisionPeer peer{"U3V-1", pictures};
  std::unique_ptr<Trigger> trigger;
};

TEST_F(Usb3Vision, EveryTriggerIsAnsweredByItsFrame) {
  const auto cameras = source(settings());
  const auto found = cameras->discover();
  ASSERT_TRUE(found) << found.error().message;
  ASSERT_EQ(found->size(), 1u);
  EXPECT_EQ(found->front().id, "usb3");
  EXPECT_EQ(found->front().serial, "U3V-1");
  const auto camera = cameras->open_camera("usb3");
  ASSERT_TRUE(camera) << camera.error().message;
  EXPECT_EQ((*camera)->info().model, "VirtualBooth USB3");
  EXPECT_EQ((*camera)->info().width, width);
  size_t exposed = 0;
  for (const int triggers : {1, 10, 1}) {
    ASSERT_TRUE((*camera)->arm({.role = ShotRole::body}, triggers));
    for (int i = 0; i < triggers; ++i, ++exposed) {
      fire(**camera, i);
      const auto frame = (*camera)->wait_frame(soon());
      ASSERT_TRUE(frame) << frame.error().message;
      EXPECT_EQ(frame->index, i);
      EXPECT_EQ(frame->exposure_us, 4000);
      EXPECT_TRUE(frame->pixels->samples == pictures[exposed % pictures.size()]->samples) << exposed;
    }
  }
  EXPECT_NEAR(peer.float_register(exposure_register), 4000, 0.1);
  EXPECT_NEAR(peer.float_register(gain_register), 6, 0.01);
  ASSERT_TRUE((*camera)->arm({.mode = CaptureMode::preview}, 1));
  EXPECT_TRUE((*camera)->wait_frame(soon())) << "it shows what it sees";
}

TEST_F(Usb3Vision, WhatTheCameraCannotDoIsRefused) {
  auto bad = settings();
  bad.exposure_us = 5;
  EXPECT_EQ(refusal(bad).message, "camera usb3: exposure_us: 5, but the camera's range is 20 … 1000000");
  bad = settings();
  bad.serial = "U3V-2";
  EXPECT_EQ(refusal(bad).code, ErrorCode::device_lost);
  EXPECT_EQ(refusal(bad).message, "camera usb3: nothing answers at serial number U3V-2");
  bad = settings();
  bad.ptp = true;
  EXPECT_EQ(refusal(bad).message, "camera usb3: ptp: the camera does not offer it");
}

TEST_F(Usb3Vision, ADamagedFrameIsReported) {
  const auto camera = source(settings())->open_camera("usb3");
  ASSERT_TRUE(camera) << camera.error().message;
  ASSERT_TRUE((*camera)->arm({.role = ShotRole::body}, 2));
  peer.cut_next_frame();
  fire(**camera, 0);
  const auto cut = (*camera)->wait_frame(soon());
  ASSERT_FALSE(cut);
  EXPECT_EQ(cut.error().code, ErrorCode::invalid_file);
  EXPECT_THAT(cut.error().message, HasSubstr("camera usb3: a frame arrived damaged: "));
  fire(**camera, 1);
  const auto whole = (*camera)->wait_frame(soon());
  ASSERT_TRUE(whole) << whole.error().message;
  EXPECT_EQ(whole->index, 1);
}

TEST_F(Usb3Vision, OneUnpluggedInAShotComesBackWithItsSettings) {
  const auto cameras = source(settings());
  {
    const auto camera = cameras->open_camera("usb3");
    ASSERT_TRUE(camera) << camera.error().message;
    ASSERT_TRUE((*camera)->arm({.role = ShotRole::body}, 2));
    fire(**camera, 0);
    ASSERT_TRUE((*camera)->wait_frame(soon()));
    peer.unplug();
    fire(**camera, 1);
    const auto lost = (*camera)->wait_frame(soon());
    ASSERT_FALSE(lost);
    EXPECT_EQ(lost.error().code, ErrorCode::device_lost);
    EXPECT_EQ(lost.error().message, "camera usb3 does not answer any more");
    EXPECT_EQ((*camera)->check_presence().error().code, ErrorCode::device_lost);
  }
  EXPECT_EQ(cameras->open_camera("usb3").error().code, ErrorCode::device_lost);
  ASSERT_NO_FATAL_FAILURE(plug_in());
  EXPECT_NEAR(peer.float_register(exposure_register), 5000, 0.1) << "it has forgotten all";
  const auto camera = cameras->open_camera("usb3");
  ASSERT_TRUE(camera) << camera.error().message;
  ASSERT_TRUE((*camera)->arm({.role = ShotRole::body}, 1));
  EXPECT_NEAR(peer.float_register(exposure_register), 4000, 0.1);
  fire(**camera, 0);
  EXPECT_TRUE((*camera)->wait_frame(soon()));
}

}  // namespace
}  // namespace booth
