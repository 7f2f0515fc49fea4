#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <linux/videodev2.h>

#include <atomic>
#include <cerrno>
#include <memory>
#include <thread>
#include <tuple>

#include "drivers/v4l2/v4l2_source.h"
#include "drivers/v4l2/video_error.h"
#include "pipeline/image/codec.h"
#include "tests/drivers/camera_conformance.h"
#include "tests/drivers/noting_source.h"
#include "tests/drivers/simulated_video.h"

namespace booth {
namespace {

using testing::AllOf;
using testing::HasSubstr;

constexpr const char* node = "/dev/video0";
constexpr const char* id = "body-00";

std::vector<uint8_t> jpeg(int width = 16, int height = 8, uint8_t shade = 128) {
  return encode_jpeg(Image(width, height, 3, shade));
}

class V4l2 : public testing::Test {
 protected:
  V4l2() { system->plug_in(usual_camera()); }

  static V4l2CameraSettings settings() {
    return {.id = id,
            .device = node,
            .format = V4l2Format::mjpg,
            .width = 16,
            .height = 8,
            .warm_up_frames = 0,
            .max_offset_ms = 1000};
  }
  std::shared_ptr<V4l2Source> source(const std::vector<V4l2CameraSettings>& cameras) {
    auto opened = V4l2Source::open({cameras}, clock, system);
    EXPECT_TRUE(opened) << opened.error().message;
    return *opened;
  }
  Result<std::unique_ptr<Camera>> open(const V4l2CameraSettings& camera) { return source({camera})->open_camera(id); }
  std::string refusal(const V4l2CameraSettings& camera, ErrorCode code = ErrorCode::invalid_argument) {
    const auto opened = open(camera);
    EXPECT_FALSE(opened);
    if (opened) return "";
    EXPECT_EQ(opened.error().code, code) << opened.error().message;
    EXPECT_EQ(system->open_descriptors(), 0) << "the device was not closed";
    return opened.error().message;
  }
  /// The camera, armed for `count` triggers.
  std::unique_ptr<Camera> armed(const V4l2CameraSettings& camera, int count = 10, ShotRole role = ShotRole::body) {
    auto opened = open(camera);
    EXPECT_TRUE(opened) << opened.error().message;
    const auto ready = (*opened)->arm({.role = role}, count);
    EXPECT_TRUE(ready) << ready.error().message;
    return *std::move(opened);
  }
  Timestamp soon() const { return clock.now() + seconds(20); }
  /// A trigger whose frame is sent now.
  Timestamp just_before() const { return clock.now() - milliseconds(1); }
  static double statistic(const Camera& camera, const std::string& name) {
    for (const Statistic& statistic : camera.statistics())
      if (statistic.name == name) return statistic.value;
    ADD_FAILURE() << "no statistic " << name;
    return 0;
  }

