#include <arpa/inet.h>
#include <gmock/gmock.h>

#include <chrono>
#include <cmath>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <thread>

#include "pipeline/image/develop.h"
#include "replay/recording.h"
#include "tests/drivers/aravis_booth.h"

namespace booth {
namespace {

using testing::AllOf;
using testing::HasSubstr;

[[maybe_unused]] const auto* const network = testing::AddGlobalTestEnvironment(new OwnNetwork);

/// Virtual cameras on a trigger line, and the driver that captures from them.
class AravisSuite : public testing::Test {
 protected:
  void SetUp() override {
    if (!no_network_reason().empty()) GTEST_SKIP() << no_network_reason();
  }

  GigeCamera& add_camera(GigeCameraOptions options = {}) {
    const int number = static_cast<int>(peers.size());
    options.address = virtual_booth::camera_address(number);
    options.serial = "VB" + std::to_string(number);
    if (options.scenes.empty())
      for (int i = 0; i < 5; ++i) options.scenes.push_back(test_scene(160, 120, 10 * number + i));
    scenes.push_back(options.scenes);
    peers.push_back(std::make_shared<GigeCamera>(options));
    settings.cameras.push_back(virtual_settings(number));
    return *peers.back();
  }
  void create_source() {
    auto created = AravisSource::create(settings, clock, [this](const std::string& sentence) {
      const std::lock_guard lock(warnings_mutex);
      warnings.push_back(sentence);
    });
    ASSERT_TRUE(created) << created.error().message;
    source = *created;
  }
  /// Opens the camera of that number; the test fails where it cannot be.
  std::unique_ptr<Camera> open(int number = 0) {
    if (!source) create_source();
    auto opened = source->open_camera(settings.cameras[static_cast<size_t>(number)].id);
    EXPECT_TRUE(opened) << opened.error().message;
    return opened ? *std::move(opened) : nullptr;
  }
  /// Why the camera cannot be opened.
  Error refusal(int number = 0) {
    if (!source) create_source();
    auto opened = source->open_camera(settings.cameras[static_cast<size_t>(number)].id);
    return opened ? Error{ErrorCode::internal, "it was opened"} : opened.error();
  }
  Result<void> arm(Camera& camera, int count) { return camera.arm({.role = ShotRole::body}, count); }
  Timestamp pulse() { return *PulseTrigger(peers, clock).fire(); }
  Timestamp soon() const { return clock.now() + seconds(20); }
  double statistic(const Camera& camera, const std::string& name) {
    for (const Statistic& one : camera.statistics())
      if (one.name == name) return one.value;
    ADD_FAILURE() << "no statistic " << name;
    return 0;
  }
  std::vector<std::string> all_warnings() {
    const std::lock_guard lock(warnings_mutex);
    return warnings;
  }
  /// Grey of a scene, as a Mono8 camera sees it.
  static std::vector<uint8_t> grey_of(const Image& scene) {
    std::vector<uint8_t> grey;
    for (size_t i = 1; i < scene.samples.size(); i += 3) grey.push_back(scene.samples[i]);
    return grey;
  }

