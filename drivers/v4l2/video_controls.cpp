#include "drivers/v4l2/video_controls.h"

#include <linux/videodev2.h>

#include <algorithm>
#include <cctype>
#include <cerrno>
#include <cstring>
#include <utility>
#include <vector>

#include "drivers/v4l2/video_error.h"

namespace booth {
namespace {

/// V4L2_CID_EXPOSURE_ABSOLUTE counts in these.
constexpr int64_t exposure_unit_us = 100;

/// As v4l2-ctl writes names: "White Balance, Automatic" is white_balance_automatic.
std::string plain_name(const char* text, size_t longest) {
  std::string name;
  bool gap = false;
  for (size_t i = 0; i < longest && text[i] != '\0'; ++i) {
    const auto letter = static_cast<unsigned char>(text[i]);
    if (std::isalnum(letter) == 0) {
      gap = !name.empty();
      continue;
    }
    if (std::exchange(gap, false)) name += '_';
    name += static_cast<char>(std::tolower(letter));
  }
  return name;
}

bool is_menu(uint32_t type) { return type == V4L2_CTRL_TYPE_MENU || type == V4L2_CTRL_TYPE_INTEGER_MENU; }

bool is_number(uint32_t type) {
  return type == V4L2_CTRL_TYPE_INTEGER || type == V4L2_CTRL_TYPE_INTEGER64 || type == V4L2_CTRL_TYPE_BOOLEAN ||
         type == V4L2_CTRL_TYPE_BITMASK || is_menu(type);
}

v4l2_query_ext_ctrl query(uint32_t id) {
  v4l2_query_ext_ctrl control;
  std::memset(&control, 0, sizeof control);
  control.id = id;
  return control;
}

/// One control's value on its way to or from the device.
struct Exchange {
  v4l2_ext_control control;
  v4l2_ext_controls all;

