#include "config/booth_config.h"

#include <toml++/toml.h>
#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <iomanip>
#include <limits>
#include <regex>
#include <set>
#include <sstream>
#include <system_error>
#include <utility>

#include "config/migration.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

template <class Value>
using Words = std::vector<std::pair<std::string_view, Value>>;

/// "NAME=VALUE" texts.
using Assignments = std::vector<std::pair<std::string, std::string>>;

constexpr const char* version_key = "version";
constexpr size_t longest_name = 64;
constexpr size_t longest_path = 4000;

// What can be set, one function a section. A visitor reads it, writes it or lists it, so that the three agree.

template <class Visitor>
void visit_booth(Visitor& visitor, IdentityConfig& booth) {
  visitor.text("name", booth.name, longest_name);
  visitor.path("state_directory", booth.state_directory);
}

template <class Visitor>
void visit_api(Visitor& visitor, ApiConfig& api) {
  visitor.endpoint("control", api.control);
  visitor.endpoint("events", api.events);
  visitor.remote_endpoint("remote_control", api.remote_control);
  visitor.remote_endpoint("remote_events", api.remote_events);
  visitor.path("server_key", api.server_key);
  visitor.path("client_keys", api.client_keys);
}

template <class Visitor>
void visit_capture(Visitor& visitor, CaptureConfig& capture) {
  using Format = SpoolOptions::Format;
  visitor.integer("frame_timeout_ms", capture.frame_timeout_ms, 50, 60000);
  visitor.integer("retries", capture.retries, 0, 5);
  visitor.integer("max_skew_ms", capture.max_skew_ms, 1, 60000);
  visitor.integer("min_cameras", capture.min_cameras, 1, 256);
  visitor.integer("background_frames", capture.background_frames, 1, 100);
  visitor.choice("image_format", capture.images.format, Words<Format>{{"png", Format::png}, {"jpeg", Format::jpeg}});
  visitor.integer("png_level", capture.images.png_level, 0, 9);
  visitor.integer("jpeg_quality", capture.images.jpeg_quality, 1, 100);
  visitor.boolean("keep_encoded", capture.images.keep_encoded);
}

template <class Visitor>
void visit_background(Visitor& visitor, BackgroundConfig& background) {
  visitor.integer("max_age_h", background.max_age_h, 0, 8760);
  visitor.number("max_light_factor", background.max_light_factor, 1.05, 10);
  visitor.boolean("relearn", background.relearn);
  visitor.integer("quiet_s", background.quiet_s, 5, 86400);
}

template <class Visitor>
void visit_calibration(Visitor& visitor, CalibrationConfig& calibration) {
  visitor.integer("timeout_s", calibration.timeout_s, 10, 86400);
  visitor.section("board", [&](auto& section) {
    CalibrationBoard& board = calibration.board;
    section.integer("squares_x", board.squares_x, 3, 100);
    section.integer("squares_y", board.squares_y, 3, 100);
    section.number("square_m", board.square_m, 0.001, 1);
    section.number("marker_m", board.marker_m, 0.0005, 1);
    section.text("dictionary", board.dictionary, longest_name);
  });
}

template <class Visitor>
void visit_disk(Visitor& visitor, DiskConfig& disk) {
  visitor.integer("reserve_mib", disk.reserve_mib, 0, 10'000'000);
  visitor.integer("limit_mib", disk.limit_mib, 0, 100'000'000);
}

template <class Visitor>
void visit_retention(Visitor& visitor, RetentionConfig& retention) {
  visitor.integer("max_age_h", retention.max_age_h, 0, 1'000'000);
  visitor.integer("max_captures", retention.max_captures, 0, 10'000'000);
  visitor.boolean("make_room", retention.make_room);
}

template <class Visitor>
void visit_jobs(Visitor& visitor, JobsConfig& jobs) {
  visitor.integer("workers", jobs.workers, 1, 64);
  visitor.boolean("head_start", jobs.head_start);
  visitor.integer("threads", jobs.threads, 0, 256);
  visitor.integer("timeout_s", jobs.timeout_s, 1, 86400);
  visitor.integer("memory_mib", jobs.memory_mib, 0, 10'000'000);
  visitor.integer("retries", jobs.retries, 0, 10);
}

template <class Visitor>
void visit_log(Visitor& visitor, LogConfig& log) {
  visitor.choice("level", log.level,
                 Words<LogLevel>{{"error", LogLevel::error},
                                 {"warning", LogLevel::warning},
                                 {"info", LogLevel::info},
                                 {"debug", LogLevel::debug}});
}

