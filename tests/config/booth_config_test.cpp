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
      keys.push_back(section + (section.empty() ? "" : ".") + match[1].str());
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
      head_start = false
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
  EXPECT_FALSE(config.jobs.head_start);
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

/// A value that will not do, and what is said that would.
struct BadValue {
  std::string key;    ///< as config_keys() has it
  std::string with;   ///< the driver of a camera
  std::string value;  ///< as TOML
  std::string expected;
};

std::vector<BadValue> bad_values() {
  const std::string short_text = "a text of at most 64 bytes on one line",
                    path = "a text of at most 4000 bytes on one line";
  const std::string some_text = "a text of 1 … 64 bytes on one line", truth = "true or false";
  const std::string id = "an id: 1 … 64 letters, digits, '-', '_' and '.', not beginning with '.'";
  const std::string level = "one of \"high\", \"low\"", pattern_side = "0 … 16384";
  const std::string formats = "one of \"Mono8\", \"BayerRG8\", \"BayerGR8\", \"BayerGB8\", \"BayerBG8\", \"RGB8\"";
  const std::string usb_formats =
      "one of \"auto\", \"mjpg\", \"yuyv\", \"grey\", \"rggb\", \"grbg\", \"gbrg\", \"bggr\"";
  const std::string edges = "one of \"rising_edge\", \"falling_edge\", \"any_edge\", \"level_high\", \"level_low\"";
  return {
      {"capture.frame_timeout_ms", "", "49", "50 … 60000"},
      {"capture.retries", "", "6", "0 … 5"},
      {"capture.max_skew_ms", "", "0", "1 … 60000"},
      {"capture.min_cameras", "", "0", "1 … 256"},
      {"capture.background_frames", "", "101", "1 … 100"},
      {"capture.image_format", "", "\"tiff\"", "one of \"png\", \"jpeg\""},
      {"capture.png_level", "", "10", "0 … 9"},
      {"capture.jpeg_quality", "", "0", "1 … 100"},
      {"capture.keep_encoded", "", "1", truth},
      {"cameras[].id", "replay", "\"a b\"", id},
      {"cameras[].id", "aravis", "\".a\"", id},
      {"cameras[].id", "v4l2", "7", id},
      {"cameras[].driver", "", "\"usb\"", "one of \"replay\", \"aravis\", \"v4l2\""},
      {"cameras[].driver", "", "3", "one of \"replay\", \"aravis\", \"v4l2\""},
      {"cameras[].driver", "", "\"\"", "one of \"replay\", \"aravis\", \"v4l2\""},
      {"cameras[].role", "replay", "\"head\"", "one of \"body\", \"face\""},
      {"cameras[].role", "aravis", "\"head\"", "one of \"body\", \"face\""},
      {"cameras[].role", "v4l2", "\"head\"", "one of \"body\", \"face\""},
      {"cameras[].mount_rotation", "replay", "90", "one of \"0\", \"90\", \"180\", \"270\""},
      {"cameras[].mount_rotation", "aravis", "\"45\"", "one of \"0\", \"90\", \"180\", \"270\""},
      {"cameras[].mount_rotation", "v4l2", "\"45\"", "one of \"0\", \"90\", \"180\", \"270\""},
      {"cameras[].serial", "aravis", "12345", short_text},
      {"cameras[].address", "aravis", "[\"10.0.0.1\"]", short_text},
      {"cameras[].exposure_us", "aravis", "0.5", "1 … 10000000"},
      {"cameras[].gain_db", "aravis", "-1", "0 … 60"},
      {"cameras[].pattern_exposure_us", "aravis", "20000000.0", "1 … 10000000"},
      {"cameras[].pattern_gain_db", "aravis", "61", "0 … 60"},
      {"cameras[].white_balance_red", "aravis", "0", "0.1 … 16"},
      {"cameras[].white_balance_blue", "aravis", "nan", "0.1 … 16"},
      {"cameras[].response", "aravis", "\"log\"", "one of \"linear\", \"srgb\""},
      {"cameras[].pixel_format", "aravis", "\"Mono10\"", formats},
      {"cameras[].region_x", "aravis", "-2", "0 … 65535"},
      {"cameras[].region_y", "aravis", "65536", "0 … 65535"},
      {"cameras[].region_width", "aravis", "-1", "0 … 65535"},
      {"cameras[].region_height", "aravis", "70000", "0 … 65535"},
      {"cameras[].trigger", "aravis", "\"stream\"", "one of \"line\", \"software\", \"action\""},
      {"cameras[].trigger_line", "aravis", "\"\"", some_text},
      {"cameras[].trigger_selector", "aravis", "1", some_text},
      {"cameras[].activation", "aravis", "\"rising\"", edges},
      {"cameras[].trigger_delay_us", "aravis", "-1", "0 … 1000000"},
      {"cameras[].action", "aravis", "32", "0 … 31"},
      {"cameras[].preview_fps", "aravis", "0", "1 … 60"},
      {"cameras[].packet_size", "aravis", "16385", "0 … 16384"},
      {"cameras[].packet_delay_ns", "aravis", "-1", "0 … 1000000000"},
      {"cameras[].packet_resend", "aravis", "\"yes\"", truth},
      {"cameras[].resend_ratio", "aravis", "1.5", "0 … 1"},
      {"cameras[].packet_timeout_ms", "aravis", "0", "1 … 1000"},
      {"cameras[].frame_retention_ms", "aravis", "0", "1 … 10000"},
      {"cameras[].socket_buffer_kib", "aravis", "63", "64 … 1048576"},
      {"cameras[].packet_socket", "aravis", "0", truth},
      {"cameras[].buffers", "aravis", "257", "0 … 256"},
      {"cameras[].heartbeat_ms", "aravis", "1999", "2000 … 60000"},
      {"cameras[].ptp", "aravis", "\"on\"", truth},
      {"cameras[].features", "aravis", "[\"Gain\"]", "an array of texts NAME=VALUE"},
      {"cameras[].device", "v4l2", "0", path},
      {"cameras[].serial", "v4l2", "12345", short_text},
      {"cameras[].bus", "v4l2", "false", short_text},
      {"cameras[].format", "v4l2", "\"h264\"", usb_formats},
      {"cameras[].width", "v4l2", "-1", "0 … 65535"},
      {"cameras[].height", "v4l2", "65536", "0 … 65535"},
      {"cameras[].fps", "v4l2", "1001", "0 … 1000"},
      {"cameras[].exposure_us", "v4l2", "99", "100 … 10000000"},
      {"cameras[].gray_code_exposure_us", "v4l2", "10000001", "100 … 10000000"},
      {"cameras[].gain", "v4l2", "-1", "0 … 1000000"},
      {"cameras[].white_balance_k", "v4l2", "999", "1000 … 20000"},
      {"cameras[].focus", "v4l2", "1000001", "0 … 1000000"},
      {"cameras[].controls", "v4l2", "[\"gain=much\"]", "an array of texts NAME=VALUE"},
      {"cameras[].trigger", "v4l2", "\"software\"", "one of \"stream\", \"line\""},
      {"cameras[].buffers", "v4l2", "1", "2 … 32"},
      {"cameras[].warm_up_frames", "v4l2", "101", "0 … 100"},
      {"cameras[].latency_us", "v4l2", "-1", "0 … 1000000"},
      {"cameras[].max_offset_ms", "v4l2", "0", "1 … 60000"},
      {"trigger.driver", "", "\"usb\"", "one of \"replay\", \"gpio\", \"aravis\", \"none\""},
      {"trigger.gpio.chip", "", "0", path},
      {"trigger.gpio.line", "", "4", short_text},
      {"trigger.gpio.active", "", "1", level},
      {"trigger.gpio.pulse_us", "", "9", "10 … 100000"},
      {"trigger.gpio.lights_chip", "", "0", path},
      {"trigger.gpio.lights_line", "", "5", short_text},
      {"trigger.gpio.lights_active", "", "\"on\"", level},
      {"trigger.gpio.lights_lead_us", "", "-1", "0 … 1000000"},
      {"trigger.gpio.lights_hold_us", "", "1000001", "0 … 1000000"},
      {"trigger.gpio.lit", "", "\"body\"",
       "an array of words, each one of \"background\", \"body\", \"gray_code\", \"calibration_board\""},
      {"trigger.action.device_key", "", "-1", "0 … 4294967295"},
      {"trigger.action.group_key", "", "4294967296", "0 … 4294967295"},
      {"trigger.action.group_mask", "", "0", "1 … 4294967295"},
      {"trigger.action.destinations", "", "\"10.0.0.255\"", "an array of at most 64 texts of 1 … 64 bytes"},
      {"trigger.action.schedule_ahead_us", "", "1000001", "0 … 1000000"},
      {"trigger.action.acknowledge_timeout_ms", "", "0", "1 … 10000"},
      {"projector.driver", "", "\"hdmi\"", "one of \"replay\", \"display\", \"gpio\", \"none\""},
      {"projector.gpio.id", "", "\"\"", id},
      {"projector.gpio.pattern_width", "", "16385", pattern_side},
      {"projector.gpio.pattern_height", "", "-1", pattern_side},
      {"projector.gpio.pattern_columns", "", "1", truth},
      {"projector.gpio.pattern_rows", "", "1", truth},
      {"projector.gpio.pattern_inverse", "", "1", truth},
      {"projector.gpio.step_chip", "", "0", path},
      {"projector.gpio.step_line", "", "2", short_text},
      {"projector.gpio.step_active", "", "true", level},
      {"projector.gpio.reset_chip", "", "0", path},
      {"projector.gpio.reset_line", "", "3", short_text},
      {"projector.gpio.reset_active", "", "true", level},
      {"projector.gpio.pulse_us", "", "100001", "10 … 100000"},
      {"projector.gpio.pause_us", "", "9", "10 … 1000000"},
      {"projector.gpio.settle_us", "", "-1", "0 … 1000000"},
      {"projector.display.id", "", "\"a/b\"", id},
      {"projector.display.card", "", "0", path},
      {"projector.display.connector", "", "1", short_text},
      {"projector.display.width", "", "16385", pattern_side},
      {"projector.display.height", "", "-1", pattern_side},
      {"projector.display.refresh_hz", "", "1001", "0 … 1000"},
      {"projector.display.pattern_width", "", "-1", pattern_side},
      {"projector.display.pattern_height", "", "1.5", "a whole number, 0 … 16384"},
      {"projector.display.pattern_columns", "", "1", truth},
      {"projector.display.pattern_rows", "", "1", truth},
      {"projector.display.pattern_inverse", "", "1", truth},
      {"projector.display.delay_us", "", "1000001", "0 … 1000000"},
      {"projector.display.brightness", "", "0", "0.01 … 1"},
      {"projector.display.gamma", "", "0.5", "1 … 4"},
  };
}

