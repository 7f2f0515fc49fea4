#include "config/booth_config.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <random>
#include <regex>
#include <sstream>

#include "replay/durable_folder.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

const fs::path default_file = BOOTH_SOURCE_DIR "/config/boothd.toml";

std::vector<std::string> faults_of(std::string_view toml) {
  std::vector<std::string> faults;
  for (const ConfigFault& fault : parse_config(toml, "/etc/booth").faults) faults.push_back(fault.to_string());
  return faults;
}

std::string text_of(const fs::path& file) {
  const auto bytes = read_file(file, 1 << 20);
  return bytes ? std::string(bytes->begin(), bytes->end()) : std::string();
}

/// The file with its examples, which are comments that begin without a space, switched on.
std::string with_examples(const std::string& text) {
  return std::regex_replace(text, std::regex("(^|\n)#(?=[a-z\\[])"), "$1");
}

/// "section.key" of every line that sets one.
std::vector<std::string> keys_of(const std::string& text) {
  std::vector<std::string> keys;
  std::string section;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    std::smatch match;
    if (std::regex_search(line, match, std::regex(R"(^\[\[([a-z_.]+)\]\])")))
      section = match[1].str() + "[]";
    else if (std::regex_search(line, match, std::regex(R"(^\[([a-z_.]+)\])")))
      section = match[1].str();
    else if (std::regex_search(line, match, std::regex(R"(^([a-z_]+) = )")))
      keys.push_back(section + "." + match[1].str());
  }
  return keys;
}

TEST(DefaultFile, HoldsEveryKeyAndNoOther) { EXPECT_EQ(keys_of(with_examples(text_of(default_file))), config_keys()); }

TEST(DefaultFile, SaysWhatIsCompiledIn) {
  const auto config = load_config(default_file);
  ASSERT_TRUE(config) << config.error().message;
  EXPECT_EQ(write_config(*config), write_config(BoothConfig{}));
}

TEST(DefaultFile, ItsExampleIsValidAndShowsTheDefaults) {
  const ConfigReading reading = parse_config(with_examples(text_of(default_file)), "/");
  ASSERT_THAT(reading.faults, IsEmpty());
  ASSERT_EQ(reading.config.replay.faults.size(), 1U);
  const ReplayFault& example = reading.config.replay.faults[0];
  const ReplayFault plain;
  EXPECT_EQ(example.kind, plain.kind);
  EXPECT_EQ(example.camera, plain.camera);
  EXPECT_EQ(example.role, plain.role);
  EXPECT_EQ(example.delay_ms, plain.delay_ms);
}

TEST(ParseConfig, ReadsListsOfWords) {
  const ConfigReading reading = parse_config("[export]\nformats = [\"stl\", \"ply\"]\ntexture = \"jpeg\"", "/");
  ASSERT_THAT(reading.faults, IsEmpty());
  EXPECT_THAT(reading.config.files.formats, ElementsAre(MeshFormat::stl, MeshFormat::ply));
  EXPECT_EQ(reading.config.files.texture, ImageFormat::jpeg);
  EXPECT_THAT(write_config(reading.config), HasSubstr("formats = ['stl', 'ply']"));
  EXPECT_THAT(faults_of("[export]\nformats = [\"stl\", \"fbx\", \"stl\"]"),
              ElementsAre("export.formats[1]: \"fbx\", expected one of \"stl\", \"obj\", \"ply\"",
                          "export.formats[2]: \"stl\", expected each word once"));
  EXPECT_THAT(faults_of("[export]\nformats = \"stl\""), ElementsAre(HasSubstr("expected an array of words")));
}

TEST(ParseConfig, NothingIsTheDefault) {
  const ConfigReading reading = parse_config("", "/etc/booth");
  EXPECT_THAT(reading.faults, IsEmpty());
  EXPECT_EQ(write_config(reading.config), write_config(BoothConfig{}));
}