template <class Visitor>
void visit_aravis(Visitor& visitor, AravisCameraSettings& camera) {
  using Response = AravisResponse;
  using Trigger = AravisTriggerSource;
  using Activation = AravisActivation;
  constexpr double longest_exposure_us = 10'000'000;
  visitor.any_text("serial", camera.serial, longest_name);
  visitor.any_text("address", camera.address, longest_name);
  visitor.number("exposure_us", camera.exposure_us, 1, longest_exposure_us);
  visitor.number("gain_db", camera.gain_db, 0, 60);
  visitor.optional_number("pattern_exposure_us", camera.pattern_exposure_us, 1, longest_exposure_us);
  visitor.optional_number("pattern_gain_db", camera.pattern_gain_db, 0, 60);
  visitor.optional_number("white_balance_red", camera.white_balance_red, 0.1, 16);
  visitor.optional_number("white_balance_blue", camera.white_balance_blue, 0.1, 16);
  visitor.choice("response", camera.response, Words<Response>{{"linear", Response::linear}, {"srgb", Response::srgb}});
  Words<std::string> formats;
  for (const char* format : {"Mono8", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8", "RGB8"})
    formats.emplace_back(format, format);
  visitor.choice("pixel_format", camera.pixel_format, formats);
  constexpr int widest = 65535;
  visitor.integer("region_x", camera.region.x, 0, widest);
  visitor.integer("region_y", camera.region.y, 0, widest);
  visitor.integer("region_width", camera.region.width, 0, widest);
  visitor.integer("region_height", camera.region.height, 0, widest);
  visitor.choice("trigger", camera.trigger,
                 Words<Trigger>{{"line", Trigger::line}, {"software", Trigger::software}, {"action", Trigger::action}});
  visitor.text("trigger_line", camera.trigger_line, longest_name);
  visitor.text("trigger_selector", camera.trigger_selector, longest_name);
  visitor.choice("activation", camera.activation,
                 Words<Activation>{{"rising_edge", Activation::rising_edge},
                                   {"falling_edge", Activation::falling_edge},
                                   {"any_edge", Activation::any_edge},
                                   {"level_high", Activation::level_high},
                                   {"level_low", Activation::level_low}});
  visitor.number("trigger_delay_us", camera.trigger_delay_us, 0, 1'000'000);
  visitor.integer("action", camera.action, 0, 31);
  visitor.number("preview_fps", camera.preview_fps, 1, 60);
  visitor.integer("packet_size", camera.packet_size, 0, 16384);
  visitor.integer("packet_delay_ns", camera.packet_delay_ns, 0, 1'000'000'000);
  visitor.boolean("packet_resend", camera.packet_resend);
  visitor.number("resend_ratio", camera.resend_ratio, 0, 1);
  visitor.integer("packet_timeout_ms", camera.packet_timeout_ms, 1, 1000);
  visitor.integer("frame_retention_ms", camera.frame_retention_ms, 1, 10'000);
  visitor.integer("socket_buffer_kib", camera.socket_buffer_kib, 64, 1'048'576);
  visitor.boolean("packet_socket", camera.packet_socket);
  visitor.integer("buffers", camera.buffers, 0, 256);
  visitor.integer("heartbeat_ms", camera.heartbeat_ms, 2000, 60'000);
  visitor.boolean("ptp", camera.ptp);
  Assignments features;
  for (const AravisFeature& feature : camera.features) features.emplace_back(feature.name, feature.value);
  visitor.assignments("features", features, [](const std::string& value) { return !value.empty(); });
  camera.features.clear();
  for (const auto& [name, value] : features) camera.features.push_back({name, value});
}

std::optional<int64_t> whole_number(const std::string& text) {
  int64_t number = 0;
  const auto [end, fault] = std::from_chars(text.data(), text.data() + text.size(), number);
  if (fault != std::errc() || end != text.data() + text.size()) return std::nullopt;
  return number;
}

template <class Visitor>
void visit_v4l2(Visitor& visitor, V4l2CameraSettings& camera) {
  visitor.any_text("device", camera.device, longest_path);
  visitor.any_text("serial", camera.serial, longest_name);
  visitor.any_text("bus", camera.bus, longest_name);
  Words<V4l2Format> formats;
  for (const V4l2Format format :
       {V4l2Format::automatic, V4l2Format::mjpg, V4l2Format::yuyv, V4l2Format::grey, V4l2Format::bayer_rggb,
        V4l2Format::bayer_grbg, V4l2Format::bayer_gbrg, V4l2Format::bayer_bggr})
    formats.emplace_back(to_string(format), format);
  visitor.choice("format", camera.format, formats);
  visitor.integer("width", camera.width, 0, 65535);
  visitor.integer("height", camera.height, 0, 65535);
  visitor.number("fps", camera.fps, 0, 1000);
  visitor.optional_integer("exposure_us", camera.exposure_us, 100, 10'000'000);
  visitor.optional_integer("gray_code_exposure_us", camera.gray_code_exposure_us, 100, 10'000'000);
  visitor.optional_integer("gain", camera.gain, 0, 1'000'000);
  visitor.optional_integer("white_balance_k", camera.white_balance_k, 1000, 20'000);
  visitor.optional_integer("focus", camera.focus, 0, 1'000'000);
  Assignments controls;
  for (const auto& [name, value] : camera.controls) controls.emplace_back(name, std::to_string(value));
  visitor.assignments("controls", controls, [](const std::string& value) { return whole_number(value).has_value(); });
  camera.controls.clear();
  for (const auto& [name, value] : controls) camera.controls[name] = *whole_number(value);
  visitor.choice("trigger", camera.trigger,
                 Words<V4l2TriggerSource>{{"stream", V4l2TriggerSource::stream}, {"line", V4l2TriggerSource::line}});
  visitor.integer("buffers", camera.buffers, 2, 32);
  visitor.integer("warm_up_frames", camera.warm_up_frames, 0, 100);
  visitor.integer("latency_us", camera.latency_us, 0, 1'000'000);
  visitor.integer("max_offset_ms", camera.max_offset_ms, 1, 60'000);
}

/// The drivers of cameras, in the order of CameraConfig::driver.
constexpr std::array<std::string_view, 3> camera_drivers{"replay", "aravis", "v4l2"};

template <class Visitor>
void visit_camera(Visitor& visitor, CameraConfig& camera) {
  visitor.id("id", camera.id);
  size_t driver = camera.driver.index();
  Words<size_t> drivers;
  for (size_t i = 0; i < camera_drivers.size(); ++i) drivers.emplace_back(camera_drivers[i], i);
  visitor.choice("driver", driver, drivers);
  if (driver != camera.driver.index()) {
    if (driver == 0) camera.driver = ReplayCameraSettings{};
    if (driver == 1) camera.driver = AravisCameraSettings{};
    if (driver == 2) camera.driver = V4l2CameraSettings{};
  }
  visitor.choice("role", camera.role, Words<CameraRole>{{"body", CameraRole::body}, {"face", CameraRole::face}});
  visitor.choice("mount_rotation", camera.mount_rotation_deg,
                 Words<int>{{"0", 0}, {"90", 90}, {"180", 180}, {"270", 270}});
  if (auto* aravis = std::get_if<AravisCameraSettings>(&camera.driver)) {
    visit_aravis(visitor, *aravis);
    aravis->id = camera.id;
    aravis->role = camera.role;
  }
  if (auto* v4l2 = std::get_if<V4l2CameraSettings>(&camera.driver)) {
    visit_v4l2(visitor, *v4l2);
    v4l2->id = camera.id;
    v4l2->role = camera.role;
  }
}

/// A GPIO line's keys, "PREFIXchip" and so on.
template <class Visitor>
void visit_line(Visitor& visitor, const std::string& prefix, GpioLineSettings& line) {
  visitor.any_text((prefix + "chip").c_str(), line.chip, longest_path);
  visitor.any_text((prefix + "line").c_str(), line.line, longest_name);
  visitor.choice((prefix + "active").c_str(), line.active,
                 Words<ActiveLevel>{{"high", ActiveLevel::high}, {"low", ActiveLevel::low}});
}

Words<ShotRole> shot_roles() {
  Words<ShotRole> roles;
  for (const ShotRole role : {ShotRole::background, ShotRole::body, ShotRole::gray_code, ShotRole::calibration_board})
    roles.emplace_back(to_string(role), role);
  return roles;
}

template <class Visitor>
void visit_trigger(Visitor& visitor, TriggerConfig& trigger) {
  using Driver = TriggerDriver;
  visitor.choice(
      "driver", trigger.driver,
      Words<Driver>{
          {"replay", Driver::replay}, {"gpio", Driver::gpio}, {"aravis", Driver::aravis}, {"none", Driver::none}});
  visitor.section("gpio", [&](auto& section) {
    GpioTriggerSettings& gpio = trigger.gpio;
    visit_line(section, "", gpio.trigger);
    section.integer("pulse_us", gpio.pulse_us, 10, 100'000);
    GpioLineSettings lights = gpio.lights.value_or(GpioLineSettings{});
    visit_line(section, "lights_", lights);
    gpio.lights.reset();
    if (!lights.chip.empty() || !lights.line.empty()) gpio.lights = lights;
    section.integer("lights_lead_us", gpio.lights_lead_us, 0, 1'000'000);
    section.integer("lights_hold_us", gpio.lights_hold_us, 0, 1'000'000);
    section.choices("lit", gpio.lit_roles, shot_roles());
  });
  visitor.section("action", [&](auto& section) {
    AravisActionSettings& action = trigger.action;
    constexpr int64_t widest = 0xffffffff;
    section.integer("device_key", action.device_key, 0, widest);
    section.integer("group_key", action.group_key, 0, widest);
    section.integer("group_mask", action.group_mask, 1, widest);
    section.texts("destinations", action.destinations, longest_name);
    section.integer("schedule_ahead_us", action.schedule_ahead_us, 0, 1'000'000);
    section.integer("acknowledge_timeout_ms", action.acknowledge_timeout_ms, 1, 10'000);
  });
}

template <class Visitor>
void visit_pattern(Visitor& visitor, GrayCodePattern& pattern) {
  visitor.integer("pattern_width", pattern.width, 0, 16384);
  visitor.integer("pattern_height", pattern.height, 0, 16384);
  visitor.boolean("pattern_columns", pattern.columns);
  visitor.boolean("pattern_rows", pattern.rows);
  visitor.boolean("pattern_inverse", pattern.inverse);
}

template <class Visitor>
void visit_projector(Visitor& visitor, ProjectorConfig& projector) {
  using Driver = ProjectorDriver;
  visitor.choice(
      "driver", projector.driver,
      Words<Driver>{
          {"replay", Driver::replay}, {"display", Driver::display}, {"gpio", Driver::gpio}, {"none", Driver::none}});
  visitor.section("gpio", [&](auto& section) {
    GpioProjectorSettings& gpio = projector.gpio;
    section.id("id", gpio.id);
    visit_pattern(section, gpio.pattern);
    visit_line(section, "step_", gpio.step);
    visit_line(section, "reset_", gpio.reset);
    section.integer("pulse_us", gpio.pulse_us, 10, 100'000);
    section.integer("pause_us", gpio.pause_us, 10, 1'000'000);
    section.integer("settle_us", gpio.settle_us, 0, 1'000'000);
  });
  visitor.section("display", [&](auto& section) {
    DisplaySettings& display = projector.display;
    section.id("id", display.id);
    section.any_text("card", display.card, longest_path);
    section.any_text("connector", display.connector, longest_name);
    section.integer("width", display.width, 0, 16384);
    section.integer("height", display.height, 0, 16384);
    section.number("refresh_hz", display.refresh_hz, 0, 1000);
    visit_pattern(section, display.pattern);
    section.integer("delay_us", display.delay_us, 0, 1'000'000);
    section.number("brightness", display.brightness, 0.01, 1);
    section.number("gamma", display.gamma, 1, 4);
  });
}

template <class Visitor>
void visit_fault(Visitor& visitor, ReplayFault& fault) {
  using Kind = ReplayFault::Kind;
  constexpr int most = 1'000'000;
  visitor.choice(
      "kind", fault.kind,
      Words<Kind>{{"missing", Kind::missing}, {"late", Kind::late}, {"corrupt", Kind::corrupt}, {"lost", Kind::lost}});
  visitor.camera("camera", fault.camera);
  Words<std::optional<ShotRole>> roles{{"any", std::nullopt}};
  for (const auto& [name, role] : shot_roles()) roles.emplace_back(name, role);
  visitor.choice("role", fault.role, roles);
  visitor.optional_integer("index", fault.index, 0, most);
  visitor.optional_integer("capture", fault.capture, 0, most);
  visitor.integer("delay_ms", fault.delay_ms, 0, most);
}

template <class Visitor>
void visit_replay(Visitor& visitor, ReplayOptions& replay) {
  using Pace = ReplayOptions::Pace;
  visitor.path("recording", replay.recording);
  visitor.choice("pace", replay.pace, Words<Pace>{{"real", Pace::real}, {"fast", Pace::fast}});
  visitor.integer("cache_mib", replay.cache_mib, 0, 65536);
  visitor.list("faults", replay.faults, std::vector<ReplayFault>(1),
               [](auto& element, ReplayFault& fault) { visit_fault(element, fault); });
}

template <class Visitor>
void visit_reconstruct(Visitor& visitor, ReconstructionOptions& options) {
  Words<FaceMode> faces;
  for (const FaceMode mode : {FaceMode::automatic, FaceMode::active, FaceMode::passive, FaceMode::none})
    faces.emplace_back(to_string(mode), mode);
  visitor.choice("face", options.face, faces);
  visitor.choice(
      "face_merge", options.face_merge.method,
      Words<FaceMergeMethod>{
          {"sight", FaceMergeMethod::sight}, {"radial", FaceMergeMethod::radial}, {"sewing", FaceMergeMethod::sewing}});
  visitor.number("face_share", options.face_share, 0, 0.9);
  visitor.integer("triangles", options.decimation.triangles, 500, 1'000'000);
  visitor.integer("atlas_size", options.atlas.size, 256, 8192);
  Words<TextureMethod> methods;
  for (const TextureMethod method : {TextureMethod::best_view, TextureMethod::blend, TextureMethod::full})
    methods.emplace_back(to_string(method), method);
  visitor.choice("texture_method", options.atlas.method, methods);
  visitor.choice("texture_charts", options.atlas.charting,
                 Words<Charting>{{"flattening", Charting::flattening}, {"unfolding", Charting::unfolding}});
  visitor.millimetres("voxel_mm", options.hull.voxel_m, 1, 50);
  visitor.integer("min_views", options.hull.min_views, 1, 256);
  visitor.choice("skeleton", options.skeleton.method,
                 Words<SkeletonMethod>{{"anatomy", SkeletonMethod::anatomy}, {"embedding", SkeletonMethod::embedding}});
  visitor.choice("skin", options.skinning.method,
                 Words<SkinningMethod>{{"heat", SkinningMethod::heat}, {"regions", SkinningMethod::regions}});
}

template <class Visitor>
void visit_export(Visitor& visitor, AvatarFileOptions& files) {
  visitor.choice("texture", files.texture, Words<ImageFormat>{{"png", ImageFormat::png}, {"jpeg", ImageFormat::jpeg}});
  visitor.integer("jpeg_quality", files.jpeg_quality, 1, 100);
  visitor.boolean("animation", files.animation);
  visitor.boolean("collada_morphs", files.collada_morphs);
  visitor.boolean("turntable", files.turntable);
  visitor.choices("formats", files.formats,
                  Words<MeshFormat>{{"stl", MeshFormat::stl}, {"obj", MeshFormat::obj}, {"ply", MeshFormat::ply}});
}

template <class Visitor>
void visit_config(Visitor& visitor, BoothConfig& config) {
  visitor.section("booth", [&](auto& section) { visit_booth(section, config.booth); });
  visitor.section("api", [&](auto& section) { visit_api(section, config.api); });
  visitor.section("capture", [&](auto& section) { visit_capture(section, config.capture); });
  visitor.section("background", [&](auto& section) { visit_background(section, config.background); });
  visitor.section("calibration", [&](auto& section) { visit_calibration(section, config.calibration); });
  visitor.section("disk", [&](auto& section) { visit_disk(section, config.disk); });
  visitor.section("retention", [&](auto& section) { visit_retention(section, config.retention); });
  visitor.section("jobs", [&](auto& section) { visit_jobs(section, config.jobs); });
  visitor.section("log", [&](auto& section) { visit_log(section, config.log); });
  std::vector<CameraConfig> one_of_each_driver(camera_drivers.size());
  one_of_each_driver[1].driver = AravisCameraSettings{};
  one_of_each_driver[2].driver = V4l2CameraSettings{};
  visitor.list("cameras", config.cameras, one_of_each_driver,
               [](auto& element, CameraConfig& camera) { visit_camera(element, camera); });
  visitor.section("trigger", [&](auto& section) { visit_trigger(section, config.trigger); });
  visitor.section("projector", [&](auto& section) { visit_projector(section, config.projector); });
  visitor.section("replay", [&](auto& section) { visit_replay(section, config.replay); });
  visitor.section("face", [&](auto& section) {
    section.path("landmark_model", config.face.landmark_model);
    section.path("cascade", config.face.cascade);
  });
  visitor.section("reconstruct", [&](auto& section) { visit_reconstruct(section, config.reconstruct); });
  visitor.section("export", [&](auto& section) { visit_export(section, config.files); });
}

/// One short line without control characters.
std::string one_line(std::string text) {
  constexpr size_t longest = 100;
  std::replace_if(
      text.begin(), text.end(), [](unsigned char c) { return c < 0x20 || c == 0x7f; }, ' ');
  if (text.size() > longest) text = text.substr(0, longest) + "…";
  return text;
}

/// "tcp://ADDRESS:PORT": a name, an IPv4 address, an IPv6 address in brackets, or "*" for every address of the machine.
bool is_tcp_endpoint(const std::string& text) {
  static const std::regex form(R"(tcp://(\*|[A-Za-z0-9._-]{1,253}|\[[0-9A-Fa-f:.%a-z]{2,64}\]):([0-9]{1,5}))");
  std::smatch match;
  constexpr int highest_port = 65535;
  if (!std::regex_match(text, match, form)) return false;
  const int port = std::stoi(match[2]);
  return port >= 1 && port <= highest_port;
}

std::string quoted(const toml::node& node) {
  if (node.is_table()) return "a table";
  if (node.is_array()) return "an array";
  if (const auto* text = node.as_string()) return "\"" + one_line(text->get()) + "\"";
  std::ostringstream text;
  node.visit([&](const auto& value) { text << value; });
  return one_line(text.str());
}

template <class Value>
std::string listed(const Words<Value>& words) {
  std::string list;
  for (const auto& [word, value] : words) list += (list.empty() ? "\"" : ", \"") + std::string(word) + "\"";
  return words.size() == 1 ? list : "one of " + list;
}

std::string range(const std::string& lowest, const std::string& highest) { return lowest + " … " + highest; }

constexpr size_t most_texts = 64;  ///< of an array

/// Takes what a table holds into the options and notes everything that is wrong.
class Reader {
 public:
  Reader(const toml::table& table, std::string path, const fs::path& folder, std::vector<ConfigFault>& faults)
      : table_(table), path_(std::move(path)), folder_(folder), faults_(faults) {}

  template <class Visit>
  void section(const char* key, const Visit& visit) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const toml::table* table = node->as_table();
    if (table == nullptr) return refuse(key, *node, "a table: [" + dotted(key) + "]");
    Reader reader(*table, dotted(key), folder_, faults_);
    visit(reader);
    reader.refuse_unknown();
  }

  template <class Element, class Visit>
  void list(const char* key, std::vector<Element>& elements, const std::vector<Element>&, const Visit& visit) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const toml::array* array = node->as_array();
    constexpr size_t most = 1000;
    if (array == nullptr || array->size() > most)
      return refuse(key, *node, "an array of at most " + std::to_string(most) + " tables: [[" + dotted(key) + "]]");
    elements.clear();
    for (size_t i = 0; i < array->size(); ++i) {
      const std::string path = std::string(key) + "[" + std::to_string(i) + "]";
      const toml::table* table = (*array)[i].as_table();
      if (table == nullptr) {
        refuse(path.c_str(), (*array)[i], "a table");
        continue;
      }
      Reader reader(*table, dotted(path.c_str()), folder_, faults_);
      visit(reader, elements.emplace_back());
      reader.refuse_unknown();
    }
  }

  void text(const char* key, std::string& value, size_t longest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || text->empty() || text->size() > longest || has_control(*text))
      return refuse(key, *node, "a text of 1 … " + std::to_string(longest) + " bytes on one line");
    value = *text;
  }

  void any_text(const char* key, std::string& value, size_t longest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || text->size() > longest || has_control(*text))
      return refuse(key, *node, "a text of at most " + std::to_string(longest) + " bytes on one line");
    value = *text;
  }

  void id(const char* key, std::string& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || !is_safe_id(*text))
      return refuse(key, *node, "an id: 1 … 64 letters, digits, '-', '_' and '.', not beginning with '.'");
    value = *text;
  }

  void texts(const char* key, std::vector<std::string>& values, size_t longest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    std::vector<std::string> taken;
    const std::string expected =
        "an array of at most " + std::to_string(most_texts) + " texts of 1 … " + std::to_string(longest) + " bytes";
    const toml::array* array = node->as_array();
    if (array == nullptr || array->size() > most_texts) return refuse(key, *node, expected);
    for (const toml::node& element : *array) {
      const auto text = element.value_exact<std::string>();
      if (!text || text->empty() || text->size() > longest || has_control(*text)) return refuse(key, element, expected);
      taken.push_back(*text);
    }
    values = taken;
  }

  template <class IsValue>
  void assignments(const char* key, Assignments& values, const IsValue& is_value) {
    std::vector<std::string> written;
    const toml::node* node = table_.get(key);
    texts(key, written, longest_path);
    if (node == nullptr) return;
    Assignments taken;
    for (const std::string& text : written) {
      const size_t equals = text.find('=');
      if (equals == 0 || equals == std::string::npos || !is_value(text.substr(equals + 1)))
        return refuse(key, *node, "an array of texts NAME=VALUE");
      taken.emplace_back(text.substr(0, equals), text.substr(equals + 1));
    }
    values = taken;
  }

  void number(const char* key, double& value, double lowest, double highest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto number = node->value<double>();
    if (!node->is_number() || !number || !(*number >= lowest && *number <= highest))
      return refuse(key, *node, range(written(lowest), written(highest)));
    value = *number;
  }

  void optional_number(const char* key, std::optional<double>& value, double lowest, double highest) {
    if (!table_.contains(key)) return known_.push_back(key);
    double set = lowest;
    number(key, set, lowest, highest);
    value = set;
  }

  void path(const char* key, fs::path& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || text->empty() || text->size() > longest_path || has_control(*text))
      return refuse(key, *node, "a path");
    value = (folder_ / *text).lexically_normal();
  }

  void endpoint(const char* key, std::string& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    const std::string local = "ipc://";
    constexpr size_t longest = 107;  // of a Unix socket's path
    const bool is_local =
        text && text->starts_with(local + "/") && text->size() <= local.size() + longest && !has_control(*text);
    if (!text || (!is_local && !is_tcp_endpoint(*text)))
      return refuse(key, *node,
                    "ipc:///PATH with a path of at most " + std::to_string(longest) + " bytes, or tcp://ADDRESS:PORT");
    value = *text;
  }

  void remote_endpoint(const char* key, std::string& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || (!text->empty() && !is_tcp_endpoint(*text)))
      return refuse(key, *node, "tcp://ADDRESS:PORT, or \"\" for none");
    value = *text;
  }

  void camera(const char* key, std::string& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || (!text->empty() && !is_safe_id(*text)))
      return refuse(key, *node, "a camera's id, or \"\" for every camera");
    value = *text;
  }

  void boolean(const char* key, bool& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto truth = node->value_exact<bool>();
    if (!truth) return refuse(key, *node, "true or false");
    value = *truth;
  }

  template <class Integer>
  void integer(const char* key, Integer& value, int64_t lowest, int64_t highest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto number = node->value_exact<int64_t>();
    if (!number || *number < lowest || *number > highest)
      return refuse(key, *node,
                    (number ? "" : "a whole number, ") + range(std::to_string(lowest), std::to_string(highest)));
    value = static_cast<Integer>(*number);
  }

  void optional_integer(const char* key, std::optional<int>& value, int64_t lowest, int64_t highest) {
    if (!table_.contains(key)) return known_.push_back(key);
    int number = 0;
    integer(key, number, lowest, highest);
    value = number;
  }

  void millimetres(const char* key, double& value_m, double lowest_mm, double highest_mm) {
    constexpr double mm_per_m = 1000;
    double value_mm = value_m * mm_per_m;
    const bool set = table_.contains(key);
    number(key, value_mm, lowest_mm, highest_mm);
    if (set) value_m = value_mm / mm_per_m;
  }

  template <class Value>
  void choice(const char* key, Value& value, const Words<Value>& words) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    const auto found = std::find_if(words.begin(), words.end(), [&](const auto& word) { return text == word.first; });
    if (found == words.end()) return refuse(key, *node, listed(words));
    value = found->second;
  }

  /// A list of words, each at most once.
  template <class Value>
  void choices(const char* key, std::vector<Value>& values, const Words<Value>& words) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const toml::array* array = node->as_array();
    if (array == nullptr) return refuse(key, *node, "an array of words, each " + listed(words));
    values.clear();
    for (size_t i = 0; i < array->size(); ++i) {
      const std::string path = std::string(key) + "[" + std::to_string(i) + "]";
      const auto text = (*array)[i].value_exact<std::string>();
      const auto found = std::find_if(words.begin(), words.end(), [&](const auto& word) { return text == word.first; });
      if (found == words.end())
        refuse(path.c_str(), (*array)[i], listed(words));
      else if (std::find(values.begin(), values.end(), found->second) != values.end())
        refuse(path.c_str(), (*array)[i], "each word once");
      else
        values.push_back(found->second);
    }
  }

  /// Reports the keys that nobody asked for.
  void refuse_unknown() {
    std::string list;
    for (const std::string& key : known_) list += (list.empty() ? "" : ", ") + key;
    for (const auto& [key, node] : table_)
      if (std::find(known_.begin(), known_.end(), key.str()) == known_.end())
        refuse(one_line(std::string(key.str())).c_str(), node, "one of the keys " + list);
  }

 private:
  static bool has_control(const std::string& text) {
    return std::any_of(text.begin(), text.end(), [](unsigned char c) { return c < 0x20 || c == 0x7f; });
  }
  static std::string written(double number) {
    std::ostringstream text;
    text << std::setprecision(std::numeric_limits<double>::digits10) << number;
    return text.str();
  }

  const toml::node* take(const char* key) {
    known_.emplace_back(key);
    return table_.get(key);
  }
  std::string dotted(const char* key) const { return path_.empty() ? key : path_ + "." + key; }
  void refuse(const char* key, const toml::node& node, const std::string& expected) {
    faults_.push_back({dotted(key), quoted(node), expected});
  }

  const toml::table& table_;
  std::string path_;
  const fs::path& folder_;
  std::vector<ConfigFault>& faults_;
  std::vector<std::string> known_;
};

