#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <linux/videodev2.h>
#include <spawn.h>
#include <sys/ioctl.h>
#include <sys/wait.h>
#include <unistd.h>
#include <xf86drm.h>

#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "drivers/display/delay_calibration.h"
#include "drivers/display/display_projector.h"
#include "drivers/display/pattern_image.h"
#include "drivers/gpio/gpio_devices.h"
#include "drivers/v4l2/v4l2_source.h"
#include "pipeline/image/codec.h"
#include "replay/recording.h"
#include "tests/drivers/camera_conformance.h"
#include "tests/drivers/noting_source.h"
#include "tests/virtual_booth/guest/display_peer.h"
#include "tests/virtual_booth/guest/guest_booth.h"

extern char** environ;

namespace booth {
namespace {

using testing::AllOf;
using testing::HasSubstr;

/// The emulated machine may be slow, on a busy host very slow. Nothing here waits longer than it must.
constexpr Timestamp patience = seconds(60);

GpioLineSettings line(int number) {
  return {.chip = GuestBooth::instance().gpio().chip(), .line = std::to_string(number)};
}
GpioTriggerSettings trigger_settings() { return {.trigger = line(GuestBooth::trigger_line), .pulse_us = 200}; }

/// A camera by its serial number that waits for its own trigger line.
V4l2CameraSettings wired(const std::string& serial, int width, int height, V4l2Format format = V4l2Format::mjpg) {
  return {.id = serial,
          .serial = serial,
          .format = format,
          .width = width,
          .height = height,
          .trigger = V4l2TriggerSource::line,
          .max_offset_ms = 20000};
}

std::vector<uint8_t> read_file(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

double statistic(const Camera& camera, const std::string& name) {
  for (const Statistic& statistic : camera.statistics())
    if (statistic.name == name) return statistic.value;
  ADD_FAILURE() << "no statistic " << name;
  return 0;
}

class Guest : public testing::Test {
 protected:
  GuestBooth& booth = GuestBooth::instance();
  MonotonicClock clock;

  Timestamp soon() const { return clock.now() + patience; }
  std::unique_ptr<Trigger> open_trigger() {
    auto trigger = open_gpio_trigger(trigger_settings(), clock);
    EXPECT_TRUE(trigger) << trigger.error().message;
    return *std::move(trigger);
  }
  std::shared_ptr<V4l2Source> open_source(std::vector<V4l2CameraSettings> cameras) {
    auto source = V4l2Source::open({std::move(cameras)}, clock);
    EXPECT_TRUE(source) << source.error().message;
    return *source;
  }
  static bool arm(Camera* camera, int count, ShotRole role = ShotRole::body) {
    if (camera == nullptr) return false;
    const auto armed = camera->arm({.role = role}, count);
    EXPECT_TRUE(armed) << armed.error().message;
    return armed.ok();
  }
  std::unique_ptr<Camera> open_camera(DeviceSource& source, const std::string& id) {
    auto camera = source.open_camera(id);
    EXPECT_TRUE(camera) << camera.error().message;
    return camera ? *std::move(camera) : nullptr;
  }
};

/// This program, in another process that does what its arguments say until it is killed.
class OtherProcess {
 public:
  explicit OtherProcess(std::vector<std::string> words) {
    int said[2];
    if (::pipe2(said, O_CLOEXEC) != 0) throw std::runtime_error("no pipe");
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, said[1], STDOUT_FILENO);
    char program[] = "/proc/self/exe";
    std::vector<char*> arguments{program};
    for (std::string& word : words) arguments.push_back(word.data());
    arguments.push_back(nullptr);
    EXPECT_EQ(::posix_spawn(&process_, program, &actions, nullptr, arguments.data(), environ), 0);
    posix_spawn_file_actions_destroy(&actions);
    ::close(said[1]);
    said_ = said[0];
  }
  ~OtherProcess() {
    kill();
    ::close(said_);
  }
  OtherProcess(const OtherProcess&) = delete;
  OtherProcess& operator=(const OtherProcess&) = delete;

  /// Waits until it says that it has begun.
  bool has_begun() const {
    char sign = 0;
    return ::read(said_, &sign, 1) == 1;
  }
  void kill() {
    if (process_ == 0) return;
    ::kill(process_, SIGKILL);
    int status = 0;
    EXPECT_EQ(::waitpid(process_, &status, 0), process_);
    process_ = 0;
  }

 private:
  pid_t process_ = 0;
  int said_ = -1;
};

/// Nobody in particular, while it lives: who may use no device.
class Nobody {
 public:
  Nobody() { EXPECT_EQ(::seteuid(65534), 0); }
  ~Nobody() { EXPECT_EQ(::seteuid(0), 0); }
  Nobody(const Nobody&) = delete;
  Nobody& operator=(const Nobody&) = delete;
};

// ---------------------------------------------------------------------------------------------------------------------
// USB cameras that a GPIO line triggers

/// Cameras that serve the pictures of the recording in the repository, one after the other.
class RecordedBooth : public Guest {
 protected:
  void SetUp() override {
    const auto recording = read_recording(BOOTH_SOURCE_DIR "/replay/recordings/mini");
    ASSERT_TRUE(recording) << recording.error().message;
    std::vector<V4l2CameraSettings> settings;
    for (const RigCamera& camera : recording->rig.cameras) {
      std::vector<std::vector<uint8_t>> frames;
      for (const Shot& shot : recording->shots)
        for (const FrameRecord& frame : shot.frames)
          if (frame.camera == camera.id) frames.push_back(read_file(recording->folder / frame.file));
      pictures.push_back(frames);
      const int width = camera.intrinsics.width, height = camera.intrinsics.height;
      peers.push_back(
          std::make_unique<WiredCamera>(camera.id, std::vector<UsbCameraPeer::Mode>{{"MJPG", width, height}}));
      peers.back()->peer.set_frames(frames);
      ASSERT_TRUE(peers.back()->peer.plug_in()) << camera.id;
      settings.push_back(wired(camera.id, width, height));
    }
    source = open_source(settings);
    for (const V4l2CameraSettings& camera : settings) cameras.push_back(open_camera(*source, camera.id));
    trigger = open_trigger();
  }