  const MonotonicClock clock;
  AravisSettings settings;
  std::vector<std::shared_ptr<GigeCamera>> peers;
  std::vector<std::vector<std::shared_ptr<const Image>>> scenes;
  std::mutex warnings_mutex;
  std::vector<std::string> warnings;  ///< guarded by warnings_mutex
  std::shared_ptr<AravisSource> source;
};

TEST_F(AravisSuite, ThreeCamerasDeliverEachOf200PulsesWholeAndMatched) {
  const auto recording = read_recording(BOOTH_SOURCE_DIR "/replay/recordings/mini");
  ASSERT_TRUE(recording) << recording.error().message;
  const LoadedShot body = load_shot(*recording, *recording->find(ShotRole::body));
  constexpr size_t cameras = 3;
  ASSERT_GE(body.sets[0].frames.size(), 5u);
  for (size_t i = 0; i < cameras; ++i) {
    GigeCameraOptions options{.counts_from_acquisition = i != 1, .clock_error_ppm = 40.0 * static_cast<double>(i)};
    for (size_t scene = 0; scene < cameras; ++scene) {
      const Frame& frame = body.sets[0].frames[(i + scene) % body.sets[0].frames.size()];
      if (scene == 0 ||
          (frame.pixels->width == options.scenes[0]->width && frame.pixels->height == options.scenes[0]->height))
        options.scenes.push_back(frame.pixels);
    }
    add_camera(options);
    settings.cameras[i].pixel_format = "RGB8";
    settings.cameras[i].packet_size = 0;  // found out
    settings.cameras[i].exposure_us = 200;
  }
  std::vector<std::unique_ptr<Camera>> open_cameras;
  for (size_t i = 0; i < cameras; ++i) {
    open_cameras.push_back(open(static_cast<int>(i)));
    ASSERT_TRUE(open_cameras.back());
  }
  // Shots of several triggers, as a face sequence has, and of one.
  constexpr int shots = 200;
  const auto triggers_of = [](int shot) { return shot % 20 == 19 ? 5 : 1; };
  int exposures = 0;
  for (int shot = 0; shot < shots; ++shot) {
    const int triggers = triggers_of(shot);
    for (const auto& camera : open_cameras) ASSERT_TRUE(arm(*camera, triggers));
    for (int trigger = 0; trigger < triggers; ++trigger, ++exposures) {
      const Timestamp fired = pulse();
      for (const auto& camera : open_cameras) camera->note_trigger(trigger, fired);
      for (size_t i = 0; i < cameras; ++i) {
        const auto frame = open_cameras[i]->wait_frame(soon());
        ASSERT_TRUE(frame) << "shot " << shot << ": " << frame.error().message;
        ASSERT_EQ(frame->index, trigger);
        const Image& scene = *scenes[i][static_cast<size_t>(exposures) % scenes[i].size()];
        ASSERT_EQ(frame->pixels->samples, scene.samples) << "shot " << shot << " camera " << i;
        const auto unsure =
            static_cast<Timestamp>(1000 * statistic(*open_cameras[i], "clock_uncertainty_us")) + milliseconds(5);
        ASSERT_GT(frame->timestamp_ns, fired - unsure);
        ASSERT_LT(frame->timestamp_ns, clock.now() + unsure);
      }
    }
  }
  for (size_t i = 0; i < cameras; ++i) {
    EXPECT_EQ(statistic(*open_cameras[i], "frames"), exposures);
    EXPECT_EQ(statistic(*open_cameras[i], "damaged_frames"), 0);
    EXPECT_EQ(statistic(*open_cameras[i], "slipped_triggers"), 0);
    EXPECT_EQ(statistic(*open_cameras[i], "n_underruns"), 0);
    EXPECT_EQ(peers[i]->report().unanswered, 0u);
  }
}

TEST_F(AravisSuite, LostPacketsAreAskedForAgain) {
  GigeCamera& peer = add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  peer.lose_packets(0.05);
  constexpr int shots = 20;
  for (int shot = 0; shot < shots; ++shot) {
    ASSERT_TRUE(arm(*camera, 1));
    pulse();
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->pixels->samples, grey_of(*scenes[0][static_cast<size_t>(shot) % scenes[0].size()]));
  }
  EXPECT_GT(peer.report().packets_lost, 0u);
  EXPECT_GE(peer.report().packets_resent, peer.report().packets_lost);
  EXPECT_GT(statistic(*camera, "n_resent_packets"), 0);
}

TEST_F(AravisSuite, WhatCannotBeHadAgainIsReportedAndNotDelivered) {
  GigeCamera& peer = add_camera();
  settings.cameras[0].frame_retention_ms = 300;
  const auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 3));
  peer.cut_next_frame();
  pulse();
  const auto cut = camera->wait_frame(soon());
  ASSERT_FALSE(cut);
  EXPECT_EQ(cut.error().code, ErrorCode::invalid_file);
  EXPECT_EQ(cut.error().message, "camera cam-0: a frame arrived damaged: packets are missing");
  // The next trigger is the second one, and its frame says so.
  pulse();
  const auto whole = camera->wait_frame(soon());
  ASSERT_TRUE(whole) << whole.error().message;
  EXPECT_EQ(whole->index, 1);
  EXPECT_EQ(statistic(*camera, "damaged_frames"), 1);
}

TEST_F(AravisSuite, WithoutResendALostPacketCostsTheFrame) {
  GigeCamera& peer = add_camera({.resend = false});
  settings.cameras[0].frame_retention_ms = 300;
  const auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 1));
  peer.lose_of_next_frame(2);
  pulse();
  EXPECT_EQ(camera->wait_frame(soon()).error().code, ErrorCode::invalid_file);
}

TEST_F(AravisSuite, AFrameThatNeverComesLeavesAGap) {
  GigeCamera& peer = add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 3));
  camera->note_trigger(0, pulse());
  EXPECT_EQ(camera->wait_frame(soon())->index, 0);
  peer.swallow_next_frame();
  camera->note_trigger(1, pulse());
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(300)).error().code, ErrorCode::timeout);
  camera->note_trigger(2, pulse());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 2);
}

TEST_F(AravisSuite, TheFirstFrameMayBeTheLostOneWhereTriggersAreNoted) {
  GigeCamera& peer = add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 2));
  peer.swallow_next_frame();
  camera->note_trigger(0, pulse());
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(300)).error().code, ErrorCode::timeout);
  camera->note_trigger(1, pulse());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 1);
  EXPECT_EQ(statistic(*camera, "slipped_triggers"), 1);
}

TEST_F(AravisSuite, NoiseOnTheLineDoesNotShiftTheCount) {
  GigeCamera& peer = add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 2));
  camera->note_trigger(0, pulse());
  EXPECT_EQ(camera->wait_frame(soon())->index, 0);
  std::this_thread::sleep_for(std::chrono::milliseconds(400));  // farther from a trigger than any answer may be
  peer.expose_untriggered();
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(900)).error().code, ErrorCode::timeout);
  camera->note_trigger(1, pulse());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 1);
  EXPECT_EQ(statistic(*camera, "unwanted_frames"), 1);
}

