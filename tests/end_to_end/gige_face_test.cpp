// A face sequence with cameras that speak GigE Vision, in one process with a projector whose patterns they see.

#include <gmock/gmock.h>

#include "tests/daemon/test_booth.h"
#include "tests/drivers/aravis_booth.h"

namespace booth::test {
namespace {

using testing::ElementsAreArray;
using testing::IsEmpty;
using testing::SizeIs;

constexpr int width = 64, height = 48;
constexpr GrayCodePattern pattern{.width = 8, .height = 4};  // 12 patterns

/// What a camera sees of a pattern: another shade for each.
std::shared_ptr<const Image> shade_of(int index) {
  return std::make_shared<const Image>(width, height, 3, static_cast<uint8_t>(20 + 10 * index));
}

/// Every camera sees what it shows.
class SeenProjector final : public Projector {
 public:
  using Show = std::function<void(int index)>;
  SeenProjector(std::vector<std::shared_ptr<GigeCamera>> cameras, Show show)
      : cameras_(std::move(cameras)), show_(std::move(show)) {}
  const ProjectorInfo& info() const override { return info_; }
  Result<void> show(int index) override {
    for (const auto& camera : cameras_) camera->see({shade_of(index)});
    show_(index);
    return {};
  }
  void dark() noexcept override { show_(-1); }

 private:
  const std::vector<std::shared_ptr<GigeCamera>> cameras_;
  const Show show_;
  const ProjectorInfo info_{"beamer", "test", pattern};
};

/// Cameras of one driver, and the trigger line and the projector of the test.
class FaceBooth final : public DeviceSource {
 public:
  FaceBooth(std::shared_ptr<DeviceSource> cameras, std::vector<std::shared_ptr<GigeCamera>> peers, const Clock& clock,
            SeenProjector::Show show)
      : cameras_(std::make_shared<PulsedSource>(std::move(cameras), peers, clock)),
        peers_(std::move(peers)),
        show_(std::move(show)) {}
  Result<std::vector<CameraInfo>> discover() override { return cameras_->discover(); }
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override { return cameras_->open_camera(id); }
  Result<std::unique_ptr<Trigger>> open_trigger() override { return cameras_->open_trigger(); }
  Result<std::unique_ptr<Projector>> open_projector() override {
    return std::unique_ptr<Projector>(std::make_unique<SeenProjector>(peers_, show_));
  }

 private:
  const std::shared_ptr<DeviceSource> cameras_;
  const std::vector<std::shared_ptr<GigeCamera>> peers_;
  const SeenProjector::Show show_;
};

class GigeFace : public TestBooth {
 protected:
  void SetUp() override {
    if (!no_network_reason().empty()) GTEST_SKIP() << no_network_reason();
    TestBooth::SetUp();
    options_.config.capture.frame_timeout_ms = 1000;
    options_.config.capture.max_skew_ms = 5000;
    rig_.volume = {Eigen::Vector3d(-1, 0, -1), Eigen::Vector3d(1, 2, 1)};
    AravisSettings settings;
    for (const char* id : {"body-0", "body-1", "body-2", "face-0", "face-1"}) {
      const int number = static_cast<int>(peers_.size());
      peers_.push_back(std::make_shared<GigeCamera>(
          GigeCameraOptions{.address = virtual_booth::camera_address(number), .serial = id, .scenes = {shade_of(0)}}));
      AravisCameraSettings camera = virtual_settings(number);
      camera.id = id;
      camera.role = camera.id[0] == 'f' ? CameraRole::face : CameraRole::body;
      settings.cameras.push_back(camera);
      RigCamera& calibrated = rig_.cameras.emplace_back();
      calibrated.id = id;
      calibrated.role = camera.role;
      calibrated.intrinsics = {.width = width, .height = height, .fx = 80, .fy = 80, .cx = 32, .cy = 24};
    }
    CalibratedView projector = rig_.cameras.front();
    projector.id = "beamer";
    rig_.projector = projector;
    auto cameras = AravisSource::create(settings, clock_);
    ASSERT_TRUE(cameras) << cameras.error().message;
    source_ = std::make_shared<FaceBooth>(*cameras, peers_, clock_, [this](int index) {
      const std::lock_guard lock(mutex_);
      shown_.push_back(index);
      if (at_show_) at_show_(index);
    });
  }
  void TearDown() override {
    TestBooth::TearDown();
    source_.reset();
  }
  Result<Devices> devices() override {
    Devices devices;
    devices.source = source_;
    devices.warnings = std::make_shared<WarningRelay>();
    for (const RigCamera& camera : rig_.cameras)
      devices.cameras.push_back({.id = camera.id, .driver = "aravis", .role = camera.role});
    devices.trigger = "pulse";
    devices.projector = "beamer";
    devices.rig = rig_;
    return devices;
  }
  /// The patterns that were shown, without the dark between and after them.
  std::vector<int> shown() {
    const std::lock_guard lock(mutex_);
    std::vector<int> patterns;
    for (const int index : shown_)
      if (index >= 0) patterns.push_back(index);
    return patterns;
  }

