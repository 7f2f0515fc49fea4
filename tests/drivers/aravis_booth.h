#pragma once

#include <gtest/gtest.h>

#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "drivers/aravis/aravis_source.h"
#include "drivers/clock.h"
#include "drivers/device_source.h"
#include "tests/virtual_booth/gige/gige_camera.h"

namespace booth {

using virtual_booth::GigeCamera;
using virtual_booth::GigeCameraOptions;

/// Why this machine lets us have no network for virtual cameras; empty where it does. Entered before the first test.
inline std::string& no_network_reason() {
  static std::string reason;
  return reason;
}

class OwnNetwork : public testing::Environment {
 public:
  void SetUp() override {
    constexpr int addresses = 8;
    no_network_reason() = virtual_booth::enter_own_network(addresses);
  }
};

/// A picture whose every pixel differs from its neighbours, and that of other `seed`s.
inline std::shared_ptr<const Image> test_scene(int width, int height, int seed) {
  auto scene = std::make_shared<Image>(width, height, 3);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c) scene->at(x, y, c) = static_cast<uint8_t>(x * 7 + y * 13 + c * 61 + seed * 29);
  return scene;
}

/// One pulse on the line that all cameras hang on.
class PulseTrigger final : public Trigger {
 public:
  PulseTrigger(std::vector<std::shared_ptr<GigeCamera>> cameras, const Clock& clock)
      : cameras_(std::move(cameras)), clock_(clock) {}
  const std::string& driver() const override { return driver_; }
  Result<Timestamp> fire() override {
    const Timestamp when = clock_.now();
    for (const auto& camera : cameras_) camera->pulse();
    return when;
  }

 private:
  const std::vector<std::shared_ptr<GigeCamera>> cameras_;
  const Clock& clock_;
  const std::string driver_ = "pulse";
};

/// The cameras of one driver and the trigger line of another.
class PulsedSource final : public DeviceSource {
 public:
  PulsedSource(std::shared_ptr<DeviceSource> cameras, std::vector<std::shared_ptr<GigeCamera>> peers,
               const Clock& clock)
      : cameras_(std::move(cameras)), peers_(std::move(peers)), clock_(clock) {}
  Result<std::vector<CameraInfo>> discover() override { return cameras_->discover(); }
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override { return cameras_->open_camera(id); }
  Result<std::unique_ptr<Trigger>> open_trigger() override {
    return std::unique_ptr<Trigger>(std::make_unique<PulseTrigger>(peers_, clock_));
  }
  Result<std::unique_ptr<Projector>> open_projector() override { return cameras_->open_projector(); }

 private:
  const std::shared_ptr<DeviceSource> cameras_;
  const std::vector<std::shared_ptr<GigeCamera>> peers_;
  const Clock& clock_;
};

/// Settings of the camera of that number, found by its address, as quick as the virtual ones are.
inline AravisCameraSettings virtual_settings(int number) {
  return {.id = "cam-" + std::to_string(number),
          .address = virtual_booth::camera_address(number),
          .exposure_us = 1000,
          .pixel_format = "Mono8",
          .preview_fps = 20,
          .packet_size = 1500,
          // A machine that runs many tests at once may be slow to fetch packets: they are not lost.
          .frame_retention_ms = 5000,
          .socket_buffer_kib = 4096};
}

}  // namespace booth