TEST(ParseConfig, TakesWhatIsSet) {
  const ConfigReading reading = parse_config(R"(
      [booth]
      name = "Stand 7 „Süd“"
      state_directory = "state"
      [api]
      control = "ipc:///tmp/c"
      [capture]
      frame_timeout_ms = 1500
      image_format = "jpeg"
      keep_encoded = false
      [jobs]
      workers = 3
      [log]
      level = "debug"
      [replay]
      recording = "../demo/man"
      pace = "fast"
      cache_mib = 0
      [[replay.faults]]
      kind = "late"
      camera = "body-03"
      delay_ms = 250
      [[replay.faults]]
      kind = "lost"
      role = "gray_code"
      index = 4
      capture = 2
      [reconstruct]
      face = "none"
      triangles = 5000
      voxel_mm = 8
      )",
                                             "/etc/booth");
  for (const ConfigFault& fault : reading.faults) ADD_FAILURE() << fault.to_string();
  const BoothConfig& config = reading.config;
  EXPECT_EQ(config.booth.name, "Stand 7 „Süd“");
  EXPECT_EQ(config.booth.avatars(), "/etc/booth/state/avatars");
  EXPECT_EQ(config.api.control, "ipc:///tmp/c");
  EXPECT_EQ(config.api.events, ApiConfig{}.events);
  EXPECT_EQ(config.capture.frame_timeout_ms, 1500);
  EXPECT_EQ(config.capture.images.format, SpoolOptions::Format::jpeg);
  EXPECT_FALSE(config.capture.images.keep_encoded);
  EXPECT_EQ(config.jobs.workers, 3);
  EXPECT_EQ(config.log.level, LogLevel::debug);
  EXPECT_EQ(config.replay.recording, "/etc/demo/man");
  EXPECT_EQ(config.replay.pace, ReplayOptions::Pace::fast);
  EXPECT_EQ(config.replay.cache_mib, 0U);
  ASSERT_EQ(config.replay.faults.size(), 2U);
  EXPECT_EQ(config.replay.faults[0].kind, ReplayFault::Kind::late);
  EXPECT_EQ(config.replay.faults[0].camera, "body-03");
  EXPECT_EQ(config.replay.faults[0].delay_ms, 250);
  EXPECT_EQ(config.replay.faults[0].role, std::nullopt);
  EXPECT_EQ(config.replay.faults[1].role, ShotRole::gray_code);
  EXPECT_EQ(config.replay.faults[1].index, 4);
  EXPECT_EQ(config.replay.faults[1].capture, 2);
  EXPECT_EQ(config.reconstruct.face, FaceMode::none);
  EXPECT_EQ(config.reconstruct.decimation.triangles, 5000U);
  EXPECT_DOUBLE_EQ(config.reconstruct.hull.voxel_m, 0.008);

  const ConfigReading again = parse_config(write_config(config), "/elsewhere");
  EXPECT_THAT(again.faults, IsEmpty());
  EXPECT_EQ(write_config(again.config), write_config(config));
}

constexpr const char* mixture = R"(
      [[cameras]]
      id = "body-00"
      driver = "aravis"
      address = "192.168.7.10"
      exposure_us = 8000
      white_balance_red = 1.5
      trigger = "action"
      action = 2
      features = ["LineDebouncerTime=50", "UserSetDefault=Default=1"]
      [[cameras]]
      id = "face-left"
      driver = "v4l2"
      role = "face"
      mount_rotation = "270"
      bus = "usb-0000:00:14.0-2"
      gain = 7
      controls = ["power_line_frequency=1"]
      [[cameras]]
      id = "body-03"
      driver = "replay"
      [trigger]
      driver = "aravis"
      [trigger.gpio]
      chip = "gpio-sim"
      line = "4"
      lights_chip = "gpio-sim"
      lights_line = "5"
      lit = ["body"]
      [trigger.action]
      group_mask = 4294967295
      destinations = ["192.168.7.255"]
      [projector]
      driver = "display"
      [projector.display]
      width = 1024
      height = 768
      delay_us = 42000
      )";