  void arm_all(int count) {
    for (const auto& camera : cameras) ASSERT_TRUE(arm(camera.get(), count));
  }
  Timestamp fire(int index) {
    const auto fired = trigger->fire();
    EXPECT_TRUE(fired) << fired.error().message;
    for (const auto& camera : cameras)
      if (camera) camera->note_trigger(index, *fired);
    return *fired;
  }
  /// That camera's frame of that trigger, byte by byte as the camera sent it.
  void expect_frame(size_t camera, int index, size_t picture) {
    const auto frame = cameras[camera]->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->index, index);
    const auto& expected = pictures[camera][picture % pictures[camera].size()];
    ASSERT_TRUE(frame->encoded);
    EXPECT_TRUE(*frame->encoded == expected) << frame->camera << ", trigger " << index;
  }

  std::vector<std::vector<std::vector<uint8_t>>> pictures;  ///< of each camera
  std::vector<std::unique_ptr<WiredCamera>> peers;
  std::shared_ptr<V4l2Source> source;
  std::vector<std::unique_ptr<Camera>> cameras;
  std::unique_ptr<Trigger> trigger;
};

TEST_F(RecordedBooth, EveryShotIsCompleteAndMatched) {
  constexpr int shots = 200;
  arm_all(shots);
  Timestamp slowest = 0;
  for (int shot = 0; shot < shots && !HasFailure(); ++shot) {
    const Timestamp fired = fire(shot);
    for (size_t i = 0; i < cameras.size(); ++i) expect_frame(i, shot, static_cast<size_t>(shot));
    slowest = std::max(slowest, clock.now() - fired);
  }
  for (const auto& camera : cameras) {
    EXPECT_EQ(statistic(*camera, "n_frames"), shots);
    EXPECT_EQ(statistic(*camera, "n_missing_frames"), 0);
    EXPECT_EQ(statistic(*camera, "n_damaged_frames"), 0);
  }
  for (const auto& peer : peers) EXPECT_EQ(peer->peer.missed(), 0);
  std::cout << cameras.size() << " cameras, " << shots << " shots; from trigger to last frame at most "
            << slowest / milliseconds(1) << " ms (emulated)\n";
}

TEST_F(RecordedBooth, ACameraUnpluggedInTheMiddleOfASequenceComesBack) {
  constexpr int shots = 6;
  constexpr size_t victim = 3;
  arm_all(shots);
  for (int shot = 0; shot < 2; ++shot) {
    fire(shot);
    for (size_t i = 0; i < cameras.size(); ++i) expect_frame(i, shot, static_cast<size_t>(shot));
  }
  // In the middle of a shot: it was triggered, and is gone before its frame is fetched.
  peers[victim]->peer.fail_next(UsbCameraPeer::Fault::swallow);
  fire(2);
  const Timestamp unplugged = clock.now();
  peers[victim]->peer.unplug();
  const auto lost = cameras[victim]->wait_frame(soon());
  ASSERT_FALSE(lost);
  EXPECT_EQ(lost.error().code, ErrorCode::device_lost);
  EXPECT_THAT(lost.error().message, HasSubstr(cameras[victim]->info().id));
  const Timestamp noticed = clock.now();
  for (size_t i = 0; i < cameras.size(); ++i)
    if (i != victim) expect_frame(i, 2, 2);
  const std::string id = cameras[victim]->info().id;
  cameras[victim].reset();
  EXPECT_EQ(source->open_camera(id).error().code, ErrorCode::device_lost);
  // The others go on.
  fire(3);
  for (size_t i = 0; i < cameras.size(); ++i)
    if (i != victim) expect_frame(i, 3, 3);

  const Timestamp plugged_in = clock.now();
  ASSERT_TRUE(peers[victim]->peer.plug_in());
  const Timestamp there = clock.now();
  cameras[victim] = open_camera(*source, id);
  ASSERT_TRUE(arm(cameras[victim].get(), shots));
  const Timestamp ready = clock.now();
  for (int shot = 4; shot < shots; ++shot) {
    fire(shot);
    for (size_t i = 0; i < cameras.size(); ++i)
      expect_frame(i, shot, static_cast<size_t>(i == victim ? shot - 4 : shot));
  }
  std::cout << "loss noticed within " << (noticed - unplugged) / milliseconds(1) << " ms; plugged in, the kernel took "
            << (there - plugged_in) / milliseconds(1) << " ms and the driver " << (ready - there) / milliseconds(1)
            << " ms until it was armed again (emulated)\n";
}

TEST_F(RecordedBooth, DamagedAndLostFramesAreNotDelivered) {
  arm_all(10);
  int shot = 0;
  for (const auto fault :
       {UsbCameraPeer::Fault::cut_short, UsbCameraPeer::Fault::error_bit, UsbCameraPeer::Fault::swallow}) {
    peers[0]->peer.fail_next(fault);
    fire(shot);
    // Only when the next frame is there, nothing more can come of this one.
    for (size_t i = 1; i < cameras.size(); ++i) expect_frame(i, shot, static_cast<size_t>(shot));
    fire(++shot);
    const auto first = cameras[0]->wait_frame(soon());
    ASSERT_FALSE(first) << "a damaged frame was delivered";
    EXPECT_THAT(first.error().code, testing::AnyOf(ErrorCode::invalid_file, ErrorCode::timeout))
        << first.error().message;
    for (size_t i = 0; i < cameras.size(); ++i) expect_frame(i, shot, static_cast<size_t>(shot));
    ++shot;
  }
  EXPECT_EQ(statistic(*cameras[0], "n_unanswered_triggers"), 3);
}

// ---------------------------------------------------------------------------------------------------------------------
// What every camera promises, asked of a USB camera that streams all the time

std::optional<DriverUnderTest> streaming_camera(const Clock& clock) {
  const std::string serial = "stream";
  auto peer = std::make_shared<UsbCameraPeer>(serial, std::vector<UsbCameraPeer::Mode>{{"MJPG", 64, 48}}, true);
  std::vector<std::vector<uint8_t>> frames;
  for (const int shade : {20, 120, 220}) frames.push_back(encode_jpeg(Image(64, 48, 3, static_cast<uint8_t>(shade))));
  peer->set_frames(frames);
  if (!peer->plug_in()) {
    ADD_FAILURE() << "the camera cannot be plugged in";
    return std::nullopt;
  }
  V4l2CameraSettings settings = wired(serial, 64, 48);
  settings.trigger = V4l2TriggerSource::stream;
  auto cameras = V4l2Source::open({{settings}}, clock);
  if (!cameras) {
    ADD_FAILURE() << cameras.error().message;
    return std::nullopt;
  }
  return DriverUnderTest{.source = std::make_shared<NotingSource>(
                             *cameras, [&clock] { return open_gpio_trigger(trigger_settings(), clock); }),
                         .camera = serial,
                         .unplug_camera = [peer] { peer->unplug(); },
                         .plug_in_camera = [peer] { peer->plug_in(); }};
}

INSTANTIATE_TEST_SUITE_P(UsbCamera, CameraConformance, testing::Values(DriverFactory(streaming_camera)));

// ---------------------------------------------------------------------------------------------------------------------
// Settings, and what an operator reads when they cannot be met

class UsbSettings : public Guest {
 protected:
  UsbSettings() : peer("set", {{"MJPG", 64, 48}, {"YUYV", 32, 24}, {"GREY", 16, 8}, {"RGGB", 16, 8}}, false) {}
  void SetUp() override { ASSERT_TRUE(peer.plug_in()); }