/// Writes the options as TOML.
class Writer {
 public:
  template <class Visit>
  void section(const char* key, const Visit& visit) {
    const std::string outer = std::exchange(path_, path_.empty() ? key : path_ + "." + key);
    text_ << (text_.tellp() > 0 ? "\n[" : "[") << path_ << "]\n";
    visit(*this);
    path_ = outer;
  }
  template <class Element, class Visit>
  void list(const char* key, std::vector<Element>& elements, const std::vector<Element>&, const Visit& visit) {
    for (Element& element : elements) {
      text_ << "\n[[" << (path_.empty() ? key : path_ + "." + key) << "]]\n";
      visit(*this, element);
    }
  }
  void text(const char* key, const std::string& value, size_t) { write_text(key, value); }
  void any_text(const char* key, const std::string& value, size_t) { write_text(key, value); }
  void id(const char* key, const std::string& value) { write_text(key, value); }
  void texts(const char* key, const std::vector<std::string>& values, size_t) {
    toml::array array;
    for (const std::string& value : values) array.push_back(value);
    text_ << key << " = " << array << "\n";
  }
  template <class IsValue>
  void assignments(const char* key, const Assignments& values, const IsValue&) {
    std::vector<std::string> lines;
    for (const auto& [name, value] : values) lines.push_back(name + "=" + value);
    texts(key, lines, longest_path);
  }
  void number(const char* key, double value, double, double) {
    text_ << key << " = " << toml::value<double>(value) << "\n";
  }
  void optional_number(const char* key, const std::optional<double>& value, double lowest, double highest) {
    if (value) number(key, *value, lowest, highest);
  }
  void path(const char* key, const fs::path& value) { write_text(key, value.string()); }
  void endpoint(const char* key, const std::string& value) { write_text(key, value); }
  void remote_endpoint(const char* key, const std::string& value) { write_text(key, value); }
  void camera(const char* key, const std::string& value) { write_text(key, value); }
  void boolean(const char* key, bool value) { text_ << key << " = " << (value ? "true" : "false") << "\n"; }
  template <class Integer>
  void integer(const char* key, Integer value, int64_t, int64_t) {
    text_ << key << " = " << value << "\n";
  }
  void optional_integer(const char* key, const std::optional<int>& value, int64_t, int64_t) {
    if (value) text_ << key << " = " << *value << "\n";
  }
  void millimetres(const char* key, double value_m, double, double) {
    text_ << key << " = " << toml::value<double>(value_m * 1000) << "\n";
  }
  template <class Value>
  void choice(const char* key, const Value& value, const Words<Value>& words) {
    for (const auto& [word, meaning] : words)
      if (meaning == value) write_text(key, std::string(word));
  }
  template <class Value>
  void choices(const char* key, const std::vector<Value>& values, const Words<Value>& words) {
    text_ << key << " = [";
    for (size_t i = 0; i < values.size(); ++i)
      for (const auto& [word, meaning] : words)
        if (meaning == values[i]) text_ << (i > 0 ? ", " : "") << toml::value<std::string>(std::string(word));
    text_ << "]\n";
  }