  MonotonicClock clock;
  std::shared_ptr<SimulatedVideo> system = std::make_shared<SimulatedVideo>();
};

TEST_F(V4l2, TakesTheFrameNearestTheTriggerAndSaysHowFarOffItWas) {
  const auto camera = armed(settings());
  const Timestamp now = clock.now() / 1000 * 1000;
  ASSERT_TRUE(system->send(node, jpeg(16, 8, 10), now - milliseconds(20)));
  ASSERT_TRUE(system->send(node, jpeg(16, 8, 200), now + milliseconds(13)));
  camera->note_trigger(0, now);
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 0);
  EXPECT_EQ(frame->timestamp_ns, now + milliseconds(13));
  EXPECT_NEAR(frame->pixels->at(3, 3), 200, 3);
  EXPECT_DOUBLE_EQ(statistic(*camera, "trigger_offset_ms"), 13);
}

TEST_F(V4l2, KeepsTheBytesOfAJpegAsTheyCame) {
  const auto camera = armed(settings());
  const std::vector<uint8_t> bytes = jpeg();
  std::vector<uint8_t> padded = bytes;
  padded.resize(padded.size() + 64, 0);
  ASSERT_TRUE(system->send(node, padded, clock.now()));
  camera->note_trigger(0, just_before());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  ASSERT_TRUE(frame->encoded);
  EXPECT_EQ(*frame->encoded, bytes);
}

TEST_F(V4l2, DeliversNoDamagedFrame) {
  const auto camera = armed(settings());
  std::vector<uint8_t> cut = jpeg();
  cut.resize(cut.size() / 2);
  camera->note_trigger(0, just_before());
  ASSERT_TRUE(system->send(node, cut, clock.now()));
  ASSERT_TRUE(system->send(node, jpeg(), clock.now(), V4L2_BUF_FLAG_ERROR));
  const auto damaged = camera->wait_frame(clock.now() + milliseconds(300));
  EXPECT_EQ(damaged.error().code, ErrorCode::invalid_file);
  EXPECT_EQ(damaged.error().message,
            "body-00: frame 0 arrived damaged: it is no whole JPEG (" + std::to_string(cut.size()) + " bytes)");
  EXPECT_EQ(statistic(*camera, "n_damaged_frames"), 2);

  // Still armed; a whole frame beside a damaged one answers.
  camera->note_trigger(1, just_before());
  ASSERT_TRUE(system->send(node, cut, clock.now()));
  ASSERT_TRUE(system->send(node, jpeg(), clock.now()));
  const auto whole = camera->wait_frame(soon());
  ASSERT_TRUE(whole) << whole.error().message;
  EXPECT_EQ(whole->index, 1);
}

TEST_F(V4l2, DeliversNoJpegThatOnlyADecoderSeesIsDamaged) {
  const auto camera = armed(settings());
  camera->note_trigger(0, just_before());
  ASSERT_TRUE(system->send(node, jpeg(32, 16), clock.now()));
  EXPECT_EQ(camera->wait_frame(soon()).error().message,
            "body-00: frame 0 arrived damaged: it is 32x16 instead of 16x8");
  std::vector<uint8_t> cut = jpeg();  // its samples end too early, but the end marker is there
  cut.erase(cut.end() - 6, cut.end() - 2);
  camera->note_trigger(1, just_before());
  ASSERT_TRUE(system->send(node, cut, clock.now()));
  EXPECT_EQ(camera->wait_frame(soon()).error().code, ErrorCode::invalid_file);
}

TEST_F(V4l2, AShortRawFrameIsDamaged) {
  auto grey = settings();
  grey.format = V4l2Format::grey;
  const auto camera = armed(grey);
  camera->note_trigger(0, just_before());
  ASSERT_TRUE(system->send(node, std::vector<uint8_t>(100), clock.now()));
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(200)).error().message,
            "body-00: frame 0 arrived damaged: it was cut off: 100 of 128 bytes");
}

TEST_F(V4l2, GreyAndColourComeOutAsTheyAre) {
  auto grey = settings();
  grey.format = V4l2Format::grey;
  std::vector<uint8_t> samples(128);
  for (size_t i = 0; i < samples.size(); ++i) samples[i] = static_cast<uint8_t>(i);
  {
    const auto camera = armed(grey);
    camera->note_trigger(0, just_before());
    ASSERT_TRUE(system->send(node, samples, clock.now()));
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->pixels->samples, samples);
    EXPECT_FALSE(frame->encoded);
    EXPECT_FALSE(frame->mosaic);
  }
  auto raw = settings();
  raw.format = V4l2Format::bayer_rggb;
  {
    const auto camera = armed(raw);
    camera->note_trigger(0, just_before());
    ASSERT_TRUE(system->send(node, samples, clock.now()));
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->pixels->samples, samples);
    ASSERT_TRUE(frame->mosaic);
    EXPECT_EQ(frame->mosaic->pattern, BayerPattern::rggb);
  }
  auto yuyv = settings();
  yuyv.format = V4l2Format::yuyv;
  std::vector<uint8_t> white(256, 128);
  for (size_t i = 0; i < white.size(); i += 2) white[i] = 235;
  const auto camera = armed(yuyv);
  camera->note_trigger(0, just_before());
  ASSERT_TRUE(system->send(node, white, clock.now()));
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->pixels->samples, std::vector<uint8_t>(3 * 128, 255));
}