TEST_F(AravisSuite, ACameraKilledInAShotComesBackWithAllItsSettings) {
  GigeCamera& peer = add_camera();
  add_camera();
  settings.cameras[0].exposure_us = 1234;
  auto camera = open(0);
  const auto other = open(1);
  ASSERT_TRUE(camera && other);
  ASSERT_TRUE(arm(*camera, 2));
  ASSERT_TRUE(arm(*other, 2));
  for (const auto& one : {camera.get(), other.get()}) one->note_trigger(0, clock.now());
  pulse();
  EXPECT_TRUE(camera->wait_frame(soon()));
  EXPECT_TRUE(other->wait_frame(soon()));
  peer.power_off();
  camera->note_trigger(1, clock.now());
  other->note_trigger(1, pulse());
  // The shot's own deadline first; the loss is found soon after, long before the camera's heartbeat is missed.
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(200)).error().code, ErrorCode::timeout);
  EXPECT_TRUE(other->wait_frame(soon())) << "the others go on";
  const auto lost = camera->wait_frame(soon());
  ASSERT_FALSE(lost);
  EXPECT_EQ(lost.error().code, ErrorCode::device_lost);
  EXPECT_EQ(lost.error().message, "camera cam-0 at 127.0.0.11 does not answer any more");
  EXPECT_EQ(camera->check_presence().error().code, ErrorCode::device_lost);
  camera.reset();
  EXPECT_EQ(refusal(0).message, "camera cam-0: nothing answers at address 127.0.0.11");

  peer.power_on();
  camera = open(0);
  ASSERT_TRUE(camera);
  EXPECT_NEAR(peer.feature("ExposureTime"), 1234, 0.1);
  ASSERT_TRUE(arm(*camera, 1));
  pulse();
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 0);
}

TEST_F(AravisSuite, AMuteCameraIsLostAndHeardAgain) {
  GigeCamera& peer = add_camera();
  auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 1));
  peer.mute(true);
  camera->note_trigger(0, pulse());
  EXPECT_EQ(camera->wait_frame(soon()).error().code, ErrorCode::device_lost);
  camera.reset();
  EXPECT_EQ(refusal().code, ErrorCode::device_lost);
  peer.mute(false);
  // It still believes to be controlled, until its heartbeat timeout is over.
  const Timestamp patience = clock.now() + seconds(20);
  Error why = refusal();
  while (why.code == ErrorCode::busy && clock.now() < patience) {
    EXPECT_EQ(why.message, "camera cam-0: another program controls it (127.0.0.11)");
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
    auto again = source->open_camera("cam-0");
    if (again) camera = *std::move(again);
    why = again ? Error{ErrorCode::internal, "it was opened"} : again.error();
  }
  EXPECT_EQ(why.message, "it was opened");
}

TEST_F(AravisSuite, ASecondClientIsDenied) {
  add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  const auto other = AravisSource::create(settings, clock);
  ASSERT_TRUE(other);
  const auto denied = (*other)->open_camera("cam-0");
  ASSERT_FALSE(denied);
  EXPECT_EQ(denied.error().code, ErrorCode::busy);
  EXPECT_EQ(denied.error().message, "camera cam-0: another program controls it (127.0.0.11)");
  // And the first is not disturbed.
  ASSERT_TRUE(arm(*camera, 1));
  pulse();
  EXPECT_TRUE(camera->wait_frame(soon()));
}

TEST_F(AravisSuite, SetsWhatIsAsked) {
  GigeCamera& peer = add_camera();
  AravisCameraSettings& camera = settings.cameras[0];
  camera.exposure_us = 7500;
  camera.gain_db = 6;
  camera.pattern_exposure_us = 16667;
  camera.pattern_gain_db = 12;
  camera.white_balance_red = 1.75;
  camera.white_balance_blue = 2.25;
  camera.response = AravisResponse::srgb;
  camera.region = {.x = 16, .y = 8, .width = 96, .height = 64};
  camera.pixel_format = "BayerGR8";
  camera.trigger_line = "Line2";
  camera.activation = AravisActivation::falling_edge;
  camera.trigger_delay_us = 50;
  camera.packet_delay_ns = 2000;
  camera.heartbeat_ms = 4000;
  camera.ptp = true;
  camera.features = {{"AcquisitionFrameRate", "25"}};
  const auto opened = open();
  ASSERT_TRUE(opened);
  EXPECT_EQ(opened->info().width, 96);
  EXPECT_EQ(opened->info().height, 64);
  EXPECT_EQ(opened->info().serial, "VB0");
  EXPECT_EQ(opened->info().model, "VirtualBooth GigE");
  EXPECT_EQ(opened->info().address, "127.0.0.11");
  ASSERT_TRUE(arm(*opened, 1));
  const std::map<std::string, double> wanted{{"ExposureTime", 7500},
                                             {"Gain", 6},
                                             {"BalanceRatioRed", 1.75},
                                             {"BalanceRatioBlue", 2.25},
                                             {"Gamma", 1 / 2.2},
                                             {"OffsetX", 16},
                                             {"OffsetY", 8},
                                             {"Width", 96},
                                             {"Height", 64},
                                             {"TriggerMode", 1},
                                             {"TriggerSource", 2},
                                             {"TriggerActivation", 1},
                                             {"TriggerDelay", 50},
                                             {"GevSCPD", 2000},
                                             {"GevHeartbeatTimeout", 4000},
                                             {"ExposureAuto", 0},
                                             {"GainAuto", 0},
                                             {"BalanceWhiteAuto", 0},
                                             {"PtpEnable", 1},
                                             {"GevSCPSPacketSize", 1500}};
  for (const auto& [name, value] : wanted) EXPECT_NEAR(peer.feature(name), value, 1e-3) << name;
  // Patterns have their own exposure.
  ASSERT_TRUE(opened->arm({.role = ShotRole::gray_code}, 1));
  EXPECT_NEAR(peer.feature("ExposureTime"), 16667, 0.1);
  EXPECT_NEAR(peer.feature("Gain"), 12, 1e-3);
}

