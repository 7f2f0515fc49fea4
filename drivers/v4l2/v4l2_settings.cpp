#include "drivers/v4l2/v4l2_settings.h"

#include <array>
#include <cmath>
#include <set>
#include <sstream>
#include <utility>

namespace booth {
namespace {

constexpr std::array<std::pair<V4l2Format, std::string_view>, 8> format_names{{{V4l2Format::automatic, "auto"},
                                                                               {V4l2Format::mjpg, "mjpg"},
                                                                               {V4l2Format::yuyv, "yuyv"},
                                                                               {V4l2Format::grey, "grey"},
                                                                               {V4l2Format::bayer_rggb, "rggb"},
                                                                               {V4l2Format::bayer_grbg, "grbg"},
                                                                               {V4l2Format::bayer_gbrg, "gbrg"},
                                                                               {V4l2Format::bayer_bggr, "bggr"}}};

/// V4L2 counts exposure in these steps.
constexpr int exposure_step_us = 100;

template <class T>
Error refused(const std::string& camera, const char* setting, const T& value, const std::string& expected) {
  std::ostringstream message;
  message << camera << ": " << setting << " is " << value << ", expected " << expected;
  return {ErrorCode::invalid_argument, message.str()};
}

struct Range {
  const char* setting;
  double value;
  double lowest, highest;
};

Result<void> check_exposure(const std::string& camera, const char* setting, const std::optional<int>& exposure_us) {
  if (exposure_us &&
      (*exposure_us < exposure_step_us || *exposure_us > 10'000'000 || *exposure_us % exposure_step_us != 0))
    return refused(camera, setting, *exposure_us, "a multiple of 100 in 100 … 10000000");
  return {};
}

Result<void> check_camera(const V4l2CameraSettings& camera) {
  if (!is_safe_id(camera.id)) return refused("v4l2", "a camera's id", "\"" + camera.id + "\"", "a file-name safe name");
  if (!camera.device.empty() + !camera.serial.empty() + !camera.bus.empty() != 1)
    return Error{ErrorCode::invalid_argument, camera.id + ": exactly one of device, serial and bus must be set"};
  const Range ranges[] = {{"width", static_cast<double>(camera.width), 0, 65535},
                          {"height", static_cast<double>(camera.height), 0, 65535},
                          {"fps", camera.fps, 0, 1000},
                          {"white_balance_k", static_cast<double>(camera.white_balance_k.value_or(1000)), 1000, 20000},
                          {"buffers", static_cast<double>(camera.buffers), 2, 32},
                          {"warm_up_frames", static_cast<double>(camera.warm_up_frames), 0, 100},
                          {"latency_us", static_cast<double>(camera.latency_us), 0, 1'000'000},
                          {"max_offset_ms", static_cast<double>(camera.max_offset_ms), 1, 60000}};
  for (const Range& range : ranges)
    if (!(range.value >= range.lowest && range.value <= range.highest)) {
      std::ostringstream expected;
      expected << std::fixed;
      expected.precision(0);
      expected << range.lowest << " … " << range.highest;
      return refused(camera.id, range.setting, range.value, expected.str());
    }
  if ((camera.width == 0) != (camera.height == 0))
    return Error{ErrorCode::invalid_argument, camera.id + ": width and height must be set together"};
  if (auto exposure = check_exposure(camera.id, "exposure_us", camera.exposure_us); !exposure) return exposure;
  return check_exposure(camera.id, "gray_code_exposure_us", camera.gray_code_exposure_us);
}

}  // namespace

std::string_view to_string(V4l2Format format) {
  for (const auto& [known, name] : format_names)
    if (known == format) return name;
  return "";
}

std::optional<V4l2Format> v4l2_format_from(std::string_view name) {
  for (const auto& [format, known] : format_names)
    if (known == name) return format;
  return std::nullopt;
}

Result<void> check(const V4l2Settings& settings) {
  std::set<std::string> ids;
  for (const V4l2CameraSettings& camera : settings.cameras) {
    if (auto checked = check_camera(camera); !checked) return checked;
    if (!ids.insert(camera.id).second)
      return Error{ErrorCode::invalid_argument, "v4l2: two cameras are called " + camera.id};
  }
  return {};
}

}  // namespace booth