TEST_F(V4l2, SetsEverythingByHandAndVerifiesIt) {
  auto all = settings();
  all.exposure_us = 8000;
  all.gain = 42;
  all.white_balance_k = 5000;
  all.controls = {{"power_line_frequency", 1}};
  const auto camera = armed(all);
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_AUTO), V4L2_EXPOSURE_MANUAL);
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_AUTO_PRIORITY), 0);
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_ABSOLUTE), 80);
  EXPECT_EQ(system->control_value(node, V4L2_CID_GAIN), 42);
  EXPECT_EQ(system->control_value(node, V4L2_CID_AUTO_WHITE_BALANCE), 0);
  EXPECT_EQ(system->control_value(node, V4L2_CID_WHITE_BALANCE_TEMPERATURE), 5000);
  EXPECT_EQ(system->control_value(node, V4L2_CID_POWER_LINE_FREQUENCY), 1);
  camera->note_trigger(0, just_before());
  ASSERT_TRUE(system->send(node, jpeg(), clock.now()));
  EXPECT_EQ(camera->wait_frame(soon())->exposure_us, 8000);
}

TEST_F(V4l2, FocusIsSetByHand) {
  auto focusing = usual_camera();
  focusing.controls.push_back({V4L2_CID_FOCUS_AUTO, "Focus, Automatic", V4L2_CTRL_TYPE_BOOLEAN, 0, 1, 1, 1});
  focusing.controls.push_back(
      {V4L2_CID_FOCUS_ABSOLUTE, "Focus, Absolute", V4L2_CTRL_TYPE_INTEGER, 0, 250, 5, 0, {}, V4L2_CID_FOCUS_AUTO, 0});
  system->plug_in(focusing);
  auto focused = settings();
  focused.focus = 120;
  ASSERT_TRUE(open(focused));
  EXPECT_EQ(system->control_value(node, V4L2_CID_FOCUS_AUTO), 0);
  EXPECT_EQ(system->control_value(node, V4L2_CID_FOCUS_ABSOLUTE), 120);
  focused.focus = 122;
  EXPECT_EQ(refusal(focused), "body-00: focus is 122, this camera takes 0 … 250 in steps of 5");
}

TEST_F(V4l2, NamedControlsMayFreeOneAnother) {
  auto named = settings();
  named.controls = {{"exposure_time_absolute", 30}, {"auto_exposure", 1}};
  EXPECT_TRUE(open(named));
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_ABSOLUTE), 30);
}

TEST_F(V4l2, SettingsThatACameraForgetsWhenItStreamsAreSetAgain) {
  auto forgetful = usual_camera("/dev/video0");
  forgetful.forgets_on_stream = true;
  system->plug_in(forgetful);
  auto exposed = settings();
  exposed.exposure_us = 8000;
  const auto camera = armed(exposed);
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_ABSOLUTE), 80);
}

TEST_F(V4l2, GrayCodesHaveTheirOwnExposureAndRule) {
  auto two = settings();
  two.exposure_us = 8000;
  two.gray_code_exposure_us = 16000;
  const auto camera = armed(two, 5, ShotRole::gray_code);
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_ABSOLUTE), 160);
  const Timestamp now = clock.now();
  ASSERT_TRUE(system->send(node, jpeg(), now - milliseconds(2)));
  ASSERT_TRUE(system->send(node, jpeg(), now + milliseconds(31)));
  camera->note_trigger(0, now);
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_GE(frame->timestamp_ns, now) << "the earlier one may have seen the pattern before";
  EXPECT_EQ(frame->exposure_us, 16000);
  ASSERT_TRUE(camera->arm({.role = ShotRole::body}, 1));
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_ABSOLUTE), 80);
}

TEST_F(V4l2, RefusesWhatTheCameraCannotDoWithItsRange) {
  auto bad = settings();
  bad.exposure_us = 200;
  EXPECT_EQ(refusal(bad), "body-00: exposure_us is 200, this camera takes 300 … 204700 µs in steps of 100 µs");
  bad = settings();
  bad.gain = 101;
  EXPECT_EQ(refusal(bad), "body-00: gain is 101, this camera takes 0 … 100");
  bad = settings();
  bad.white_balance_k = 5005;
  EXPECT_EQ(refusal(bad), "body-00: white_balance_k is 5005, this camera takes 2800 … 6500 K in steps of 10 K");
  bad = settings();
  bad.focus = 3;
  EXPECT_EQ(refusal(bad), "body-00: focus is set, but this camera has no such control");
  bad = settings();
  bad.gray_code_exposure_us = 300'000;
  EXPECT_THAT(refusal(bad), HasSubstr("exposure_us is 300000, this camera takes 300 … 204700 µs"));
  bad = settings();
  bad.controls = {{"power_line_frequency", 3}};
  EXPECT_EQ(refusal(bad), "body-00: controls.power_line_frequency is 3, this camera takes one of 0, 1, 2");
  bad.controls = {{"zoom", 3}};
  EXPECT_THAT(refusal(bad), AllOf(HasSubstr("controls.zoom is set, but this camera has no such control; it has"),
                                  HasSubstr("white_balance_temperature")));
  system->plug_in(usual_camera());
  bad.controls = {{"white_balance_temperature", 3000}};
  EXPECT_THAT(refusal(bad), HasSubstr("one of its automatics governs it"));
}