  std::string refusal(const V4l2CameraSettings& settings) {
    const auto camera = open_source({settings})->open_camera(settings.id);
    EXPECT_FALSE(camera);
    if (camera) return "";
    EXPECT_EQ(camera.error().code, ErrorCode::invalid_argument);
    return camera.error().message;
  }

  UsbCameraPeer peer;
};

TEST_F(UsbSettings, ArriveInTheCamera) {
  auto settings = wired("set", 64, 48);
  settings.exposure_us = 12'300;
  settings.gain = 77;
  settings.fps = 15;
  const auto source = open_source({settings});
  const auto camera = open_camera(*source, "set");
  ASSERT_TRUE(camera);
  EXPECT_EQ(peer.control(1, 2), 1u) << "exposure by hand";
  EXPECT_EQ(peer.control(1, 4), 123u);
  EXPECT_EQ(peer.control(2, 4), 77u);
  EXPECT_THAT(camera->info().model, HasSubstr("Virtual Camera"));
  EXPECT_EQ(camera->info().serial, "set");
}

TEST_F(UsbSettings, ThatCannotBeMetAreRefusedWithTheRange) {
  auto settings = wired("set", 64, 48);
  settings.exposure_us = 2'000'000;
  EXPECT_EQ(refusal(settings), "set: exposure_us is 2000000, this camera takes 100 … 1000000 µs in steps of 100 µs");
  settings = wired("set", 64, 48);
  settings.gain = 256;
  EXPECT_EQ(refusal(settings), "set: gain is 256, this camera takes 0 … 255");
  settings = wired("set", 64, 48);
  settings.white_balance_k = 5000;
  EXPECT_EQ(refusal(settings), "set: white_balance_k is set, but this camera has no such control");
  settings = wired("set", 1920, 1080);
  EXPECT_THAT(refusal(settings), AllOf(HasSubstr("set: format mjpg size 1920x1080 is not possible; this camera offers"),
                                       HasSubstr("mjpg 64x48 at 30/15/10"), HasSubstr("yuyv 32x24")));
  settings = wired("set", 64, 48);
  settings.fps = 120;
  EXPECT_THAT(refusal(settings), HasSubstr("fps 120"));
  settings = wired("set", 64, 48);
  settings.controls = {{"zoom_absolute", 1}};
  EXPECT_THAT(refusal(settings), HasSubstr("controls.zoom_absolute is set, but this camera has no such control"));
}

TEST_F(UsbSettings, TheMetadataNodeIsNoCamera) {
  const auto source = open_source({wired("set", 64, 48)});
  const auto found = source->discover();
  ASSERT_TRUE(found);
  ASSERT_EQ(found->size(), 1u);
  const std::string node = found->front().address;
  auto metadata = wired("set", 64, 48);
  metadata.serial.clear();
  metadata.device = "/dev/video" + std::to_string(std::stoi(node.substr(10)) + 1);
  const auto refused = open_source({metadata})->open_camera("set");
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::unsupported);
  EXPECT_THAT(refused.error().message, HasSubstr("is not a camera's picture stream"));
}

