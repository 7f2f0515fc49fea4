#include "drivers/aravis/aravis_settings.h"

#include <algorithm>
#include <array>
#include <map>
#include <set>
#include <sstream>
#include <string_view>

#include "pipeline/types/rig.h"

namespace booth {
namespace {

constexpr std::array<std::string_view, 6> pixel_formats{"Mono8",    "BayerRG8", "BayerGR8",
                                                        "BayerGB8", "BayerBG8", "RGB8"};

template <class Value>
std::string text_of(const Value& value) {
  std::ostringstream text;
  text << value;
  return text.str();
}

bool is_feature_name(const std::string& name) {
  constexpr size_t longest = 64;
  return !name.empty() && name.size() <= longest && std::all_of(name.begin(), name.end(), [](unsigned char c) {
    return c < 0x80 && (std::isalnum(c) != 0 || c == '_');
  });
}

/// Collects the first fault of one camera's settings (or the action's).
class Checker {
 public:
  explicit Checker(std::string whose) : whose_(std::move(whose)) {}

  void refuse(const std::string& setting, const std::string& value, const std::string& expected) {
    if (!fault_)
      fault_ = Error{ErrorCode::invalid_argument, whose_ + ": " + setting + ": " + value + ", expected " + expected};
  }
  template <class Value>
  void expect_range(const std::string& setting, Value value, Value lowest, Value highest) {
    if (!(value >= lowest && value <= highest))
      refuse(setting, text_of(value), text_of(lowest) + " … " + text_of(highest));
  }
  /// As above; `automatic` also does.
  void expect_range_or(const std::string& setting, int automatic, int value, int lowest, int highest) {
    if (value != automatic) expect_range(setting, value, lowest, highest);
  }
  const std::optional<Error>& fault() const { return fault_; }

 private:
  std::string whose_;
  std::optional<Error> fault_;
};

void check_camera(const AravisCameraSettings& camera, Checker& checker) {
  if (camera.serial.empty() == camera.address.empty())
    checker.refuse("serial", "\"" + camera.serial + "\" with address \"" + camera.address + "\"",
                   "either a serial number or an address");
  constexpr double longest_exposure_us = 1e7, largest_gain_db = 60, smallest_ratio = 0.1, largest_ratio = 16;
  checker.expect_range("exposure_us", camera.exposure_us, 1.0, longest_exposure_us);
  checker.expect_range("gain_db", camera.gain_db, 0.0, largest_gain_db);
  if (camera.pattern_exposure_us)
    checker.expect_range("pattern_exposure_us", *camera.pattern_exposure_us, 1.0, longest_exposure_us);
  if (camera.pattern_gain_db) checker.expect_range("pattern_gain_db", *camera.pattern_gain_db, 0.0, largest_gain_db);
  if (camera.white_balance_red)
    checker.expect_range("white_balance_red", *camera.white_balance_red, smallest_ratio, largest_ratio);
  if (camera.white_balance_blue)
    checker.expect_range("white_balance_blue", *camera.white_balance_blue, smallest_ratio, largest_ratio);
  if (std::find(pixel_formats.begin(), pixel_formats.end(), camera.pixel_format) == pixel_formats.end())
    checker.refuse("pixel_format", "\"" + camera.pixel_format + "\"",
                   "Mono8, BayerRG8, BayerGR8, BayerGB8, BayerBG8 or RGB8");
  constexpr int longest_side = 65535;
  checker.expect_range("region.x", camera.region.x, 0, longest_side);
  checker.expect_range("region.y", camera.region.y, 0, longest_side);
  checker.expect_range("region.width", camera.region.width, 0, longest_side);
  checker.expect_range("region.height", camera.region.height, 0, longest_side);
  if (!is_feature_name(camera.trigger_line))
    checker.refuse("trigger_line", "\"" + camera.trigger_line + "\"", "a line's name such as Line1");
  if (!is_feature_name(camera.trigger_selector))
    checker.refuse("trigger_selector", "\"" + camera.trigger_selector + "\"", "a trigger's name such as FrameStart");
  checker.expect_range("trigger_delay_us", camera.trigger_delay_us, 0.0, 1e6);
  checker.expect_range("action", camera.action, 0, 31);
  checker.expect_range("preview_fps", camera.preview_fps, 1.0, 60.0);
  checker.expect_range_or("packet_size", 0, camera.packet_size, 576, 16384);
  checker.expect_range("packet_delay_ns", camera.packet_delay_ns, 0, 1'000'000'000);
  checker.expect_range("resend_ratio", camera.resend_ratio, 0.0, 1.0);
  checker.expect_range("packet_timeout_ms", camera.packet_timeout_ms, 1, 1000);
  checker.expect_range("frame_retention_ms", camera.frame_retention_ms, 1, 10'000);
  checker.expect_range("socket_buffer_kib", camera.socket_buffer_kib, 64, 1 << 20);
  checker.expect_range_or("buffers", 0, camera.buffers, 2, 256);
  checker.expect_range("heartbeat_ms", camera.heartbeat_ms, 2000, 60'000);
  constexpr size_t most_features = 64;
  if (camera.features.size() > most_features)
    checker.refuse("features", text_of(camera.features.size()) + " of them", "at most 64");
  for (const AravisFeature& feature : camera.features)
    if (!is_feature_name(feature.name))
      checker.refuse("features", "\"" + feature.name + "\"", "a feature's name of letters, digits and '_'");
}

}  // namespace

Result<void> check(const AravisSettings& settings) {
  std::set<std::string> ids, places;
  bool any_action = false;
  for (const AravisCameraSettings& camera : settings.cameras) {
    Checker checker("camera " + camera.id);
    if (!is_safe_id(camera.id)) checker.refuse("id", "\"" + camera.id + "\"", "letters, digits, '-', '_' and '.'");
    if (!ids.insert(camera.id).second) checker.refuse("id", "\"" + camera.id + "\"", "an id that no other camera has");
    check_camera(camera, checker);
    const std::string place = camera.serial.empty() ? "address " + camera.address : "serial " + camera.serial;
    if (!places.insert(place).second) checker.refuse("serial", place, "a device that no other camera is");
    if (checker.fault()) return *checker.fault();
    any_action = any_action || camera.trigger == AravisTriggerSource::action;
  }
  if (!any_action) return {};
  Checker checker("action");
  if (settings.action.group_mask == 0) checker.refuse("group_mask", "0", "at least one bit");
  constexpr size_t most_destinations = 64;
  if (settings.action.destinations.empty() || settings.action.destinations.size() > most_destinations)
    checker.refuse("destinations", text_of(settings.action.destinations.size()) + " of them", "1 … 64");
  constexpr int at_once = 0;
  checker.expect_range_or("schedule_ahead_us", at_once, settings.action.schedule_ahead_us, 1000, 1'000'000);
  checker.expect_range("acknowledge_timeout_ms", settings.action.acknowledge_timeout_ms, 1, 10'000);
  if (checker.fault()) return *checker.fault();
  return {};
}

}  // namespace booth