TEST_F(V4l2, RefusesAValueThatTheCameraTakesButDoesNotKeep) {
  auto stuck = usual_camera();
  stuck.controls[0].sticks_at = 64;
  system->plug_in(stuck);
  auto bad = settings();
  bad.gain = 40;
  EXPECT_EQ(refusal(bad), "body-00: gain is 40, but the camera set it to 64; it says it takes 0 … 100");
}

TEST_F(V4l2, RefusesAnExposureWithoutAManualMode) {
  auto automatic = usual_camera();
  for (SimulatedControl& control : automatic.controls)
    if (control.id == V4L2_CID_EXPOSURE_AUTO) control.menu = {3};
  system->plug_in(automatic);
  auto bad = settings();
  bad.exposure_us = 8000;
  EXPECT_EQ(refusal(bad), "body-00: exposure_us is set, but this camera's auto_exposure has no manual mode");
}

TEST_F(V4l2, NegotiatesTheFormat) {
  auto any = settings();
  any.format = V4l2Format::automatic;
  any.width = any.height = 0;
  const auto largest = open(any);
  ASSERT_TRUE(largest) << largest.error().message;
  EXPECT_EQ((*largest)->info().width, 32) << "the largest MJPG";
}

TEST_F(V4l2, RefusesAFormatWithWhatIsOffered) {
  auto bad = settings();
  bad.width = 1920;
  bad.height = 1080;
  EXPECT_EQ(refusal(bad),
            "body-00: format mjpg size 1920x1080 is not possible; this camera offers mjpg 16x8 at 30/15, mjpg 32x16 at "
            "30/15, yuyv 16x8 at 30, rggb 16x8 at 30, grey 16x8 at 60");
  bad = settings();
  bad.fps = 60;
  EXPECT_THAT(refusal(bad), HasSubstr("fps 60 is not possible"));
  bad = settings();
  bad.format = V4l2Format::bayer_bggr;
  EXPECT_THAT(refusal(bad), HasSubstr("format bggr size 16x8 is not possible"));
  auto rounding = usual_camera();
  rounding.rounds_width_to = 24;
  system->plug_in(rounding);
  EXPECT_THAT(refusal(settings()),
              HasSubstr("mjpg 16x8 was asked for and is offered, but the camera set itself to 24x8"));
}

TEST_F(V4l2, FindsCamerasBySerialAndBusAndSkipsMetadata) {
  auto metadata = usual_camera("/dev/video1");
  metadata.device_caps = V4L2_CAP_META_CAPTURE | V4L2_CAP_STREAMING;
  system->plug_in(metadata);
  system->plug_in(usual_camera("/dev/video2", "S2", "usb-sim-2"));
  auto by_serial = settings();
  by_serial.device.clear();
  by_serial.serial = "S2";
  auto by_bus = settings();
  by_bus.id = "body-01";
  by_bus.device.clear();
  by_bus.bus = "usb-sim-1";
  const auto both = source({by_serial, by_bus});
  EXPECT_EQ((*both->open_camera(id))->info().address, "/dev/video2");
  EXPECT_EQ((*both->open_camera("body-01"))->info().address, "/dev/video0");
  const auto found = both->discover();
  ASSERT_TRUE(found);
  ASSERT_EQ(found->size(), 2u) << "the metadata node is no camera";
  EXPECT_EQ((*found)[0].id, "body-01");
  EXPECT_EQ((*found)[1].id, id);
  EXPECT_EQ((*source({})->discover())[1].id, "usb-sim-2");

  auto metadata_only = settings();
  metadata_only.device = "/dev/video1";
  EXPECT_EQ(refusal(metadata_only, ErrorCode::unsupported), "body-00: /dev/video1 is not a camera's picture stream");
  system->plug_in(usual_camera("/dev/video3", "S2", "usb-sim-3"));
  EXPECT_THAT(refusal(by_serial), HasSubstr("several cameras have the serial number S2 (at usb-sim-2 and usb-sim-3); "
                                            "name the port with bus instead"));
  by_serial.serial = "S9";
  EXPECT_EQ(refusal(by_serial, ErrorCode::device_lost), "body-00: no camera is plugged in as serial number S9");
}