TEST_F(UsbSettings, RawFormatsArriveSampleBySample) {
  const auto trigger = open_trigger();
  GuestBooth::instance().wire(peer);
  std::vector<uint8_t> samples(128);
  for (size_t i = 0; i < samples.size(); ++i) samples[i] = static_cast<uint8_t>(2 * i);
  peer.set_frames({samples});
  for (const V4l2Format format : {V4l2Format::grey, V4l2Format::bayer_rggb}) {
    const auto source = open_source({wired("set", 16, 8, format)});
    const auto camera = open_camera(*source, "set");
    ASSERT_TRUE(arm(camera.get(), 1));
    const auto fired = trigger->fire();
    camera->note_trigger(0, *fired);
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->pixels->samples, samples);
  }
  GuestBooth::instance().unwire(peer);
}

TEST_F(UsbSettings, ACameraInUseBySomebodyElseSaysSo) {
  const auto ours = open_source({wired("set", 64, 48)});
  const auto theirs = open_source({wired("set", 64, 48)});
  const auto camera = open_camera(*theirs, "set");
  ASSERT_TRUE(arm(camera.get(), 1));
  const auto refused = ours->open_camera("set");
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::busy);
  EXPECT_THAT(refused.error().message, HasSubstr("another program uses it"));
}

TEST_F(UsbSettings, ACameraThatThisUserMayNotUseSaysSo) {
  const auto source = open_source({wired("set", 64, 48)});
  const std::string node = source->discover()->front().address;
  auto by_node = wired("set", 64, 48);
  by_node.serial.clear();
  by_node.device = node;
  const Nobody nobody;
  const auto refused = open_source({by_node})->open_camera("set");
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::io);
  EXPECT_EQ(refused.error().message,
            "set: " + node + ": cannot be opened: not permitted; is this user in the group video?");
}

// ---------------------------------------------------------------------------------------------------------------------
// Faults that the kernel's test driver vivid injects

class Vivid : public Guest {
 protected:
  // Buttons of vivid; its header is not among those for programs.
  static constexpr uint32_t first = 0x00F0F000;
  static constexpr uint32_t dropped_percent = first + 64, disconnect = first + 65, flag_error = first + 66,
                            streamon_error = first + 69, fatal_error = first + 70;

  void SetUp() override {
    ASSERT_EQ(std::system("modprobe vivid n_devs=1 node_types=0x1"), 0);
    const auto found = open_source({})->discover();
    ASSERT_TRUE(found);
    for (const CameraInfo& info : *found)
      if (info.model == "vivid") node = info.address;
    ASSERT_FALSE(node.empty());
  }
  void TearDown() override { EXPECT_EQ(std::system("modprobe -r vivid"), 0); }

  void inject(uint32_t control, int value = 1) {
    const int fd = ::open(node.c_str(), O_RDWR);
    v4l2_control wanted{control, value};
    EXPECT_EQ(::ioctl(fd, VIDIOC_S_CTRL, &wanted), 0) << "control " << std::hex << control;
    ::close(fd);
  }
  V4l2CameraSettings settings() const {
    return {
        .id = "vivid", .device = node, .format = V4l2Format::yuyv, .width = 320, .height = 180, .max_offset_ms = 20000};
  }

  std::string node;
};

TEST_F(Vivid, StreamsAndAnswersTriggers) {
  const auto source = open_source({settings()});
  const auto camera = open_camera(*source, "vivid");
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(camera.get(), 3));
  for (int i = 0; i < 3; ++i) {
    camera->note_trigger(i, clock.now());
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->index, i);
    EXPECT_EQ(frame->pixels->channels, 3);
  }
}