  std::string text() const { return text_.str(); }

 private:
  void write_text(const char* key, const std::string& value) {
    text_ << key << " = " << toml::value<std::string>(value) << "\n";
  }

  std::ostringstream text_;
  std::string path_;
};

/// Lists the keys.
class Lister {
 public:
  template <class Visit>
  void section(const char* key, const Visit& visit) {
    const std::string outer = std::exchange(path_, path_ + key + ".");
    visit(*this);
    path_ = outer;
  }
  template <class Element, class Visit>
  void list(const char* key, std::vector<Element>&, std::vector<Element> examples, const Visit& visit) {
    const std::string outer = std::exchange(path_, path_ + key + "[].");
    for (Element& example : examples) visit(*this, example);
    path_ = outer;
  }
  void text(const char* key, const std::string&, size_t) { add(key); }
  void any_text(const char* key, const std::string&, size_t) { add(key); }
  void id(const char* key, const std::string&) { add(key); }
  void texts(const char* key, const std::vector<std::string>&, size_t) { add(key); }
  template <class IsValue>
  void assignments(const char* key, const Assignments&, const IsValue&) {
    add(key);
  }
  void number(const char* key, double, double, double) { add(key); }
  void optional_number(const char* key, const std::optional<double>&, double, double) { add(key); }
  void path(const char* key, const fs::path&) { add(key); }
  void endpoint(const char* key, const std::string&) { add(key); }
  void remote_endpoint(const char* key, const std::string&) { add(key); }
  void camera(const char* key, const std::string&) { add(key); }
  void boolean(const char* key, bool) { add(key); }
  template <class Integer>
  void integer(const char* key, Integer, int64_t, int64_t) {
    add(key);
  }
  void optional_integer(const char* key, const std::optional<int>&, int64_t, int64_t) { add(key); }
  void millimetres(const char* key, double, double, double) { add(key); }
  template <class Value>
  void choice(const char* key, const Value&, const Words<Value>&) {
    add(key);
  }
  template <class Value>
  void choices(const char* key, const std::vector<Value>&, const Words<Value>&) {
    add(key);
  }