TEST_F(V4l2, TranslatesWhyAStreamDoesNotBegin) {
  auto crowded = usual_camera();
  crowded.errors = {{VIDIOC_STREAMON, ENOSPC}};
  system->plug_in(crowded);
  auto camera = open(settings());
  ASSERT_TRUE(camera);
  EXPECT_EQ((*camera)->arm({}, 1).error().message,
            "body-00: not enough USB bandwidth is left on its controller: use mjpg, a lower rate or size, or plug it "
            "into another controller");
  crowded.errors = {{VIDIOC_STREAMON, EBUSY}};
  camera = Error{};
  system->plug_in(crowded);
  EXPECT_EQ((*open(settings()))->arm({}, 1).error().message,
            "body-00: does not begin to stream: another program uses it");
  auto unknown_time = usual_camera();
  unknown_time.monotonic = false;
  system->plug_in(unknown_time);
  const auto refused = (*open(settings()))->arm({}, 1);
  EXPECT_EQ(refused.error().code, ErrorCode::unsupported);
  EXPECT_EQ(refused.error().message,
            "body-00: its driver does not stamp frames with the monotonic clock, so that their time is unknown");
}

TEST_F(V4l2, SaysWhatFailsWhenItIsOpened) {
  struct Case {
    unsigned long request;
    int error;
    ErrorCode code;
    const char* message;
  };
  const Case cases[] = {
      {VIDIOC_QUERYCAP, EIO, ErrorCode::device_lost,
       "body-00: /dev/video0: cannot be asked what it is: it does not answer (Input/output error)"},
      {VIDIOC_S_FMT, EBUSY, ErrorCode::busy, "body-00: its format cannot be set: another program uses it"},
      {VIDIOC_S_PARM, ENODEV, ErrorCode::device_lost, "body-00: its frame rate cannot be set: it is not plugged in"},
      {VIDIOC_S_PARM, EINVAL, ErrorCode::invalid_argument, "body-00: fps 30 is not possible"},
      {VIDIOC_S_EXT_CTRLS, EIO, ErrorCode::device_lost,
       "body-00: its gain cannot be set: it does not answer (Input/output error)"},
      {VIDIOC_S_EXT_CTRLS, ERANGE, ErrorCode::invalid_argument,
       "body-00: gain is 40, which the camera refuses; it says it takes 0 … 100"},
      {VIDIOC_S_EXT_CTRLS, EACCES, ErrorCode::invalid_argument,
       "body-00: gain is 40, which the camera refuses while one of its automatics governs it, or as it is read-only"},
      {VIDIOC_G_EXT_CTRLS, EPIPE, ErrorCode::device_lost,
       "body-00: its gain cannot be read: it does not answer (Broken pipe)"}};
  auto asked = settings();
  asked.fps = 30;
  asked.gain = 40;
  for (const Case& one : cases) {
    auto failing = usual_camera();
    failing.errors = {{one.request, one.error}};
    system->plug_in(failing);
    EXPECT_EQ(refusal(asked, one.code), one.message);
  }
  auto stubborn = usual_camera();
  stubborn.keeps_rate = 15;
  system->plug_in(stubborn);
  EXPECT_EQ(refusal(asked), "body-00: fps 30 is not possible; this camera would take 15");
}

TEST_F(V4l2, SaysWhyItHasNoBuffers) {
  const auto expect = [&](const SimulatedNode& failing, ErrorCode code, const std::string& message) {
    system->plug_in(failing);
    const auto camera = open(settings());
    ASSERT_TRUE(camera) << camera.error().message;
    const auto refused = (*camera)->arm({}, 1);
    ASSERT_FALSE(refused) << message;
    EXPECT_EQ(refused.error().code, code) << message;
    EXPECT_EQ(refused.error().message, message);
    EXPECT_FALSE(system->streams(node));
  };
  auto poor = usual_camera();
  poor.most_buffers = 1;
  expect(poor, ErrorCode::io, "body-00: the kernel has memory for 1 buffers only");
  auto unmappable = usual_camera();
  unmappable.maps = false;
  expect(unmappable, ErrorCode::io, "body-00: its buffers cannot be mapped");
  auto failing = usual_camera();
  failing.errors = {{VIDIOC_REQBUFS, EBUSY}};
  expect(failing, ErrorCode::busy, "body-00: lends no buffers: another program uses it");
  failing.errors = {{VIDIOC_REQBUFS, ENOMEM}};
  expect(failing, ErrorCode::io, "body-00: lends no buffers: Cannot allocate memory");
  failing.errors = {{VIDIOC_QUERYBUF, EINVAL}};
  expect(failing, ErrorCode::io, "body-00: does not tell of its buffers: Invalid argument");
  failing.errors = {{VIDIOC_QBUF, EIO}};
  expect(failing, ErrorCode::device_lost, "body-00: takes no buffers: it does not answer (Input/output error)");
}