TEST(ParseConfig, EverySettingOfTheDevicesSaysWhatItExpects) {
  std::vector<std::string> tried;
  for (const BadValue& bad : bad_values()) {
    tried.push_back(bad.key);
    const size_t dot = bad.key.rfind('.');
    const std::string key = bad.key.substr(dot + 1);
    std::string section = "[" + bad.key.substr(0, dot) + "]\n", where = bad.key;
    if (bad.key.starts_with("cameras[]")) {
      section = "[[cameras]]\n";
      where = "cameras[0]." + key;
      if (!bad.with.empty()) section += "driver = \"" + bad.with + "\"\n";
      if (key != "id") section += "id = \"a\"\n";
    }
    EXPECT_THAT(faults_of(section + key + " = " + bad.value + "\n"),
                ElementsAre(where + ": " + (bad.value.starts_with("[") ? "an array" : bad.value) + ", expected " +
                            bad.expected));
  }
  std::vector<std::string> all;
  for (const std::string& key : config_keys())
    for (const char* section : {"capture.", "cameras[].", "trigger.", "projector."})
      if (key.starts_with(section)) all.push_back(key);
  std::sort(all.begin(), all.end());
  std::sort(tried.begin(), tried.end());
  EXPECT_EQ(tried, all) << "a camera's keys once for each driver that has them";
}