TEST_F(AravisSuite, RefusesWhatTheCameraCannotWithItsRange) {
  struct Case {
    std::function<void(AravisCameraSettings&)> ask;
    const char* message;
  };
  const Case cases[] = {
      {[](auto& c) { c.exposure_us = 5; }, "camera cam-0: exposure_us: 5, but the camera's range is 20 … 1000000"},
      {[](auto& c) { c.pattern_exposure_us = 2e6; }, "exposure_us: 2000000, but the camera's range is 20 … 1000000"},
      {[](auto& c) { c.gain_db = 30; }, "camera cam-0: gain_db: 30, but the camera's range is 0 … 24"},
      {[](auto& c) { c.white_balance_red = 0.125; }, "white_balance_red: 0.125, but the camera's range is 0.25 … 8"},
      {[](auto& c) { c.white_balance_blue = 9; }, "white_balance_blue: 9, but the camera's range is 0.25 … 8"},
      {[](auto& c) { c.region.width = 101; }, "region.width: 101, but the camera's range is 16 … 160 in steps of 4"},
      {[](auto& c) { c.region.height = 200; }, "region.height: 200, but the camera's range is 16 … 120 in steps of 2"},
      {[](auto& c) { c.region = {.x = 100, .y = 0, .width = 96, .height = 0}; },
       "region.x: 100, but the camera's range is 0 … 64 in steps of 2"},
      {[](auto& c) { c.region.y = 200; }, "region.height: -80, but the camera's range is 16 … 120"},
      {[](auto& c) { c.trigger_line = "Line7"; },
       "trigger_line: \"Line7\", but the camera offers Line1, Line2, Software, Action0, Action1"},
      {[](auto& c) { c.trigger_selector = "ExposureActive"; },
       "trigger_selector: \"ExposureActive\", but the camera offers FrameStart, AcquisitionStart"},
      {[](auto& c) { c.activation = AravisActivation::level_high; },
       "activation: \"LevelHigh\", but the camera offers RisingEdge, FallingEdge"},
      {[](auto& c) { c.trigger_delay_us = 200'000; }, "trigger_delay_us: 200000, but the camera's range is 0 … 100000"},
      {[](auto& c) { c.trigger = AravisTriggerSource::action, c.action = 9; },
       "action: \"Action9\", but the camera offers"},
      {[](auto& c) {
         c.heartbeat_ms = 60'000, c.features = {{"NoSuchFeature", "1"}};
       },
       "features.NoSuchFeature: the camera has no such feature"},
      {[](auto& c) {
         c.features = {{"Gain", "loud"}};
       },
       "features.Gain: \"loud\", expected a number"},
      {[](auto& c) {
         c.features = {{"GevSCPD", "0.5"}};
       },
       "features.GevSCPD: \"0.5\", expected a whole number"},
      {[](auto& c) {
         c.features = {{"PtpEnable", "yes"}};
       },
       "features.PtpEnable: \"yes\", expected true or false"},
      {[](auto& c) {
         c.features = {{"ExposureMode", "Bulb"}};
       },
       "features.ExposureMode: \"Bulb\", but the camera offers Timed"},
      {[](auto& c) {
         c.features = {{"Width", "64"}};
       },
       "features: Width is 64 after they were set, expected 160"},
      {[](auto& c) { c.packet_size = 1501; }, "packet_size: 1501, but the camera's range is 576 … 9000 in steps of 4"},
      {[](auto& c) { c.packet_size = 9000; }, "packet_size: 9000, but packets of more than 1500 bytes do not pass"},
  };
  add_camera();
  const AravisCameraSettings good = settings.cameras[0];
  for (const Case& one : cases) {
    settings.cameras[0] = good;
    one.ask(settings.cameras[0]);
    source.reset();
    const Error error = refusal();
    EXPECT_EQ(error.code, ErrorCode::invalid_argument) << one.message;
    EXPECT_THAT(error.message, AllOf(HasSubstr("camera cam-0: "), HasSubstr(one.message)));
  }
}

TEST_F(AravisSuite, RefusesAFeatureThatTheCameraHasNot) {
  add_camera({.lacks = "Gamma"});
  settings.cameras[0].response = AravisResponse::srgb;
  EXPECT_EQ(refusal().message, "camera cam-0: response: srgb, but the camera has no Gamma");
  EXPECT_EQ(refusal().code, ErrorCode::unsupported);
}

/// A camera that confirms a setting and goes on as before.
TEST_F(AravisSuite, RefusesAValueThatTheCameraDoesNotKeep) {
  struct Case {
    const char* keeps;
    std::function<void(AravisCameraSettings&)> ask;
    const char* message;
  };
  const Case cases[] = {
      {"ExposureTime", [](auto&) {}, "camera cam-0: exposure_us: 1000, but the camera made it 5000"},
      {"Width", [](auto& c) { c.region.width = 64; }, "camera cam-0: region.width: 64, but the camera made it 160"},
      {"TriggerSource", [](auto& c) { c.trigger_line = "Line2"; },
       "camera cam-0: trigger_line: \"Line2\", but the camera made it \"Line1\""},
      {"PtpEnable", [](auto& c) { c.ptp = true; }, "camera cam-0: ptp: true, but the camera did not take it"}};
  for (const Case& one : cases) {
    source.reset();
    settings.cameras.clear();
    peers.clear();
    add_camera({.keeps = one.keeps});
    one.ask(settings.cameras[0]);
    const Error error = refusal();
    EXPECT_EQ(error.code, ErrorCode::invalid_argument) << one.message;
    EXPECT_EQ(error.message, one.message);
  }
}

/// What is asked for must be there, whatever kind of setting it is.
TEST_F(AravisSuite, NamesTheFeatureThatASettingNeeds) {
  struct Case {
    const char* lacks;
    std::function<void(AravisCameraSettings&)> ask;
    const char* message;
  };
  const Case cases[] = {{"Gain", [](auto& c) { c.gain_db = 3; }, "camera cam-0: gain_db: it has no Gain"},
                        {"PixelFormat", [](auto&) {}, "camera cam-0: pixel_format: it has no PixelFormat"},
                        {"BalanceRatioSelector", [](auto& c) { c.white_balance_red = 2; },
                         "camera cam-0: white_balance_red: it has no BalanceRatioSelector"},
                        {"ActionSelector", [](auto& c) { c.trigger = AravisTriggerSource::action; },
                         "camera cam-0: action: it has no ActionSelector"}};
  for (const Case& one : cases) {
    source.reset();
    settings.cameras.clear();
    peers.clear();
    add_camera({.lacks = one.lacks});
    one.ask(settings.cameras[0]);
    const Error error = refusal();
    EXPECT_EQ(error.code, ErrorCode::unsupported) << one.message;
    EXPECT_EQ(error.message, one.message);
  }
}

TEST_F(AravisSuite, RefusesPtpOfACameraWithout) {
  add_camera({.offers_ptp = false});
  settings.cameras[0].ptp = true;
  const Error error = refusal();
  EXPECT_EQ(error.code, ErrorCode::unsupported);
  EXPECT_EQ(error.message, "camera cam-0: ptp: the camera does not offer it");
}

TEST_F(AravisSuite, SaysWhereNothingAnswers) {
  settings.cameras.push_back(virtual_settings(5));
  settings.cameras.push_back({.id = "cam-6", .serial = "NOT-HERE"});
  settings.cameras.push_back({.id = "cam-7", .address = "no.such.host.invalid"});
  const std::pair<int, const char*> cases[] = {{0, "camera cam-5: nothing answers at address 127.0.0.16"},
                                               {1, "camera cam-6: nothing answers at serial number NOT-HERE"},
                                               {2, "camera cam-7: address: no host is called no.such.host.invalid"}};
  for (const auto& [number, message] : cases) {
    const Error error = refusal(number);
    EXPECT_EQ(error.code, ErrorCode::device_lost);
    EXPECT_EQ(error.message, message);
  }
}

TEST_F(AravisSuite, SaysThatNoNetworkLeadsThere) {
  settings.cameras.push_back({.id = "cam-0", .address = "10.9.8.7"});
  const Error error = refusal();
  EXPECT_EQ(error.code, ErrorCode::device_lost);
  EXPECT_EQ(error.message, "camera cam-0: no network leads to 10.9.8.7: Network is unreachable");
  settings.cameras[0].trigger = AravisTriggerSource::action;
  settings.action.destinations = {"10.9.8.255"};
  create_source();
  const auto trigger = source->open_trigger();
  ASSERT_TRUE(trigger) << trigger.error().message;
  const auto fired = (*trigger)->fire();
  ASSERT_FALSE(fired);
  EXPECT_EQ(fired.error().code, ErrorCode::device_lost);
  EXPECT_EQ(fired.error().message, "the action command cannot be sent: Network is unreachable");
}

TEST_F(AravisSuite, ACameraIsOpenedOnceAndOnlyWhereItIsConfigured) {
  add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  EXPECT_EQ(refusal().message, "camera cam-0 is open already");
  EXPECT_EQ(source->open_camera("other").error().message, "no camera other is configured");
  EXPECT_EQ(source->open_trigger().error().message,
            "every camera is triggered by its line, which another driver pulses");
  EXPECT_EQ(source->open_projector().error().message, "cameras are no projectors");
  EXPECT_EQ(camera->arm({.role = ShotRole::body}, 0).error().message, "camera cam-0: cannot be armed for 0 frames");
  EXPECT_EQ(camera->wait_frame(soon()).error().message, "camera cam-0: is not armed");
  ASSERT_TRUE(arm(*camera, 1));
  EXPECT_EQ(camera->wait_frame(clock.now()).error().message, "camera cam-0: no frame arrived in time");
}

/// The pulse reached the camera, but nobody noted its instant.
TEST_F(AravisSuite, ATriggerWhoseInstantIsUnknownIsNotAnswered) {
  add_camera();
  const auto camera = open();
  ASSERT_TRUE(camera);
  ASSERT_TRUE(arm(*camera, 3));
  camera->note_trigger(0, pulse());
  EXPECT_EQ(camera->wait_frame(soon())->index, 0);
  std::this_thread::sleep_for(std::chrono::milliseconds(400));  // farther from a trigger than any answer may be
  pulse();
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(900)).error().code, ErrorCode::timeout);
  camera->note_trigger(1, pulse());
  const auto frame = camera->wait_frame(soon());
  ASSERT_TRUE(frame) << frame.error().message;
  EXPECT_EQ(frame->index, 1);
  EXPECT_EQ(statistic(*camera, "unwanted_frames"), 1);
}