TEST_F(V4l2, SaysHowAStreamEnded) {
  auto confused = usual_camera();
  confused.fills_wrong_buffer = 100;
  system->plug_in(confused);
  auto camera = armed(settings());
  ASSERT_TRUE(system->send(node, jpeg(), clock.now()));
  EXPECT_EQ(camera->wait_frame(soon()).error().message, "body-00: its driver delivers buffers that it never got");
  camera.reset();
  system->plug_in(usual_camera());
  camera = armed(settings());
  system->unplug(node);
  EXPECT_EQ(camera->wait_frame(soon()).error().message, "body-00: was unplugged");
  camera.reset();
  system->plug_in(usual_camera());
  camera = armed(settings());
  const auto silent = camera->wait_frame(soon());
  EXPECT_EQ(silent.error().code, ErrorCode::device_lost);
  EXPECT_EQ(silent.error().message, "body-00: has delivered no frame for 5 s");
}

TEST_F(V4l2, SaysWhatAFrameThatIsNotThereWantsFor) {
  auto near = settings();
  near.max_offset_ms = 20;
  const auto camera = armed(near);
  EXPECT_EQ(camera->wait_frame(clock.now()).error().message, "body-00: delivered no frame in time");
  const Timestamp triggered = clock.now();
  camera->note_trigger(0, triggered);
  ASSERT_TRUE(system->send(node, jpeg(), triggered + milliseconds(500)));
  EXPECT_EQ(camera->wait_frame(soon()).error().message,
            "body-00: frame 0 is missing: none was exposed within 20 ms of its trigger");
  camera->stop();
  EXPECT_EQ(camera->wait_frame(soon()).error().message, "body-00: was stopped");
  EXPECT_EQ(camera->arm({}, 0).error().message, "body-00: cannot be armed for 0");
}

TEST_F(V4l2, SaysWhatTheSystemsRefusalsMean) {
  const std::tuple<int, ErrorCode, const char*> cases[] = {
      {ENODEV, ErrorCode::device_lost, "it is not plugged in"},
      {ENXIO, ErrorCode::device_lost, "it is not plugged in"},
      {ENOENT, ErrorCode::device_lost, "it is not plugged in"},
      {EBUSY, ErrorCode::busy, "another program uses it"},
      {EACCES, ErrorCode::io, "not permitted; is this user in the group video?"},
      {EPERM, ErrorCode::io, "not permitted; is this user in the group video?"},
      {EIO, ErrorCode::device_lost, "it does not answer (Input/output error)"},
      {EPIPE, ErrorCode::device_lost, "it does not answer (Broken pipe)"},
      {EPROTO, ErrorCode::device_lost, "it does not answer (Protocol error)"},
      {ETIMEDOUT, ErrorCode::device_lost, "it does not answer (Connection timed out)"},
      {EINVAL, ErrorCode::io, "Invalid argument"}};
  for (const auto& [error, code, meaning] : cases) {
    const Error said = system_error("body-00", "/dev/video0 cannot be opened", error);
    EXPECT_EQ(said.code, code);
    EXPECT_EQ(said.message, std::string("body-00: /dev/video0 cannot be opened: ") + meaning);
  }
  auto refused = settings();
  refused.device = "/dev/video7";
  EXPECT_EQ(refusal(refused, ErrorCode::device_lost), "body-00: no camera is plugged in as /dev/video7");
}