TEST(ParseConfig, MixesDriversFreely) {
  const ConfigReading reading = parse_config(mixture, "/etc/booth");
  for (const ConfigFault& fault : reading.faults) ADD_FAILURE() << fault.to_string();
  const BoothConfig& config = reading.config;
  ASSERT_EQ(config.cameras.size(), 3U);
  const auto* aravis = std::get_if<AravisCameraSettings>(&config.cameras[0].driver);
  ASSERT_NE(aravis, nullptr);
  EXPECT_EQ(aravis->id, "body-00");
  EXPECT_EQ(aravis->address, "192.168.7.10");
  EXPECT_EQ(aravis->exposure_us, 8000);
  EXPECT_EQ(aravis->white_balance_red, 1.5);
  EXPECT_EQ(aravis->white_balance_blue, std::nullopt);
  EXPECT_EQ(aravis->trigger, AravisTriggerSource::action);
  ASSERT_EQ(aravis->features.size(), 2U);
  EXPECT_EQ(aravis->features[0].name, "LineDebouncerTime");
  EXPECT_EQ(aravis->features[1].value, "Default=1");
  const auto* v4l2 = std::get_if<V4l2CameraSettings>(&config.cameras[1].driver);
  ASSERT_NE(v4l2, nullptr);
  EXPECT_EQ(v4l2->role, CameraRole::face);
  EXPECT_EQ(config.cameras[1].mount_rotation_deg, 270);
  EXPECT_EQ(v4l2->gain, 7);
  EXPECT_EQ(v4l2->controls.at("power_line_frequency"), 1);
  EXPECT_EQ(driver_name(config.cameras[2]), "replay");
  ASSERT_TRUE(config.trigger.gpio.lights);
  EXPECT_EQ(config.trigger.gpio.lights->line, "5");
  EXPECT_THAT(config.trigger.gpio.lit_roles, ElementsAre(ShotRole::body));
  EXPECT_EQ(config.trigger.action.group_mask, 4294967295U);
  EXPECT_EQ(config.projector.display.delay_us, 42000);
  const auto [gige, usb] = live_cameras(config);
  EXPECT_EQ(gige.cameras.size(), 1U);
  EXPECT_EQ(gige.action.destinations, std::vector<std::string>{"192.168.7.255"});
  EXPECT_EQ(usb.cameras.size(), 1U);

  const ConfigReading again = parse_config(write_config(config), "/elsewhere");
  for (const ConfigFault& fault : again.faults) ADD_FAILURE() << fault.to_string();
  EXPECT_EQ(write_config(again.config), write_config(config));
}

TEST(ParseConfig, ChecksEveryDriversKeys) {
  EXPECT_THAT(faults_of("[[cameras]]\nid = \"a\"\ndriver = \"v4l2\"\nserial = \"1\"\npacket_size = 1\n"),
              ElementsAre(AllOf(HasSubstr("cameras[0].packet_size: 1, expected one of the keys id, driver"))));
  EXPECT_THAT(faults_of("[[cameras]]\nid = \"a\"\ndriver = \"usb\"\n"),
              ElementsAre("cameras[0].driver: \"usb\", expected one of \"replay\", \"aravis\", \"v4l2\""));
  EXPECT_THAT(faults_of("[[cameras]]\nid = \"../x\"\n"),
              ElementsAre(HasSubstr("cameras[0].id: \"../x\", expected an id")));
  EXPECT_THAT(faults_of("[[cameras]]\ndriver = \"replay\"\n"), ElementsAre("cameras[0].id: missing, expected an id"));
  EXPECT_THAT(faults_of("[[cameras]]\nid = \"a\"\n[[cameras]]\nid = \"a\"\n"),
              ElementsAre(HasSubstr("cameras[1].id: \"a\", expected an id that no other camera has")));
  EXPECT_THAT(faults_of("[[cameras]]\nid = \"a\"\ndriver = \"aravis\"\nserial = \"1\"\nexposure_us = 0\n"
                        "mount_rotation = 90\nfeatures = [\"x\"]\n"),
              ElementsAre(HasSubstr("cameras[0].mount_rotation: 90, expected one of"),
                          HasSubstr("cameras[0].exposure_us: 0, expected 1 … 10000000"),
                          HasSubstr("cameras[0].features: an array, expected an array of texts NAME=VALUE")));
  EXPECT_THAT(faults_of("[[cameras]]\nid = \"a\"\ndriver = \"v4l2\"\ndevice = \"/dev/video0\"\n"
                        "controls = [\"gain=much\"]\n"),
              ElementsAre(HasSubstr("cameras[0].controls")));
}