TEST_F(Vivid, ABrokenStreamIsALostCameraThatOpensAgain) {
  const auto source = open_source({settings()});
  auto camera = open_camera(*source, "vivid");
  ASSERT_TRUE(arm(camera.get(), 1));
  inject(fatal_error);
  const auto lost = camera->wait_frame(soon());
  ASSERT_FALSE(lost);
  EXPECT_EQ(lost.error().code, ErrorCode::device_lost);
  EXPECT_THAT(lost.error().message, HasSubstr("vivid: its stream broke off"));
  camera.reset();
  camera = open_camera(*source, "vivid");
  ASSERT_TRUE(arm(camera.get(), 1));
  camera->note_trigger(0, clock.now());
  EXPECT_TRUE(camera->wait_frame(soon()));
}

TEST_F(Vivid, AStreamThatDoesNotBeginSaysSo) {
  const auto source = open_source({settings()});
  const auto camera = open_camera(*source, "vivid");
  ASSERT_TRUE(camera);
  inject(streamon_error);
  const auto armed = camera->arm({}, 1);
  ASSERT_FALSE(armed);
  EXPECT_THAT(armed.error().message, HasSubstr("vivid: does not begin to stream"));
  EXPECT_TRUE(arm(camera.get(), 1)) << "once only";
}

TEST_F(Vivid, MarkedAndDroppedFramesAreCountedAndReplaced) {
  const auto source = open_source({settings()});
  const auto camera = open_camera(*source, "vivid");
  ASSERT_TRUE(arm(camera.get(), 5));
  inject(dropped_percent, 50);
  inject(flag_error);
  for (int i = 0; i < 5; ++i) {
    camera->note_trigger(i, clock.now());
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->index, i);
  }
  EXPECT_GT(statistic(*camera, "n_missing_frames"), 0);
}

TEST_F(Vivid, ADisconnectedDeviceIsLost) {
  const auto source = open_source({settings()});
  const auto camera = open_camera(*source, "vivid");
  ASSERT_TRUE(arm(camera.get(), 1));
  inject(disconnect);
  EXPECT_EQ(camera->wait_frame(soon()).error().code, ErrorCode::device_lost);
}

// ---------------------------------------------------------------------------------------------------------------------
// GPIO lines

class GpioLines : public Guest {
 protected:
  void SetUp() override { booth.gpio().forget_edges(); }
};

TEST_F(GpioLines, ATriggerPulsesItsLineBetweenLights) {
  auto settings = trigger_settings();
  settings.pulse_us = 3000;
  settings.lights = line(GuestBooth::lights_line);
  settings.lights_lead_us = 5000;
  settings.lights_hold_us = 20000;
  auto trigger = open_gpio_trigger(settings, clock);
  ASSERT_TRUE(trigger) << trigger.error().message;
  const auto fired = (*trigger)->fire();
  ASSERT_TRUE(fired);
  // Requesting a line sets it, to rest; then each goes on and off.
  const std::vector<GpioPeer::Edge> edges =
      booth.gpio().wait_edges({GuestBooth::trigger_line, GuestBooth::lights_line}, 2 + 4);
  std::vector<std::pair<int, int>> order;
  for (const GpioPeer::Edge& edge : edges) order.emplace_back(edge.line, edge.level);
  const std::pair<int, int> expected[] = {{1, 1}, {0, 1}, {0, 0}, {1, 0}};
  const auto found = std::search(order.begin(), order.end(), std::begin(expected), std::end(expected));
  ASSERT_NE(found, order.end());
  const auto* lights_on = &edges[static_cast<size_t>(found - order.begin())];
  EXPECT_GE(lights_on[1].when_us - lights_on[0].when_us, 5000);
  EXPECT_GE(lights_on[2].when_us - lights_on[1].when_us, 3000);
  EXPECT_GE(lights_on[3].when_us - lights_on[1].when_us, 20000);
  EXPECT_LE(*fired / 1000, lights_on[1].when_us) << "the edge is not before the instant that is said";
}

TEST_F(GpioLines, AnActiveLowLineRestsHigh) {
  auto settings = trigger_settings();
  settings.trigger = line(4);
  settings.trigger.active = ActiveLevel::low;
  {
    const auto trigger = open_gpio_trigger(settings, clock);
    ASSERT_TRUE(trigger) << trigger.error().message;
    EXPECT_EQ(booth.gpio().level(4), 1);
    ASSERT_TRUE((*trigger)->fire());
    EXPECT_EQ(booth.gpio().level(4), 1);
  }
  const auto edges = booth.gpio().wait_edges({4}, 3);
  EXPECT_TRUE(
      std::any_of(edges.begin(), edges.end(), [](const auto& edge) { return edge.line == 4 && edge.level == 0; }));
}