TEST_F(V4l2, ACameraThatOffersNothingUsefulIsRefused) {
  auto exotic = usual_camera();
  exotic.sizes = {{V4L2_PIX_FMT_H264, 16, 8}};
  system->plug_in(exotic);
  auto any = settings();
  any.format = V4l2Format::automatic;
  any.width = any.height = 0;
  EXPECT_EQ(refusal(any, ErrorCode::unsupported),
            "body-00: the camera offers none of the formats mjpg, yuyv, grey and 8-bit Bayer");
  exotic.sizes = {{V4L2_PIX_FMT_YUYV, 15, 8}};
  system->plug_in(exotic);
  EXPECT_EQ(refusal(any, ErrorCode::unsupported), "body-00: yuyv pictures of an odd width cannot be read");
}

TEST_F(V4l2, ACameraIsOpenedOnceAndOnlyWhereItIsConfigured) {
  const auto cameras = source({settings()});
  const auto camera = cameras->open_camera(id);
  ASSERT_TRUE(camera);
  EXPECT_EQ(cameras->open_camera(id).error().message, "body-00: is open already");
  EXPECT_EQ(cameras->open_camera("other").error().message,
            "other: no camera of that name is configured for the driver v4l2");
  EXPECT_EQ(cameras->open_trigger().error().message, "v4l2: USB cameras have no trigger");
  EXPECT_EQ(cameras->open_projector().error().message, "v4l2: a camera is no projector");
}

/// Nobody noted the instant of the second one: its frame answers nothing, and the third one's is not taken for it.
TEST_F(V4l2, ATriggerWhoseInstantIsUnknownIsNotAnswered) {
  auto near = settings();
  near.max_offset_ms = 20;
  const auto camera = armed(near);
  const auto fire = [&](std::optional<int> index) {
    const Timestamp when = clock.now();
    if (index) camera->note_trigger(*index, when);
    EXPECT_TRUE(system->send(node, jpeg(), when + milliseconds(1)));
    std::this_thread::sleep_for(std::chrono::milliseconds(60));
  };
  fire(0);
  const auto first = camera->wait_frame(soon());
  ASSERT_TRUE(first) << first.error().message;
  EXPECT_EQ(first->index, 0);
  fire({});
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(100)).error().code, ErrorCode::timeout);
  fire(2);
  const auto third = camera->wait_frame(soon());
  ASSERT_TRUE(third) << third.error().message;
  EXPECT_EQ(third->index, 2);
}

TEST_F(V4l2, ABrokenStreamLosesTheCamera) {
  const auto camera = armed(settings());
  system->break_stream(node);
  const auto waited = camera->wait_frame(soon());
  EXPECT_EQ(waited.error().code, ErrorCode::device_lost);
  EXPECT_EQ(waited.error().message, "body-00: its stream broke off: Input/output error");
  EXPECT_EQ(camera->check_presence().error().code, ErrorCode::device_lost);
}

TEST_F(V4l2, AnUnpluggedCameraIsNoticedWhileItRests) {
  const auto camera = open(settings());
  ASSERT_TRUE(camera);
  EXPECT_TRUE((*camera)->check_presence());
  system->unplug(node);
  EXPECT_EQ((*camera)->check_presence().error().message, "body-00: was unplugged");
  EXPECT_EQ((*camera)->arm({}, 1).error().code, ErrorCode::device_lost);
}

TEST_F(V4l2, SettingsAreAppliedAgainAfterItsReturn) {
  auto exposed = settings();
  exposed.exposure_us = 8000;
  const auto cameras = source({exposed});
  auto camera = cameras->open_camera(id);
  ASSERT_TRUE(camera);
  system->unplug(node);
  camera = Error{};
  EXPECT_EQ(cameras->open_camera(id).error().code, ErrorCode::device_lost);
  system->plug_in(usual_camera());
  ASSERT_TRUE(cameras->open_camera(id));
  EXPECT_EQ(system->control_value(node, V4L2_CID_EXPOSURE_ABSOLUTE), 80);
}

TEST_F(V4l2, CountsFramesThatTheKernelLost) {
  const auto camera = armed(settings());
  camera->note_trigger(0, just_before());
  ASSERT_TRUE(system->send(node, jpeg(), clock.now()));
  ASSERT_TRUE(camera->wait_frame(soon()));
  // More than it has buffers, faster than anybody fetches them: some are lost, all are counted.
  int sent = 1;
  for (; statistic(*camera, "n_missing_frames") == 0 && sent < 100000; ++sent) system->send(node, jpeg(), clock.now());
  EXPECT_GT(statistic(*camera, "n_missing_frames"), 0);
}