TEST(ParseConfig, TriggersAndProjectorsMustFitTheCameras) {
  const std::string usb = "[[cameras]]\nid = \"a\"\ndriver = \"v4l2\"\ndevice = \"/dev/video0\"\n";
  EXPECT_THAT(faults_of(usb), ElementsAre("trigger.driver: \"replay\", expected another one: no camera is replayed",
                                          HasSubstr("projector.driver: \"replay\"")));
  EXPECT_THAT(faults_of(usb + "[trigger]\ndriver = \"none\"\n[projector]\ndriver = \"none\"\n"), IsEmpty());
  EXPECT_THAT(faults_of(usb + "[trigger]\ndriver = \"aravis\"\n[projector]\ndriver = \"none\"\n"),
              ElementsAre(HasSubstr("no camera has the trigger software or action")));
  EXPECT_THAT(faults_of(usb + "[trigger]\ndriver = \"gpio\"\n[projector]\ndriver = \"none\"\n"),
              ElementsAre(HasSubstr("trigger.gpio: ")));

  const auto gige = [](const std::string& id, const std::string& trigger) {
    return "[[cameras]]\nid = \"" + id + "\"\ndriver = \"aravis\"\nserial = \"" + id + "\"\ntrigger = \"" + trigger +
           "\"\n[projector]\ndriver = \"none\"\n";
  };
  const std::string other = "[[cameras]]\nid = \"b\"\ndriver = \"aravis\"\nserial = \"b\"\ntrigger = ";
  const std::string orders = "[trigger]\ndriver = \"aravis\"\n";
  EXPECT_THAT(faults_of(orders + gige("a", "action") + other + "\"action\"\n"), IsEmpty());
  EXPECT_THAT(faults_of(orders + gige("a", "action") + other + "\"line\"\n"),
              ElementsAre("trigger.driver: \"aravis\", expected the trigger software or action of every camera, not "
                          "\"line\""));
  EXPECT_THAT(
      faults_of(orders + gige("a", "action") + other + "\"software\"\n"),
      ElementsAre("trigger.driver: \"aravis\", expected one trigger for all cameras, either software or action"));
  EXPECT_THAT(faults_of("[trigger]\ndriver = \"none\"\n" + gige("a", "software")),
              ElementsAre("trigger.driver: another than \"aravis\", expected the trigger \"line\" of every camera: "
                          "software and action are for \"aravis\""));
}

TEST(ParseConfig, ReportsEveryFaultWithItsPathValueAndWhatWouldDo) {
  EXPECT_THAT(
      faults_of(R"(
      colour = "red"
      log = 3
      [booth]
      name = ""
      [capture]
      frame_timeout_ms = 0
      min_cameras = "many"
      image_format = "tiff"
      jpeg_qualty = 90
      keep_encoded = 1
      [disk]
      limit_mib = -5
      [jobs]
      workers = 2.5
      [trigger]
      driver = "webcam"
      [replay]
      recording = 7
      faults = [{kind = "late"}, 3, {kind = "slow", index = -1, when = "now"}]
      [reconstruct]
      voxel_mm = nan
      triangles = 9999999999999
      )"),
      testing::UnorderedElementsAre(
          "colour: \"red\", expected one of the keys booth, api, capture, background, disk, jobs, log, cameras, "
          "trigger, "
          "projector, replay, "
          "face, reconstruct, export",
          "log: 3, expected a table: [log]", "booth.name: \"\", expected a text of 1 … 64 bytes on one line",
          "capture.frame_timeout_ms: 0, expected 50 … 60000",
          "capture.min_cameras: \"many\", expected a whole number, 1 … 256",
          "capture.image_format: \"tiff\", expected one of \"png\", \"jpeg\"",
          "capture.jpeg_qualty: 90, expected one of the keys frame_timeout_ms, retries, max_skew_ms, min_cameras, "
          "background_frames, "
          "image_format, png_level, jpeg_quality, keep_encoded",
          "capture.keep_encoded: 1, expected true or false", "disk.limit_mib: -5, expected 0 … 100000000",
          "jobs.workers: 2.5, expected a whole number, 1 … 64",
          "trigger.driver: \"webcam\", expected one of \"replay\", \"gpio\", \"aravis\", \"none\"",
          "replay.recording: 7, expected a path", "replay.faults[1]: 3, expected a table",
          "replay.faults[2].kind: \"slow\", expected one of \"missing\", \"late\", \"corrupt\", \"lost\"",
          "replay.faults[2].index: -1, expected 0 … 1000000",
          "replay.faults[2].when: \"now\", expected one of the keys kind, camera, role, index, capture, delay_ms",
          "reconstruct.voxel_mm: nan, expected 1 … 50",
          "reconstruct.triangles: 9999999999999, expected 500 … 1000000"));
}