TEST_F(GpioLines, AreFoundByTheirNamesAndRefusedWithTheReason) {
  auto by_name = trigger_settings();
  by_name.trigger.line = "camera-trigger";
  const auto trigger = open_gpio_trigger(by_name, clock);
  ASSERT_TRUE(trigger) << trigger.error().message;
  const std::string chip = booth.gpio().chip();
  const auto busy = open_gpio_trigger(trigger_settings(), clock);
  ASSERT_FALSE(busy);
  EXPECT_EQ(busy.error().code, ErrorCode::busy);
  EXPECT_EQ(busy.error().message, "gpio trigger: line 0 of " + chip + " is in use by boothd trigger");
  by_name.trigger.line = "99";
  EXPECT_EQ(open_gpio_trigger(by_name, clock).error().message,
            "gpio trigger: line 99 of " + chip + " does not exist: the chip has lines 0 … 7");
  by_name.trigger.line = "nowhere";
  EXPECT_EQ(open_gpio_trigger(by_name, clock).error().code, ErrorCode::not_found);
  EXPECT_EQ(open_gpio_trigger(by_name, clock).error().message,
            "gpio trigger: line nowhere of " + chip + " does not exist: no line of the chip has that name");
  auto lit = trigger_settings();
  lit.trigger = line(4);
  lit.lights = line(0);
  EXPECT_EQ(open_gpio_trigger(lit, clock).error().message,
            "gpio lights: line 0 of " + chip + " is in use by boothd trigger");
  EXPECT_EQ(open_gpio_projector({.step = line(0), .reset = line(3)}, clock).error().message,
            "projector: line 0 of " + chip + " is in use by boothd trigger");
  const Nobody nobody;
  const auto forbidden = open_gpio_trigger({.trigger = line(5)}, clock);
  ASSERT_FALSE(forbidden);
  EXPECT_EQ(forbidden.error().code, ErrorCode::io);
  EXPECT_EQ(forbidden.error().message, "gpio trigger: line 5 of " + chip +
                                           " cannot be had, as the chip cannot be opened: Permission denied; is this "
                                           "user in the group gpio?");
}

TEST_F(GpioLines, AProjectorIsSteppedAndReset) {
  const GpioProjectorSettings settings{.pattern = {.width = 4, .height = 2},
                                       .step = line(GuestBooth::step_line),
                                       .reset = line(GuestBooth::reset_line),
                                       .pulse_us = 100,
                                       .pause_us = 100,
                                       .settle_us = 100};
  {
    const auto projector = open_gpio_projector(settings, clock);
    ASSERT_TRUE(projector) << projector.error().message;
    for (int i = 0; i < 8; ++i) ASSERT_TRUE((*projector)->show(i));
  }
  // Both are requested; then a reset, eight steps and a reset, each on and off.
  const auto edges = booth.gpio().wait_edges({GuestBooth::step_line, GuestBooth::reset_line}, 2 + 2 * (1 + 8 + 1));
  const auto rises = [&](int number) {
    return std::count_if(edges.begin(), edges.end(),
                         [&](const auto& edge) { return edge.line == number && edge.level == 1; });
  };
  EXPECT_EQ(rises(GuestBooth::step_line), 8);
  EXPECT_EQ(rises(GuestBooth::reset_line), 2);
  EXPECT_EQ(booth.gpio().level(GuestBooth::step_line), 0);
  EXPECT_EQ(booth.gpio().level(GuestBooth::reset_line), 0);
}

/// Lines of both levels that a process holds active when it is killed.
GpioTriggerSettings long_flash(const std::string& chip) {
  return {.trigger = {.chip = chip, .line = "4", .active = ActiveLevel::low},
          .pulse_us = 100'000,
          .lights = GpioLineSettings{.chip = chip, .line = "5"},
          .lights_hold_us = 1'000'000};
}

TEST_F(GpioLines, RestWhenTheirProcessIsKilledWhileTheyAreActive) {
  // Without our pull they would float to the wrong level.
  booth.gpio().set_pull(4, false);
  booth.gpio().set_pull(5, true);
  OtherProcess service({"--flash", booth.gpio().chip()});
  ASSERT_TRUE(service.has_begun());
  for (bool seen = false; !seen;) {
    booth.gpio().forget_edges();
    booth.gpio().wait_edges({4, 5}, 1);
    seen = booth.gpio().level(4) == 0 && booth.gpio().level(5) == 1;
  }
  service.kill();
  EXPECT_EQ(booth.gpio().level(4), 1);
  EXPECT_EQ(booth.gpio().level(5), 0);
  EXPECT_TRUE(open_gpio_trigger(long_flash(booth.gpio().chip()), clock)) << "and free";
}