  std::vector<std::string> keys;

 private:
  void add(const char* key) { keys.push_back(path_ + key); }
  std::string path_;
};

/// What a driver says of its settings as a whole.
void note(const Result<void>& checked, const char* path, std::vector<ConfigFault>& faults) {
  if (!checked) faults.push_back({path, checked.error().message, ""});
}

/// A camera that does not listen to what fires would be missing from every shot.
void check_triggers(const BoothConfig& config, const std::vector<AravisCameraSettings>& cameras,
                    std::vector<ConfigFault>& faults) {
  const auto count = [&](AravisTriggerSource trigger) {
    return std::count_if(cameras.begin(), cameras.end(), [&](const auto& camera) { return camera.trigger == trigger; });
  };
  const auto lines = count(AravisTriggerSource::line), actions = count(AravisTriggerSource::action);
  const auto all = static_cast<std::ptrdiff_t>(cameras.size());
  const bool orders = config.trigger.driver == TriggerDriver::aravis;
  if (orders && lines == all)
    faults.push_back({"trigger.driver", "\"aravis\"", "another one: no camera has the trigger software or action"});
  else if (orders && lines > 0)
    faults.push_back({"trigger.driver", "\"aravis\"", "the trigger software or action of every camera, not \"line\""});
  else if (orders && actions > 0 && actions < all)
    faults.push_back({"trigger.driver", "\"aravis\"", "one trigger for all cameras, either software or action"});
  else if (!orders && lines < all)
    faults.push_back({"trigger.driver", "another than \"aravis\"",
                      "the trigger \"line\" of every camera: software and action are for \"aravis\""});
}