TEST_F(AravisSuite, WarnsWhenTheKernelCutsTheSocketBuffer) {
  add_camera();
  settings.cameras[0].socket_buffer_kib = 1 << 20;
  ASSERT_TRUE(open());
  ASSERT_EQ(all_warnings().size(), 1u);
  EXPECT_THAT(all_warnings()[0], AllOf(HasSubstr("camera cam-0: socket_buffer_kib: 1048576, but the kernel allows "),
                                       HasSubstr("net.core.rmem_max is raised to 1073741824")));
}

TEST_F(AravisSuite, WarnsWhenAClockLeavesPtp) {
  GigeCamera& peer = add_camera();
  settings.cameras[0].ptp = true;
  const auto camera = open();
  ASSERT_TRUE(camera);
  peer.set_ptp_status("Slave");
  ASSERT_TRUE(arm(*camera, 1));
  EXPECT_EQ(statistic(*camera, "ptp_ready"), 1);
  EXPECT_TRUE(all_warnings().empty());
  peer.set_ptp_status("Faulty");
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(arm(*camera, 1));
  EXPECT_EQ(statistic(*camera, "ptp_ready"), 0);
  ASSERT_EQ(all_warnings().size(), 1u) << "once, not with each shot";
  EXPECT_EQ(all_warnings()[0], "camera cam-0: ptp: its clock does not follow the network's, its state is Faulty");
}