/// What is wrong only together with another setting.
TEST(ParseConfig, SettingsThatDoNotGoTogetherAreNamed) {
  const std::string none = "[projector]\ndriver = \"none\"\n[trigger]\ndriver = \"none\"\n";
  const auto aravis = [&](const std::string& keys) {
    return faults_of(none + "[[cameras]]\nid = \"a\"\ndriver = \"aravis\"\n" + keys);
  };
  EXPECT_THAT(aravis(""),
              ElementsAre("cameras: camera a: serial: \"\" with address \"\", expected either a serial number "
                          "or an address"));
  EXPECT_THAT(
      aravis("serial = \"1\"\naddress = \"10.0.0.1\""),
      ElementsAre("cameras: camera a: serial: \"1\" with address \"10.0.0.1\", expected either a serial number or "
                  "an address"));
  EXPECT_THAT(aravis("serial = \"1\"\npacket_size = 100"),
              ElementsAre("cameras: camera a: packet_size: 100, expected 576 … 16384"));
  EXPECT_THAT(aravis("serial = \"1\"\nbuffers = 1"), ElementsAre("cameras: camera a: buffers: 1, expected 2 … 256"));
  EXPECT_THAT(aravis("serial = \"1\"\ntrigger_line = \"Line 1\""),
              ElementsAre("cameras: camera a: trigger_line: \"Line 1\", expected a line's name such as Line1"));
  EXPECT_THAT(aravis("serial = \"1\"\ntrigger_selector = \"Frame Start\""),
              ElementsAre("cameras: camera a: trigger_selector: \"Frame Start\", expected a trigger's name such as "
                          "FrameStart"));
  EXPECT_THAT(
      aravis("serial = \"1\"\nfeatures = [\"Line Debouncer=1\"]"),
      ElementsAre("cameras: camera a: features: \"Line Debouncer\", expected a feature's name of letters, digits "
                  "and '_'"));
  EXPECT_THAT(aravis("serial = \"1\"\n[[cameras]]\nid = \"b\"\ndriver = \"aravis\"\nserial = \"1\""),
              ElementsAre("cameras: camera b: serial: serial 1, expected a device that no other camera is"));
  const std::string action =
      "[projector]\ndriver = \"none\"\n[[cameras]]\nid = \"a\"\ndriver = \"aravis\"\nserial = "
      "\"1\"\ntrigger = \"action\"\n[trigger]\ndriver = \"aravis\"\n[trigger.action]\n";
  EXPECT_THAT(faults_of(action + "destinations = []"),
              ElementsAre("cameras: action: destinations: 0 of them, expected 1 … 64"));
  EXPECT_THAT(faults_of(action + "schedule_ahead_us = 999"),
              ElementsAre("cameras: action: schedule_ahead_us: 999, expected 1000 … 1000000"));

  const auto v4l2 = [&](const std::string& keys) {
    return faults_of(none + "[[cameras]]\nid = \"a\"\ndriver = \"v4l2\"\n" + keys);
  };
  EXPECT_THAT(v4l2(""), ElementsAre("cameras: a: exactly one of device, serial and bus must be set"));
  EXPECT_THAT(v4l2("bus = \"usb-1\"\nserial = \"1\""),
              ElementsAre("cameras: a: exactly one of device, serial and bus must be set"));
  EXPECT_THAT(v4l2("serial = \"1\"\nwidth = 640"), ElementsAre("cameras: a: width and height must be set together"));
  EXPECT_THAT(v4l2("serial = \"1\"\nexposure_us = 150"),
              ElementsAre("cameras: a: exposure_us is 150, expected a multiple of 100 in 100 … 10000000"));
  EXPECT_THAT(v4l2("serial = \"1\"\ngray_code_exposure_us = 150"),
              ElementsAre("cameras: a: gray_code_exposure_us is 150, expected a multiple of 100 in 100 … 10000000"));

  const auto trigger = [](const std::string& keys) {
    return faults_of("[trigger]\ndriver = \"gpio\"\n[trigger.gpio]\n" + keys);
  };
  EXPECT_THAT(trigger("line = \"4\""), ElementsAre("trigger.gpio: gpio.trigger: chip is empty, expected a GPIO chip"));
  EXPECT_THAT(trigger("chip = \"0\""),
              ElementsAre("trigger.gpio: gpio.trigger: line is empty, expected its offset or its name"));
  EXPECT_THAT(trigger("chip = \"0\"\nline = \"4\"\nlights_line = \"5\""),
              ElementsAre("trigger.gpio: gpio.lights: chip is empty, expected a GPIO chip"));
  EXPECT_THAT(trigger("chip = \"0\"\nline = \"4\"\nlights_chip = \"0\"\nlights_line = \"4\""),
              ElementsAre("trigger.gpio: gpio.trigger and gpio.lights are both line 4 of 0"));

  const auto stepped = [](const std::string& keys) {
    return faults_of("[projector]\ndriver = \"gpio\"\n[projector.gpio]\nstep_chip = \"0\"\nstep_line = \"1\"\n" + keys);
  };
  EXPECT_THAT(stepped(""), ElementsAre("projector.gpio: projector.reset: chip is empty, expected a GPIO chip"));
  EXPECT_THAT(stepped("reset_chip = \"0\"\nreset_line = \"1\""),
              ElementsAre("projector.gpio: projector.step and projector.reset are both line 1 of 0"));
  EXPECT_THAT(stepped("reset_chip = \"0\"\nreset_line = \"2\"\npattern_width = 0"),
              ElementsAre("projector.gpio: projector: width is 0, expected 1 … 16384"));

  const auto display = [](const std::string& keys) {
    return faults_of("[projector]\ndriver = \"display\"\n[projector.display]\n" + keys);
  };
  EXPECT_THAT(display("width = 640"),
              ElementsAre("projector.display: projector: width and height must be set together"));
  EXPECT_THAT(display("pattern_height = 480"),
              ElementsAre("projector.display: projector: width and height must be set together"));
  EXPECT_THAT(display("pattern_columns = false\npattern_rows = false"),
              ElementsAre("projector.display: projector: the pattern has neither columns nor rows"));
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
          "colour: \"red\", expected one of the keys version, booth, api, capture, background, calibration, disk, "
          "retention, jobs, log, cameras, "
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