TEST_F(V4l2, WarmUpFramesAreNotUsed) {
  auto warm = settings();
  warm.warm_up_frames = 3;
  auto camera = open(warm);
  ASSERT_TRUE(camera);
  std::atomic<bool> is_armed = false;
  std::jthread arming([&] {
    EXPECT_TRUE((*camera)->arm({}, 1));
    is_armed = true;
  });
  while (!system->streams(node)) std::this_thread::yield();
  int sent = 0;
  while (!is_armed)
    if (system->send(node, jpeg(), clock.now())) ++sent;
  EXPECT_GE(sent, 3);
}

TEST_F(V4l2, AStreamThatNobodyWantsEnds) {
  const auto camera = armed(settings());
  EXPECT_TRUE(system->streams(node));
  camera->stop();
  while (system->streams(node)) std::this_thread::yield();
  ASSERT_TRUE(camera->arm({}, 1));
  EXPECT_TRUE(system->streams(node));
}

TEST_F(V4l2, APreviewMakesWayWithoutANewStream) {
  auto warm = settings();
  warm.warm_up_frames = 1;
  auto camera = open(warm);
  ASSERT_TRUE(camera);
  {
    std::atomic<bool> is_armed = false;
    std::jthread arming([&] {
      EXPECT_TRUE((*camera)->arm({.mode = CaptureMode::preview}, 1));
      is_armed = true;
    });
    while (!is_armed) system->send(node, jpeg(), clock.now());
  }
  (*camera)->stop();
  // No frame comes: a stream that began anew would wait for its first one in vain.
  EXPECT_TRUE((*camera)->arm({}, 1));
  EXPECT_TRUE(system->streams(node));
}

TEST_F(V4l2, ACameraWithALineOfItsOwnHasNoPreviewAndIsNotWaitedFor) {
  auto wired = settings();
  wired.trigger = V4l2TriggerSource::line;
  wired.warm_up_frames = 3;
  auto camera = open(wired);
  ASSERT_TRUE(camera);
  const auto preview = (*camera)->arm({.mode = CaptureMode::preview}, 1);
  EXPECT_EQ(preview.error().code, ErrorCode::unsupported);
  EXPECT_EQ(preview.error().message, "body-00: has no preview: it exposes only when its line is pulsed");
  EXPECT_TRUE((*camera)->arm({}, 1)) << "though no frame comes";
}

/// Sends frames as a camera does that streams all the time.
class Stream {
 public:
  Stream(std::shared_ptr<SimulatedVideo> system, const Clock& clock)
      : thread_([system = std::move(system), &clock](const std::stop_token& stopped) {
          const std::vector<uint8_t> picture = jpeg();
          while (!stopped.stop_requested()) {
            system->send(node, picture, clock.now());
            std::this_thread::sleep_for(std::chrono::milliseconds(5));
          }
        }) {}

 private:
  std::jthread thread_;
};

class InstantTrigger final : public Trigger {
 public:
  explicit InstantTrigger(const Clock& clock) : clock_(clock) {}
  const std::string& driver() const override { return driver_; }
  Result<Timestamp> fire() override { return clock_.now(); }

 private:
  const Clock& clock_;
  std::string driver_ = "test";
};

std::optional<DriverUnderTest> simulated(const Clock& clock) {
  auto system = std::make_shared<SimulatedVideo>();
  system->plug_in(usual_camera());
  auto cameras = V4l2Source::open({{{.id = id, .serial = "S1", .format = V4l2Format::mjpg, .width = 16, .height = 8}}},
                                  clock, system);
  if (!cameras) {
    ADD_FAILURE() << cameras.error().message;
    return std::nullopt;
  }
  auto stream = std::make_shared<Stream>(system, clock);
  return DriverUnderTest{
      .source = std::make_shared<NotingSource>(*cameras,
                                               [&clock] {
                                                 return Result<std::unique_ptr<Trigger>>(
                                                     std::unique_ptr<Trigger>(std::make_unique<InstantTrigger>(clock)));
                                               }),
      .camera = id,
      .unplug_camera = [system, stream] { system->unplug(node); },
      .plug_in_camera = [system] { system->plug_in(usual_camera()); }};
}

INSTANTIATE_TEST_SUITE_P(SimulatedV4l2, CameraConformance, testing::Values(DriverFactory(simulated)));

}  // namespace
}  // namespace booth