  std::vector<std::shared_ptr<GigeCamera>> peers_;
  Rig rig_;
  std::shared_ptr<FaceBooth> source_;
  std::mutex mutex_;
  std::vector<int> shown_;            ///< guarded by mutex_; -1: dark
  std::function<void(int)> at_show_;  ///< guarded by mutex_
};

TEST_F(GigeFace, WhatACameraMissedThatWasSwitchedOffInTheSequenceIsShownAgain) {
  constexpr int killed_at = 4, back_at = 9;
  open();
  Listener listener(options_.config.api.events, booth_.get());
  const auto not_ready = [&] { return booth_->status().not_ready; };
  ASSERT_TRUE(wait_until([&] { return not_ready().size() == 1 && not_ready()[0].kind == "no_background"; }))
      << call("system.status");
  call("background.learn", {{"frames", 1}});
  ASSERT_TRUE(wait_until([&] { return not_ready().empty(); })) << call("system.status");
  {
    const std::lock_guard lock(mutex_);
    at_show_ = [this](int index) {
      if (index == killed_at) peers_.back()->power_off();
      // Once: when it is shown again, the camera is there.
      if (index == back_at) {
        peers_.back()->power_on();
        peers_.back()->see({shade_of(index)});
        at_show_ = {};
      }
    };
  }
  const std::string id = capture({{"face", "active"}});
  const auto end = listener.find(
      [&](const SeenEvent& event) { return event.topic.starts_with("capture.") && event.fields["capture"] == id; });
  ASSERT_TRUE(end);
  ASSERT_EQ(end->topic, "capture.done") << end->fields;

  // Every pattern of every camera is there, and shows that pattern.
  const auto taken = read_recording(options_.config.booth.recordings() / id);
  ASSERT_TRUE(taken) << taken.error().message;
  const Shot& face = *taken->find(ShotRole::gray_code);
  ASSERT_THAT(face.frames, SizeIs(2 * pattern_count(pattern)));
  for (const FrameSet& set : load_shot(*taken, face).sets)
    for (const Frame& frame : set.frames)
      EXPECT_EQ(frame.pixels->at(5, 5), shade_of(set.index)->at(5, 5)) << frame.camera << " " << set.index;

  // Each pattern that it missed was shown again, in order, and no other one.
  const std::vector<int> all = shown();
  size_t first_again = all.size() - 1;
  while (first_again > 0 && all[first_again] > all[first_again - 1]) --first_again;
  std::vector<int> again(all.begin() + static_cast<std::ptrdiff_t>(first_again), all.end()), missed;
  for (int index = killed_at; index < pattern_count(pattern); ++index) missed.push_back(index);
  EXPECT_THAT(again, ElementsAreArray(missed)) << testing::PrintToString(all);
  EXPECT_EQ(std::count_if(all.begin(), all.end(), [](int index) { return index < killed_at; }), killed_at);
  EXPECT_EQ(booth_->status().not_ready.size(), 0u);
}

}  // namespace
}  // namespace booth::test