TEST(ParseConfig, EndpointsAreLocalAndDifferent) {
  for (const char* endpoint :
       {"tcp://0.0.0.0:5555", "tcp://*:1", "tcp://booth.local:65535", "tcp://[fe80::1%eth0]:7411"})
    EXPECT_THAT(faults_of("[api]\nremote_control = \"" + std::string(endpoint) + "\""), IsEmpty()) << endpoint;
  for (const char* endpoint :
       {"tcp://", "tcp://1.2.3.4", "tcp://1.2.3.4:0", "tcp://1.2.3.4:65536", "tcp://a b:5", "udp://1.2.3.4:5"})
    EXPECT_THAT(faults_of("[api]\ncontrol = \"" + std::string(endpoint) + "\""),
                ElementsAre(AllOf(HasSubstr("api.control"), HasSubstr(endpoint), HasSubstr("tcp://ADDRESS:PORT"))));
  EXPECT_THAT(faults_of("[api]\nremote_events = \"ipc:///run/x\""), ElementsAre(HasSubstr("api.remote_events")));
  EXPECT_THAT(faults_of("[api]\nremote_control = \"tcp://*:1\"\nremote_events = \"tcp://*:1\""),
              ElementsAre(HasSubstr("api.remote_events")));
  for (const char* bad : {"", "ipc://", "ipc://relative", "udp://x", "/run/booth/control"})
    EXPECT_THAT(faults_of("[api]\nevents = \"" + std::string(bad) + "\""), ElementsAre(HasSubstr("ipc:///PATH")))
        << bad;
  EXPECT_THAT(faults_of("[api]\nevents = \"ipc:///" + std::string(200, 'x') + "\""), ElementsAre(HasSubstr("107")));
  EXPECT_THAT(faults_of("[api]\nevents = \"ipc:///a\"\ncontrol = \"ipc:///a\""),
              ElementsAre(HasSubstr("not used twice")));
}

TEST(ParseConfig, SaysWhereTheTextStopsBeingToml) {
  EXPECT_THAT(faults_of("[booth]\nname = = 3\n"), ElementsAre(AllOf(testing::StartsWith("line 2, column "),
                                                                    HasSubstr("is not TOML"), Not(HasSubstr("\n")))));
  EXPECT_THAT(faults_of("[jobs]\nworkers = 1\nworkers = 2\n"), ElementsAre(HasSubstr("is not TOML")));
  EXPECT_THAT(faults_of(std::string(100000, '[')), ElementsAre(HasSubstr("is not TOML")));
  EXPECT_THAT(faults_of("\xff\xfe"), ElementsAre(HasSubstr("is not TOML")));
}

TEST(ParseConfig, AnyDamageGivesOneLineAFault) {
  const std::string whole = with_examples(text_of(default_file));
  std::mt19937 random(3);
  for (int round = 0; round < 500; ++round) {
    std::string damaged = whole;
    for (int i = 0; i <= round % 5; ++i) damaged[random() % damaged.size()] = static_cast<char>(random());
    if (round % 3 == 0) damaged.resize(random() % damaged.size());
    for (const std::string& fault : faults_of(damaged)) {
      EXPECT_THAT(fault, Not(HasSubstr("\n")));
      EXPECT_LT(fault.size(), 600U);
    }
  }
}

TEST(LoadConfig, NamesTheFileInEveryLine) {
  const ScratchFolder scratch;
  const fs::path file = scratch.path() / "boothd.toml";
  EXPECT_EQ(load_config(file).error().code, ErrorCode::not_found);
  EXPECT_THAT(load_config(file).error().message, HasSubstr(file.string()));
  std::ofstream(file) << "[jobs]\nworkers = 0\nretries = 99\n[replay]\nrecording = \"rec\"\n";
  const auto refused = load_config(file);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::invalid_file);
  EXPECT_EQ(refused.error().message, file.string() + ": jobs.workers: 0, expected 1 … 64\n" + file.string() +
                                         ": jobs.retries: 99, expected 0 … 10");
  std::ofstream(file) << "[replay]\nrecording = \"rec\"\n";
  EXPECT_EQ(load_config(file)->replay.recording, scratch.path() / "rec");
}

}  // namespace
}  // namespace booth