void check_cameras(const BoothConfig& config, std::vector<ConfigFault>& faults) {
  std::set<std::string> ids;
  bool replayed = config.cameras.empty();
  for (size_t i = 0; i < config.cameras.size(); ++i) {
    const CameraConfig& camera = config.cameras[i];
    const std::string path = "cameras[" + std::to_string(i) + "].id";
    if (camera.id.empty())
      faults.push_back({path, "missing", "an id"});
    else if (!ids.insert(camera.id).second)
      faults.push_back({path, "\"" + camera.id + "\"", "an id that no other camera has"});
    replayed |= std::holds_alternative<ReplayCameraSettings>(camera.driver);
  }
  if (!faults.empty()) return;
  const auto [aravis, v4l2] = live_cameras(config);
  note(check(aravis), "cameras", faults);
  note(check(v4l2), "cameras", faults);
  if (config.trigger.driver == TriggerDriver::gpio) note(check(config.trigger.gpio), "trigger.gpio", faults);
  if (config.trigger.driver == TriggerDriver::replay && !replayed)
    faults.push_back({"trigger.driver", "\"replay\"", "another one: no camera is replayed"});
  check_triggers(config, aravis.cameras, faults);
  if (config.projector.driver == ProjectorDriver::replay && !replayed)
    faults.push_back({"projector.driver", "\"replay\"", "another one, or \"none\": no camera is replayed"});
  if (config.projector.driver == ProjectorDriver::gpio) note(check(config.projector.gpio), "projector.gpio", faults);
  if (config.projector.driver == ProjectorDriver::display)
    note(check(config.projector.display), "projector.display", faults);
}

