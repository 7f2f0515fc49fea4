#include "drivers/aravis/features.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <memory>

#include "drivers/aravis/gobject.h"

namespace booth {
namespace {

/// Cameras keep times and gains in steps of their own: less than this share off is as good as set.
constexpr double relative_step = 0.005;
constexpr double absolute_step = 0.01;

std::string quoted(const std::string& text) { return "\"" + text + "\""; }

}  // namespace

std::string number_text(double value) {
  char text[64];
  if (std::abs(value - std::round(value)) < 1e-9 * std::max(1.0, std::abs(value)) && std::abs(value) < 1e15)
    std::snprintf(text, sizeof text, "%.0f", value);
  else
    std::snprintf(text, sizeof text, "%.6g", value);
  return text;
}

Error Features::refuse(const std::string& setting, const std::string& what) const {
  return {ErrorCode::invalid_argument, "camera " + id_ + ": " + setting + ": " + what};
}

Error Features::failed(const std::string& what, const GErrorSlot& error) const {
  return {error.is_loss() ? ErrorCode::device_lost : ErrorCode::unsupported,
          "camera " + id_ + ": " + what + ": " + error.message()};
}

bool Features::has(const char* feature) const {
  GErrorSlot error;
  if (!arv_camera_is_feature_implemented(camera_, feature, error.out()) || error) return false;
  return arv_camera_is_feature_available(camera_, feature, error.out()) && !error;
}

std::vector<std::string> Features::entries(const char* feature) const {
  GErrorSlot error;
  guint count = 0;
  const std::unique_ptr<const char*, void (*)(gpointer)> names(
      arv_camera_dup_available_enumerations_as_strings(camera_, feature, &count, error.out()), g_free);
  std::vector<std::string> found;
  for (guint i = 0; names && i < count; ++i) found.emplace_back(names.get()[i]);
  return found;
}

Result<void> Features::check_read_back(double got, double wanted, double tolerance, const std::string& setting) const {
  if (std::abs(got - wanted) <= tolerance) return {};
  return refuse(setting, number_text(wanted) + ", but the camera made it " + number_text(got));
}

Result<void> Features::set_float(const char* feature, double value, const std::string& setting) const {
  if (!has(feature)) return Error{ErrorCode::unsupported, "camera " + id_ + ": " + setting + ": it has no " + feature};
  GErrorSlot error;
  double lowest = 0, highest = 0;
  arv_camera_get_float_bounds(camera_, feature, &lowest, &highest, error.out());
  if (error) return failed(setting, error);
  if (value < lowest || value > highest)
    return refuse(setting, number_text(value) + ", but the camera's range is " + number_text(lowest) + " … " +
                               number_text(highest));
  arv_camera_set_float(camera_, feature, value, error.out());
  if (error) return failed(setting, error);
  const double got = arv_camera_get_float(camera_, feature, error.out());
  if (error) return failed(setting, error);
  const double step = arv_camera_get_float_increment(camera_, feature, error.out());
  // Without a step of its own, Aravis says the smallest number there is.
  const double tolerance = std::max({relative_step * std::abs(value), absolute_step, error ? 0.0 : step});
  return check_read_back(got, value, tolerance, setting);
}

Result<void> Features::set_integer(const char* feature, int64_t value, const std::string& setting) const {
  if (!has(feature)) return Error{ErrorCode::unsupported, "camera " + id_ + ": " + setting + ": it has no " + feature};
  GErrorSlot error;
  gint64 lowest = 0, highest = 0;
  arv_camera_get_integer_bounds(camera_, feature, &lowest, &highest, error.out());
  if (error) return failed(setting, error);
  const gint64 step = std::max<gint64>(1, arv_camera_get_integer_increment(camera_, feature, error.out()));
  const std::string range = std::to_string(lowest) + " … " + std::to_string(highest) +
                            (step > 1 ? " in steps of " + std::to_string(step) : "");
  if (value < lowest || value > highest || (value - lowest) % step != 0)
    return refuse(setting, std::to_string(value) + ", but the camera's range is " + range);
  arv_camera_set_integer(camera_, feature, value, error.out());
  if (error) return failed(setting, error);
  const auto got = arv_camera_get_integer(camera_, feature, error.out());
  if (error) return failed(setting, error);
  return check_read_back(static_cast<double>(got), static_cast<double>(value), 0, setting);
}

Result<void> Features::write_integer(const char* feature, int64_t value, const std::string& setting) const {
  GErrorSlot error;
  arv_camera_set_integer(camera_, feature, value, error.out());
  if (error) return failed(setting, error);
  return {};
}

Result<void> Features::set_entry(const char* feature, const std::string& entry, const std::string& setting) const {
  if (!has(feature)) return Error{ErrorCode::unsupported, "camera " + id_ + ": " + setting + ": it has no " + feature};
  const auto offered = entries(feature);
  if (std::find(offered.begin(), offered.end(), entry) == offered.end()) {
    std::string list;
    for (const std::string& one : offered) list += (list.empty() ? "" : ", ") + one;
    return refuse(setting, quoted(entry) + ", but the camera offers " + (list.empty() ? "nothing" : list));
  }
  GErrorSlot error;
  arv_camera_set_string(camera_, feature, entry.c_str(), error.out());
  if (error) return failed(setting, error);
  const auto got = get_text(feature);
  if (!got) return got.error();
  if (*got != entry) return refuse(setting, quoted(entry) + ", but the camera made it " + quoted(*got));
  return {};
}

Result<void> Features::set_entry_if_any(const char* feature, const std::string& entry,
                                        const std::string& setting) const {
  return has(feature) ? set_entry(feature, entry, setting) : Result<void>{};
}

Result<void> Features::set_boolean(const char* feature, bool value, const std::string& setting) const {
  if (!has(feature)) return Error{ErrorCode::unsupported, "camera " + id_ + ": " + setting + ": it has no " + feature};
  GErrorSlot error;
  arv_camera_set_boolean(camera_, feature, value ? TRUE : FALSE, error.out());
  if (error) return failed(setting, error);
  const bool got = arv_camera_get_boolean(camera_, feature, error.out()) != FALSE;
  if (error) return failed(setting, error);
  if (got != value) return refuse(setting, std::string(value ? "true" : "false") + ", but the camera did not take it");
  return {};
}

Result<void> Features::set_from_text(const std::string& feature, const std::string& value) const {
  const std::string setting = "features." + feature;
  ArvGcNode* node = arv_device_get_feature(arv_camera_get_device(camera_), feature.c_str());
  if (node == nullptr) return refuse(setting, "the camera has no such feature");
  if (ARV_IS_GC_COMMAND(node)) return execute(feature.c_str());
  if (ARV_IS_GC_ENUMERATION(node)) return set_entry(feature.c_str(), value, setting);
  if (ARV_IS_GC_BOOLEAN(node)) {
    if (value != "true" && value != "false") return refuse(setting, quoted(value) + ", expected true or false");
    return set_boolean(feature.c_str(), value == "true", setting);
  }
  if (ARV_IS_GC_FLOAT(node) || ARV_IS_GC_INTEGER(node)) {
    char* end = nullptr;
    const double number = g_ascii_strtod(value.c_str(), &end);
    if (value.empty() || *end != '\0' || !std::isfinite(number))
      return refuse(setting, quoted(value) + ", expected a number");
    if (ARV_IS_GC_FLOAT(node)) return set_float(feature.c_str(), number, setting);
    if (number != std::round(number) || std::abs(number) > 9e15)
      return refuse(setting, quoted(value) + ", expected a whole number");
    return set_integer(feature.c_str(), static_cast<int64_t>(number), setting);
  }
  GErrorSlot error;
  arv_camera_set_string(camera_, feature.c_str(), value.c_str(), error.out());
  if (error) return failed(setting, error);
  const auto got = get_text(feature.c_str());
  if (!got) return got.error();
  if (*got != value) return refuse(setting, quoted(value) + ", but the camera made it " + quoted(*got));
  return {};
}

Result<double> Features::get_float(const char* feature) const {
  GErrorSlot error;
  const double value = arv_camera_get_float(camera_, feature, error.out());
  if (error) return failed(feature, error);
  return value;
}

Result<int64_t> Features::get_integer(const char* feature) const {
  GErrorSlot error;
  const int64_t value = arv_camera_get_integer(camera_, feature, error.out());
  if (error) return failed(feature, error);
  return value;
}

Result<std::string> Features::get_text(const char* feature) const {
  GErrorSlot error;
  const char* value = arv_camera_get_string(camera_, feature, error.out());
  if (error) return failed(feature, error);
  return std::string(value != nullptr ? value : "");
}

Result<void> Features::execute(const char* command) const {
  GErrorSlot error;
  arv_camera_execute_command(camera_, command, error.out());
  if (error) return failed(command, error);
  return {};
}

}  // namespace booth