TEST_F(GpioLines, AreBroughtToRestByTheServicesOwnCommand) {
  const std::filesystem::path file = std::filesystem::temp_directory_path() / "rest.toml";
  const std::string chip = "chip = \"" + booth.gpio().chip() + "\"\n";
  std::ofstream(file) << "[trigger]\ndriver = \"gpio\"\n[trigger.gpio]\n"
                      << chip << "line = \"4\"\nactive = \"low\"\nlights_" << chip
                      << "lights_line = \"lights\"\n[projector]\ndriver = \"gpio\"\n[projector.gpio]\nstep_" << chip
                      << "step_line = \"step\"\nreset_" << chip << "reset_line = \"reset\"\n";
  booth.gpio().set_pull(4, false);
  booth.gpio().set_pull(GuestBooth::lights_line, true);
  booth.gpio().set_pull(GuestBooth::step_line, true);
  ASSERT_EQ(booth.gpio().level(GuestBooth::lights_line), 1) << "left on";
  EXPECT_EQ(std::system((std::string(BOOTHD) + " --rest --config " + file.string()).c_str()), 0);
  EXPECT_EQ(booth.gpio().level(4), 1);
  EXPECT_EQ(booth.gpio().level(GuestBooth::lights_line), 0);
  EXPECT_EQ(booth.gpio().level(GuestBooth::step_line), 0);
  // Requested, then on and off: the projector is where it is dark.
  EXPECT_EQ(booth.gpio().wait_edges({GuestBooth::reset_line}, 3).back().level, 0);

  const auto held = open_gpio_trigger({.trigger = line(GuestBooth::lights_line)}, clock);
  ASSERT_TRUE(held) << held.error().message;
  EXPECT_NE(std::system((std::string(BOOTHD) + " --rest --config " + file.string()).c_str()), 0) << "one is held";
  std::filesystem::remove(file);
}

// ---------------------------------------------------------------------------------------------------------------------
// The display

class Display : public Guest {
 protected:
  static DisplaySettings settings() { return {.card = GuestBooth::card, .width = 1024, .height = 768, .delay_us = 0}; }
  static bool is_dark() {
    const auto screen = look_at(GuestBooth::card);
    return !screen || screen->is_black();
  }
  static void expect_pattern(const GrayCodePattern& pattern, int index) {
    const auto screen = look_at(GuestBooth::card);
    ASSERT_TRUE(screen) << "the output is off";
    ASSERT_EQ(screen->width, pattern.width);
    ASSERT_EQ(screen->height, pattern.height);
    std::vector<uint32_t> expected(screen->pixels.size());
    draw_pattern(pattern, index, 0xFFFFFF, expected, static_cast<size_t>(pattern.width));
    EXPECT_TRUE(screen->pixels == expected) << "pattern " << index;
  }
  std::unique_ptr<FlippingProjector> open(const DisplaySettings& display) {
    auto projector = open_display_projector(display, clock);
    EXPECT_TRUE(projector) << projector.error().message;
    return projector ? *std::move(projector) : nullptr;
  }
};

TEST_F(Display, ShowsEveryPatternPixelByPixelAndIsBlackOtherwise) {
  {
    const auto projector = open(settings());
    ASSERT_TRUE(projector);
    EXPECT_TRUE(is_dark());
    const GrayCodePattern pattern = projector->info().pattern;
    ASSERT_EQ(pattern_count(pattern), 42);
    Timestamp last = 0;
    for (int i = 0; i < pattern_count(pattern); ++i) {
      const auto flipped = projector->flip(i);
      ASSERT_TRUE(flipped) << flipped.error().message;
      EXPECT_GT(*flipped, last);
      last = *flipped;
      expect_pattern(pattern, i);
    }
    EXPECT_NEAR(static_cast<double>(projector->refresh_ns()), 1e9 / 60, 5e5);
    EXPECT_EQ(projector->show(42).error().code, ErrorCode::invalid_argument);
    ASSERT_TRUE(projector->show(40));
    projector->dark();
    EXPECT_TRUE(is_dark());
    ASSERT_TRUE(projector->show(40));
  }
  EXPECT_TRUE(is_dark()) << "after its end";
}

TEST_F(Display, IsBlackAfterItsProcessWasKilled) {
  OtherProcess projector({"--show-white"});
  EXPECT_TRUE(projector.has_begun()) << "it never showed anything";
  EXPECT_FALSE(is_dark());
  const auto refused = open_display_projector(settings(), clock);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::busy);
  EXPECT_THAT(refused.error().message, HasSubstr("another program draws on /dev/dri/card0"));
  projector.kill();
  EXPECT_TRUE(is_dark());
  EXPECT_TRUE(open(settings())) << "and free";
}

TEST_F(Display, BadSettingsAreRefusedWithWhatIsOffered) {
  auto bad = settings();
  bad.width = 1023;
  EXPECT_THAT(open_display_projector(bad, clock).error().message,
              AllOf(HasSubstr("projector: the mode 1023x768 is not offered"), HasSubstr("1024x768 at 60")));
  bad = settings();
  bad.connector = "HDMI-A-9";
  EXPECT_THAT(open_display_projector(bad, clock).error().message,
              AllOf(HasSubstr("connector HDMI-A-9 is not on /dev/dri/card0"), HasSubstr("Virtual-1 (connected)")));
  bad = settings();
  bad.pattern.width = 912;
  bad.pattern.height = 1140;
  EXPECT_THAT(open_display_projector(bad, clock).error().message, HasSubstr("the pattern is 912x1140"));
  bad = settings();
  bad.card = "/dev/dri/card7";
  EXPECT_EQ(open_display_projector(bad, clock).error().code, ErrorCode::device_lost);
  EXPECT_EQ(open_display_projector(bad, clock).error().message,
            "projector: /dev/dri/card7 cannot be opened: No such file or directory");
}