TEST_F(AravisSuite, FindsTheLargestPacketThatPasses) {
  add_camera({.path_mtu = 4000});
  GigeCamera& peer = *peers[0];
  settings.cameras[0].packet_size = 0;
  const auto camera = open();
  ASSERT_TRUE(camera);
  EXPECT_LE(peer.feature("GevSCPSPacketSize"), 4000);
  EXPECT_GT(peer.feature("GevSCPSPacketSize"), 3900);
  ASSERT_TRUE(arm(*camera, 1));
  pulse();
  EXPECT_TRUE(camera->wait_frame(soon()));
}

TEST_F(AravisSuite, RawFramesDevelopToWhatTheSensorSaw) {
  auto scene = std::make_shared<Image>(160, 120, 3);
  for (int y = 0; y < scene->height; ++y)
    for (int x = 0; x < scene->width; ++x) {
      scene->at(x, y, 0) = static_cast<uint8_t>(220 - x);
      scene->at(x, y, 1) = static_cast<uint8_t>(20 + x + y / 2);
      scene->at(x, y, 2) = static_cast<uint8_t>(60 + y);
    }
  add_camera({.scenes = {scene}});
  settings.cameras[0].response = AravisResponse::srgb;
  const std::pair<const char*, BayerPattern> formats[] = {{"BayerRG8", BayerPattern::rggb},
                                                          {"BayerGR8", BayerPattern::grbg},
                                                          {"BayerGB8", BayerPattern::gbrg},
                                                          {"BayerBG8", BayerPattern::bggr}};
  for (const auto& [format, pattern] : formats) {
    settings.cameras[0].pixel_format = format;
    source.reset();
    const auto camera = open();
    ASSERT_TRUE(camera);
    ASSERT_TRUE(arm(*camera, 1));
    pulse();
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->pixels->channels, 1) << "raw on the wire";
    EXPECT_EQ(frame->mosaic, (Mosaic{pattern, false}));
    const auto developed = develop(*frame);
    ASSERT_TRUE(developed);
    for (int y = 2; y < scene->height - 2; ++y)
      for (int x = 2; x < scene->width - 2; ++x)
        for (int c = 0; c < 3; ++c)
          ASSERT_NEAR(developed->pixels->at(x, y, c), scene->at(x, y, c), 1) << format << " " << x << " " << y;
  }
}

TEST_F(AravisSuite, FramesLieWhereTheyWereReceivedAndGoBackThere) {
  add_camera();
  settings.cameras[0].buffers = 2;
  const auto camera = open();
  ASSERT_TRUE(camera);
  std::map<const uint8_t*, int> places;
  for (int i = 0; i < 10; ++i) {
    ASSERT_TRUE(arm(*camera, 1));
    pulse();
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    ++places[frame->pixels->samples.data()];
  }
  EXPECT_EQ(places.size(), 2u) << "the two that were made beforehand, over and over";
  // Held frames are not overwritten: with both in use, the camera has nowhere to put a third.
  ASSERT_TRUE(arm(*camera, 3));
  std::vector<Frame> held;
  std::vector<std::vector<uint8_t>> copies;
  for (int i = 0; i < 2; ++i) {
    pulse();
    auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    copies.push_back(frame->pixels->samples);
    held.push_back(*std::move(frame));
  }
  pulse();
  EXPECT_EQ(camera->wait_frame(clock.now() + milliseconds(300)).error().code, ErrorCode::timeout);
  EXPECT_GT(statistic(*camera, "n_underruns"), 0);
  for (size_t i = 0; i < 2; ++i) EXPECT_EQ(held[i].pixels->samples, copies[i]);
}