/// What holds between keys.
void check_together(const BoothConfig& config, std::vector<ConfigFault>& faults) {
  std::set<std::string> endpoints{config.api.control};
  for (const auto& [path, endpoint] :
       {std::pair("api.events", config.api.events), std::pair("api.remote_control", config.api.remote_control),
        std::pair("api.remote_events", config.api.remote_events)})
    if (!endpoint.empty() && !endpoints.insert(endpoint).second)
      faults.push_back({path, "\"" + endpoint + "\"", "an endpoint that is not used twice"});
  if (config.booth.state_directory.is_relative())
    faults.push_back({"booth.state_directory", config.booth.state_directory.string(), "an absolute path"});
  if (const CalibrationBoard& board = config.calibration.board; !(board.marker_m < board.square_m))
    faults.push_back({"calibration.board.marker_m", std::to_string(board.marker_m), "less than square_m"});
  check_cameras(config, faults);
}

}  // namespace

std::pair<AravisSettings, V4l2Settings> live_cameras(const BoothConfig& config) {
  std::pair<AravisSettings, V4l2Settings> live;
  live.first.action = config.trigger.action;
  for (const CameraConfig& camera : config.cameras) {
    if (const auto* aravis = std::get_if<AravisCameraSettings>(&camera.driver)) live.first.cameras.push_back(*aravis);
    if (const auto* v4l2 = std::get_if<V4l2CameraSettings>(&camera.driver)) live.second.cameras.push_back(*v4l2);
  }
  return live;
}