  Exchange(uint32_t id, uint32_t type, int64_t value) {
    std::memset(&control, 0, sizeof control);
    std::memset(&all, 0, sizeof all);
    control.id = id;
    if (type == V4L2_CTRL_TYPE_INTEGER64)
      control.value64 = value;
    else
      control.value = static_cast<int32_t>(value);
    all.which = V4L2_CTRL_WHICH_CUR_VAL;
    all.count = 1;
    all.controls = &control;
  }
};

}  // namespace

VideoControls::VideoControls(VideoSystem& system, int fd, std::string name)
    : system_(system), fd_(fd), name_(std::move(name)) {
  // A device that lists without end is broken.
  constexpr size_t most_controls = 512;
  auto control = query(V4L2_CTRL_FLAG_NEXT_CTRL);
  while (controls_.size() < most_controls && system_.control(fd_, VIDIOC_QUERY_EXT_CTRL, &control) >= 0) {
    const uint32_t id = control.id;
    if (is_number(control.type) && (control.flags & V4L2_CTRL_FLAG_DISABLED) == 0)
      controls_[id] = {
          plain_name(control.name, sizeof control.name),           id, control.type, control.minimum, control.maximum,
          std::max<int64_t>(1, static_cast<int64_t>(control.step))};
    control = query(id | V4L2_CTRL_FLAG_NEXT_CTRL);
  }
}

const VideoControls::Control* VideoControls::find(uint32_t id) const {
  const auto found = controls_.find(id);
  return found == controls_.end() ? nullptr : &found->second;
}

bool VideoControls::inactive(uint32_t id) const {
  auto control = query(id);
  return system_.control(fd_, VIDIOC_QUERY_EXT_CTRL, &control) >= 0 && (control.flags & V4L2_CTRL_FLAG_INACTIVE) != 0;
}

bool VideoControls::menu_offers(const Control& control, int64_t value) const {
  v4l2_querymenu entry;
  std::memset(&entry, 0, sizeof entry);
  entry.id = control.id;
  entry.index = static_cast<uint32_t>(value);
  return value >= control.minimum && value <= control.maximum && system_.control(fd_, VIDIOC_QUERYMENU, &entry) >= 0;
}

std::string VideoControls::range(const Control& control, const Request& request) const {
  std::string text;
  if (is_menu(control.type)) {
    for (int64_t i = control.minimum; i <= control.maximum; ++i)
      if (menu_offers(control, i)) text += (text.empty() ? "" : ", ") + std::to_string(i);
    return "one of " + text;
  }
  text = std::to_string(control.minimum * request.unit) + " … " + std::to_string(control.maximum * request.unit) +
         request.suffix;
  if (control.step * request.unit > 1)
    text += " in steps of " + std::to_string(control.step * request.unit) + request.suffix;
  return text;
}

Result<int64_t> VideoControls::read(const Control& control) const {
  Exchange exchange(control.id, control.type, 0);
  if (const int result = system_.control(fd_, VIDIOC_G_EXT_CTRLS, &exchange.all); result < 0)
    return system_error(name_, "its " + control.name + " cannot be read", -result);
  return control.type == V4L2_CTRL_TYPE_INTEGER64 ? int64_t{exchange.control.value64} : int64_t{exchange.control.value};
}

Result<void> VideoControls::write(const Control& control, const Request& request) {
  const auto refused = [&](const std::string& why) {
    return Error{ErrorCode::invalid_argument,
                 name_ + ": " + request.setting + " is " + std::to_string(request.value) + ", " + why};
  };
  const int64_t value = request.value / request.unit;
  const bool possible = is_menu(control.type)
                            ? menu_offers(control, value)
                            : request.value % request.unit == 0 && value >= control.minimum &&
                                  value <= control.maximum && (value - control.minimum) % control.step == 0;
  if (!possible) return refused("this camera takes " + range(control, request));
  Exchange exchange(control.id, control.type, value);
  const int result = system_.control(fd_, VIDIOC_S_EXT_CTRLS, &exchange.all);
  if (result == -EACCES || result == -EBUSY)
    return refused("which the camera refuses while one of its automatics governs it, or as it is read-only");
  if (result == -EINVAL || result == -ERANGE)
    return refused("which the camera refuses; it says it takes " + range(control, request));
  if (result < 0) return system_error(name_, "its " + request.setting + " cannot be set", -result);
  const auto got = read(control);
  if (!got) return got.error();
  if (*got != value)
    return refused("but the camera set it to " + std::to_string(*got * request.unit) + "; it says it takes " +
                   range(control, request));
  return {};
}

Result<void> VideoControls::write_first(const std::vector<uint32_t>& ids, const Request& request) {
  for (const uint32_t id : ids)
    if (const Control* control = find(id)) return write(*control, request);
  return Error{ErrorCode::invalid_argument,
               name_ + ": " + request.setting + " is set, but this camera has no such control"};
}

Result<void> VideoControls::switch_off(uint32_t automatic, int64_t off, const std::string& setting) {
  const Control* control = find(automatic);
  if (control == nullptr) return {};
  if (is_menu(control->type) && !menu_offers(*control, off))
    return Error{ErrorCode::invalid_argument,
                 name_ + ": " + setting + " is set, but this camera's " + control->name + " has no manual mode"};
  return write(*control, {.setting = control->name, .value = off});
}

Result<void> VideoControls::apply_named(const std::map<std::string, int64_t>& values) {
  struct Named {
    const Control* control;
    Request request;
  };
  std::vector<Named> pending;
  for (const auto& [name, value] : values) {
    const auto found = std::find_if(controls_.begin(), controls_.end(),
                                    [&wanted = name](const auto& entry) { return entry.second.name == wanted; });
    if (found == controls_.end()) {
      std::string known;
      for (const auto& [id, control] : controls_) known += (known.empty() ? "" : ", ") + control.name;
      return Error{ErrorCode::invalid_argument,
                   name_ + ": controls." + name + " is set, but this camera has no such control; it has " + known};
    }
    pending.push_back({&found->second, {.setting = "controls." + name, .value = value}});
  }
  // What an automatic governs can be set once that is off, which may be among the settings too.
  std::stable_partition(pending.begin(), pending.end(),
                        [&](const Named& named) { return !inactive(named.control->id); });
  for (const Named& named : pending)
    if (auto written = write(*named.control, named.request); !written) return written;
  return {};
}

Result<void> VideoControls::apply(const V4l2CameraSettings& settings, const std::optional<int>& exposure_us) {
  struct Step {
    const char* setting;
    const std::optional<int>& value;
    uint32_t automatic;
    int64_t off;
    std::vector<uint32_t> controls;
    int64_t unit;
    const char* suffix;
  };
  const Step steps[] = {{"exposure_us",
                         exposure_us,
                         V4L2_CID_EXPOSURE_AUTO,
                         V4L2_EXPOSURE_MANUAL,
                         {V4L2_CID_EXPOSURE_ABSOLUTE},
                         exposure_unit_us,
                         " µs"},
                        {"gain", settings.gain, V4L2_CID_AUTOGAIN, 0, {V4L2_CID_GAIN, V4L2_CID_ANALOGUE_GAIN}, 1, ""},
                        {"white_balance_k",
                         settings.white_balance_k,
                         V4L2_CID_AUTO_WHITE_BALANCE,
                         0,
                         {V4L2_CID_WHITE_BALANCE_TEMPERATURE},
                         1,
                         " K"},
                        {"focus", settings.focus, V4L2_CID_FOCUS_AUTO, 0, {V4L2_CID_FOCUS_ABSOLUTE}, 1, ""}};
  // Otherwise the frame rate sags in the dark.
  if (exposure_us)
    if (auto fixed_rate = switch_off(V4L2_CID_EXPOSURE_AUTO_PRIORITY, 0, "exposure_us"); !fixed_rate) return fixed_rate;
  for (const Step& step : steps) {
    if (!step.value) continue;
    if (auto manual = switch_off(step.automatic, step.off, step.setting); !manual) return manual;
    if (auto written = write_first(step.controls, {step.setting, *step.value, step.unit, step.suffix}); !written)
      return written;
  }
  return apply_named(settings.controls);
}

std::optional<int> VideoControls::exposure_us() const {
  const Control* control = find(V4L2_CID_EXPOSURE_ABSOLUTE);
  if (control == nullptr) return std::nullopt;
  const auto value = read(*control);
  if (!value) return std::nullopt;
  return static_cast<int>(*value * exposure_unit_us);
}

}  // namespace booth