TEST_F(AravisSuite, ActionCommandsFireAllAndMissingAcknowledgesAreNamed) {
  GigeCamera& silent = add_camera();
  add_camera();
  settings.action = {.device_key = 7, .group_key = 9, .group_mask = 2, .acknowledge_timeout_ms = 300};
  for (AravisCameraSettings& camera : settings.cameras) camera.trigger = AravisTriggerSource::action;
  settings.cameras[1].action = 1;
  const auto first = open(0), second = open(1);
  ASSERT_TRUE(first && second);
  auto trigger = source->open_trigger();
  ASSERT_TRUE(trigger) << trigger.error().message;
  EXPECT_EQ((*trigger)->driver(), "action");
  ASSERT_TRUE(arm(*first, 2));
  ASSERT_TRUE(arm(*second, 2));
  ASSERT_TRUE((*trigger)->fire());
  EXPECT_TRUE(first->wait_frame(soon()));
  EXPECT_TRUE(second->wait_frame(soon()));
  EXPECT_TRUE(all_warnings().empty());
  EXPECT_EQ(silent.report().exposures, 1u) << "one command, one exposure, by however many networks it came";
  silent.mute(true);
  ASSERT_TRUE((*trigger)->fire()) << "one camera answered";
  EXPECT_TRUE(second->wait_frame(soon()));
  ASSERT_EQ(all_warnings().size(), 1u);
  EXPECT_EQ(all_warnings()[0], "camera cam-0: did not acknowledge the action command");
  peers[1]->mute(true);
  const auto unheard = (*trigger)->fire();
  ASSERT_FALSE(unheard);
  EXPECT_EQ(unheard.error().code, ErrorCode::device_lost);
  EXPECT_EQ(unheard.error().message, "no camera acknowledged the action command");
  for (const auto& peer : peers) peer->mute(false);
}