std::string_view driver_name(const CameraConfig& camera) { return camera_drivers[camera.driver.index()]; }

std::string ConfigFault::to_string() const {
  return path + ": " + value + (expected.empty() ? "" : ", expected " + expected);
}

ConfigReading parse_config(std::string_view text, const fs::path& folder) {
  ConfigReading reading;
  const auto migrated = migrate_config(text);
  if (!migrated) {
    reading.faults.push_back({version_key, migrated.error().message, ""});
    return reading;
  }
  try {
    const toml::table table = *migrated ? toml::parse((*migrated)->text) : toml::parse(text);
    Reader reader(table, "", folder, reading.faults);
    int version = config_version;
    reader.integer(version_key, version, config_version, config_version);
    visit_config(reader, reading.config);
    reader.refuse_unknown();
  } catch (const toml::parse_error& error) {
    const toml::source_position place = error.source().begin;
    reading.faults.push_back({"line " + std::to_string(place.line) + ", column " + std::to_string(place.column),
                              "is not TOML: " + one_line(std::string(error.description())), ""});
    return reading;
  }
  if (reading.faults.empty()) check_together(reading.config, reading.faults);
  return reading;
}

Result<BoothConfig> load_config(const fs::path& file) {
  constexpr size_t largest_bytes = size_t{1} << 20;
  const auto bytes = read_file(file, largest_bytes);
  if (!bytes) return bytes.error();
  const std::string text(bytes->begin(), bytes->end());
  std::error_code code;
  const fs::path folder = fs::absolute(file, code).parent_path();
  ConfigReading reading = parse_config(text, folder);
  if (reading.faults.empty()) return std::move(reading.config);
  std::string message;
  for (const ConfigFault& fault : reading.faults)
    message += (message.empty() ? "" : "\n") + file.string() + ": " + fault.to_string();
  return Error{ErrorCode::invalid_file, message};
}

std::string write_config(const BoothConfig& config) {
  Writer writer;
  BoothConfig copy = config;
  writer.integer(version_key, config_version, config_version, config_version);
  visit_config(writer, copy);
  return writer.text();
}

std::vector<std::string> config_keys() {
  Lister lister;
  BoothConfig config;
  lister.integer(version_key, config_version, config_version, config_version);
  visit_config(lister, config);
  return std::move(lister.keys);
}

}  // namespace booth