TEST_F(Display, ACardThatThisUserMayNotUseSaysSo) {
  const Nobody nobody;
  const auto refused = open_display_projector(settings(), clock);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::io);
  EXPECT_EQ(refused.error().message,
            "projector: /dev/dri/card0 cannot be opened: Permission denied; is this user in the group video?");
}

TEST_F(Display, AnUnpluggedDisplaySaysSo) {
  const std::string status = "/sys/class/drm/card0-Virtual-1/status";
  std::ofstream(status) << "off" << std::flush;
  EXPECT_EQ(open_display_projector(settings(), clock).error().message,
            "projector: no display is connected to /dev/dri/card0");
  auto named = settings();
  named.connector = "Virtual-1";
  const auto refused = open_display_projector(named, clock);
  EXPECT_EQ(refused.error().code, ErrorCode::device_lost);
  EXPECT_EQ(refused.error().message, "projector: nothing is connected to Virtual-1 of /dev/dri/card0");
  std::ofstream(status) << "on" << std::flush;
  EXPECT_TRUE(open(named));
}

/// A window system that starts takes the display away from whoever draws on it.
TEST_F(Display, AnotherProgramThatTakesTheDisplayOverIsSuspected) {
  const auto projector = open(settings());
  ASSERT_TRUE(projector && projector->show(40));
  for (const auto& entry : std::filesystem::directory_iterator("/proc/self/fd")) {
    std::error_code gone;
    if (std::filesystem::read_symlink(entry.path(), gone) == GuestBooth::card)
      drmDropMaster(std::stoi(entry.path().filename()));
  }
  const auto shown = projector->show(0);
  ASSERT_FALSE(shown);
  EXPECT_EQ(shown.error().code, ErrorCode::device_lost);
  EXPECT_EQ(shown.error().message, "projector: it does not flip: another program took /dev/dri/card0 over");
}

/// The whole face sequence: projector, trigger, camera. The camera sees what the display shows at its exposure.
TEST_F(Display, ASequenceGivesEachPatternItsFrame) {
  constexpr int step = 16;  // display pixels in one of the camera's
  constexpr int width = 1024 / step, height = 768 / step;
  UsbCameraPeer peer("eye", {{"GREY", width, height}}, false);
  ASSERT_TRUE(peer.plug_in());
  const auto source = open_source({wired("eye", width, height, V4l2Format::grey)});
  const auto camera = open_camera(*source, "eye");
  const auto trigger = open_trigger();
  const auto projector = open(settings());
  ASSERT_TRUE(camera && projector);
  const GrayCodePattern pattern = projector->info().pattern;
  const int count = pattern_count(pattern);
  ASSERT_TRUE(arm(camera.get(), count, ShotRole::gray_code));
  trigger->prepare(ShotRole::gray_code);
  for (int i = 0; i < count; ++i) {
    ASSERT_TRUE(projector->show(i));
    const auto fired = trigger->fire();
    ASSERT_TRUE(fired);
    const auto screen = look_at(GuestBooth::card);
    ASSERT_TRUE(screen);
    std::vector<uint8_t> seen;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        seen.push_back(static_cast<uint8_t>(screen->pixels[static_cast<size_t>(y * step * screen->width + x * step)]));
    peer.set_frames({seen});
    peer.expose();
    camera->note_trigger(i, *fired);
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->index, i);
    std::vector<uint32_t> expected(screen->pixels.size());
    draw_pattern(pattern, i, 0xFFFFFF, expected, static_cast<size_t>(pattern.width));
    int wrong = 0;
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x)
        wrong += frame->pixels->at(x, y) != (expected[static_cast<size_t>(y * step * pattern.width + x * step)] & 255);
    EXPECT_EQ(wrong, 0) << "pattern " << i;
  }
}

int show_white() {
  const MonotonicClock clock;
  auto projector = open_display_projector({.card = GuestBooth::card, .width = 1024, .height = 768}, clock);
  if (!projector || !(*projector)->show(pattern_count((*projector)->info().pattern) - 2)) return EXIT_FAILURE;
  std::cout << "!" << std::flush;
  while (true) ::pause();
}

int flash(const std::string& chip) {
  const MonotonicClock clock;
  const auto trigger = open_gpio_trigger(long_flash(chip), clock);
  if (!trigger) return EXIT_FAILURE;
  std::cout << "!" << std::flush;
  while ((*trigger)->fire()) {
  }
  return EXIT_FAILURE;
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  if (argc > 1 && std::string(argv[1]) == "--show-white") return booth::show_white();
  if (argc > 2 && std::string(argv[1]) == "--flash") return booth::flash(argv[2]);
  testing::InitGoogleTest(&argc, argv);
  if (std::getenv("BOOTH_IN_GUEST") == nullptr) {
    std::cerr << "These tests change the kernel's devices; start them by tests/virtual_booth/guest/run.\n";
    return EXIT_FAILURE;
  }
  return RUN_ALL_TESTS();
}