TEST_F(AravisSuite, AScheduledActionExposesAllAtItsInstant) {
  for (int i = 0; i < 3; ++i) add_camera({.shares_clock = true});
  settings.action = {.schedule_ahead_us = 300'000, .acknowledge_timeout_ms = 5000};
  std::vector<std::unique_ptr<Camera>> cameras;
  for (AravisCameraSettings& camera : settings.cameras) camera.trigger = AravisTriggerSource::action;
  for (int i = 0; i < 3; ++i) {
    cameras.push_back(open(i));
    ASSERT_TRUE(cameras.back() && arm(*cameras.back(), 1));
  }
  auto trigger = source->open_trigger();
  ASSERT_TRUE(trigger) << trigger.error().message;
  const Timestamp asked = clock.now();
  const auto fired = (*trigger)->fire();
  ASSERT_TRUE(fired) << fired.error().message;
  EXPECT_GE(*fired, asked + milliseconds(300));
  for (const auto& camera : cameras) {
    camera->note_trigger(0, *fired);
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    // As exactly as the clocks could be compared, of which two comparisons are in it.
    const auto unsure = static_cast<Timestamp>(3000 * statistic(*camera, "clock_uncertainty_us")) + 100'000;
    EXPECT_NEAR(static_cast<double>(frame->timestamp_ns - *fired), 0, static_cast<double>(unsure));
  }
}

TEST_F(AravisSuite, AnActionIsNotScheduledByClocksThatDoNotAgree) {
  add_camera();
  std::this_thread::sleep_for(std::chrono::milliseconds(300));  // each clock begins when its camera is switched on
  add_camera();
  settings.action = {.schedule_ahead_us = 300'000};
  for (AravisCameraSettings& camera : settings.cameras) camera.trigger = AravisTriggerSource::action;
  const auto first = open(0), second = open(1);
  ASSERT_TRUE(first && second && arm(*first, 1) && arm(*second, 1));
  const auto fired = (*source->open_trigger())->fire();
  ASSERT_FALSE(fired);
  EXPECT_THAT(fired.error().message, AllOf(HasSubstr("action: schedule_ahead_us: the clocks of cam-0 and cam-1 are "),
                                           HasSubstr(" ms apart: they must follow one PTP master")));
}

TEST_F(AravisSuite, AnActionIsNotScheduledByAClockThatCannotBeRead) {
  add_camera({.lacks = "TimestampLatch"});
  settings.action = {.schedule_ahead_us = 300'000};
  settings.cameras[0].trigger = AravisTriggerSource::action;
  const auto camera = open();
  ASSERT_TRUE(camera && arm(*camera, 1));
  const auto fired = (*source->open_trigger())->fire();
  ASSERT_FALSE(fired);
  EXPECT_EQ(fired.error().code, ErrorCode::device_lost);
  EXPECT_EQ(fired.error().message, "action: schedule_ahead_us: no camera's clock can be read to schedule by");
}

TEST_F(AravisSuite, ASoftwareTriggerThatNoCameraTakesIsReported) {
  add_camera({.lacks = "TriggerSoftware"});
  settings.cameras[0].trigger = AravisTriggerSource::software;
  const auto camera = open();
  ASSERT_TRUE(camera && arm(*camera, 1));
  const auto fired = (*source->open_trigger())->fire();
  ASSERT_FALSE(fired);
  EXPECT_EQ(fired.error().code, ErrorCode::device_lost);
  EXPECT_EQ(fired.error().message, "camera cam-0: TriggerSoftware: [TriggerSoftware] Not found");
  EXPECT_THAT(all_warnings(), testing::ElementsAre(fired.error().message));
}

TEST_F(AravisSuite, ACameraThatHangsDelaysNeitherTheOthersNorTheTrigger) {
  GigeCamera& hung = add_camera();
  add_camera();
  for (AravisCameraSettings& camera : settings.cameras) camera.trigger = AravisTriggerSource::software;
  const auto first = open(0), second = open(1);
  ASSERT_TRUE(first && second && arm(*first, 2) && arm(*second, 2));
  auto trigger = source->open_trigger();
  ASSERT_TRUE(trigger) << trigger.error().message;
  hung.mute(true);
  for (int i = 0; i < 2; ++i) {
    const auto fired = (*trigger)->fire();
    ASSERT_TRUE(fired) << fired.error().message;
    second->note_trigger(i, *fired);
    const auto frame = second->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    EXPECT_EQ(frame->index, i);
  }
  EXPECT_THAT(all_warnings(), testing::ElementsAre("camera cam-0: has not confirmed the order to expose"))
      << "it was asked once only";
  // Whoever else stops it does not wait for it either: its control channel is silent for seconds.
  const Timestamp asked = clock.now();
  std::jthread([&] { first->stop(); }).join();
  EXPECT_LT(clock.now() - asked, seconds(1));
  hung.mute(false);
}

TEST_F(AravisSuite, WarningsLastAsLongAsTheirCause) {
  GigeCamera& peer = add_camera({.path_mtu = 1000});
  settings.cameras[0].packet_size = 0;
  settings.cameras[0].ptp = true;
  const auto camera = open();
  ASSERT_TRUE(camera && arm(*camera, 1));
  EXPECT_THAT(camera->warnings(), testing::ElementsAre(HasSubstr("packet_size: packets of more than "),
                                                       HasSubstr("ptp: its clock does not follow the network's")));
  peer.set_ptp_status("Slave");
  ASSERT_TRUE(arm(*camera, 1));
  EXPECT_THAT(camera->warnings(), testing::ElementsAre(HasSubstr("packet_size: ")));
}

TEST_F(AravisSuite, TimestampsFollowAClockOfAnotherRate) {
  add_camera({.tick_frequency = 125'000'000, .clock_error_ppm = 200});
  const auto camera = open();
  ASSERT_TRUE(camera);
  for (int i = 0; i < 5; ++i) {
    ASSERT_TRUE(arm(*camera, 1));
    const Timestamp before = clock.now();
    pulse();
    const auto frame = camera->wait_frame(soon());
    ASSERT_TRUE(frame) << frame.error().message;
    // Never before the trigger, by more than the clocks can be compared, nor after the frame is here.
    const auto unsure = static_cast<Timestamp>(1000 * statistic(*camera, "clock_uncertainty_us")) + milliseconds(1);
    EXPECT_GT(frame->timestamp_ns, before - unsure);
    EXPECT_LT(frame->timestamp_ns, clock.now() + unsure);
    std::this_thread::sleep_for(std::chrono::milliseconds(300));
  }
}

TEST_F(AravisSuite, AllCamerasMayBeOpenedAtOnce) {
  constexpr size_t cameras = 6;
  constexpr int rounds = 3;
  for (size_t i = 0; i < cameras; ++i) add_camera();
  for (int round = 0; round < rounds; ++round) {
    source.reset();
    create_source();
    std::vector<std::string> faults(cameras);
    std::vector<std::jthread> threads;
    for (size_t i = 0; i < cameras; ++i)
      threads.emplace_back([&, i] {
        const auto camera = source->open_camera(settings.cameras[i].id);
        const auto armed = camera ? (*camera)->arm({.role = ShotRole::body}, 1) : Result<void>(camera.error());
        if (!armed) faults[i] = armed.error().message;
      });
    threads.clear();
    for (const std::string& fault : faults) EXPECT_EQ(fault, "");
  }
}

TEST_F(AravisSuite, DiscoversWhoIsThere) {
  add_camera();
  add_camera();
  settings.cameras.pop_back();
  create_source();
  const auto found = source->discover();
  ASSERT_TRUE(found) << found.error().message;
  ASSERT_EQ(found->size(), 2u);
  std::map<std::string, CameraInfo> by_id;
  for (const CameraInfo& info : *found) by_id[info.id] = info;
  EXPECT_EQ(by_id.at("cam-0").serial, "VB0");
  EXPECT_EQ(by_id.at("cam-0").address, "127.0.0.11");
  EXPECT_EQ(by_id.at("VB1").model, "VirtualBooth GigE") << "not configured, so its serial number is its name";
}

}  // namespace
}  // namespace booth
