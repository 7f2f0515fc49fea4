#include "daemon/health_monitor.h"

#include <algorithm>
#include <sstream>

namespace booth {
namespace {

/// Of the cameras, that have to see another light: one alone is dazzled, or looks at a lamp.
constexpr double telling_share = 0.5;

std::string drift_message(const CameraHealth& camera) {
  std::ostringstream text;
  text.precision(2);
  text << "camera " << camera.camera;
  if (camera.moved)
    text << " no longer stands where it was calibrated: its picture is off by " << camera.offset_px
         << " pixels from where the other cameras expect it";
  else
    text << " no longer stands where it stood when the background was learned: its picture of the booth is off by "
         << camera.background_px << " pixels";
  text << ". Fasten it and calibrate the booth anew, or let \"boothctl calibrate --correct\" propose a correction";
  return text.str();
}

}  // namespace

void HealthMonitor::report(const std::string& capture, const std::vector<CameraHealth>& cameras) {
  std::vector<Alert> alerts;
  {
    const std::lock_guard lock(mutex_);
    cameras_ = cameras;
    if (older_background_)
      for (CameraHealth& camera : cameras_) camera.shifted = false;
    for (const CameraHealth& camera : cameras_)
      if (camera.moved || camera.shifted)
        alerts.push_back(
            {Severity::warning, "calibration_drift", drift_message(camera) + " (capture " + capture + ")"});
    std::vector<double> factors;
    for (const CameraHealth& camera : cameras) factors.push_back(camera.light_factor);
    const auto other_light =
        std::count_if(factors.begin(), factors.end(), [&](double factor) { return factor > config_.max_light_factor; });
    const bool was_known = light_.has_value();
    light_.reset();
    if (!factors.empty() && static_cast<double>(other_light) >= telling_share * static_cast<double>(factors.size())) {
      std::ostringstream text;
      text.precision(2);
      text << "the light has changed by a factor of up to " << *std::max_element(factors.begin(), factors.end())
           << " for " << other_light << " of " << factors.size() << " cameras";
      light_ = text.str();
      if (!was_known)
        alerts.push_back({Severity::warning, "background_stale",
                          *light_ + " since the background was learned: learn it again with nobody in the booth"});
    }
  }
  for (Alert& alert : alerts) events_.publish(std::move(alert));
}

std::vector<CameraHealth> HealthMonitor::cameras() const {
  const std::lock_guard lock(mutex_);
  return cameras_;
}

std::vector<std::string> HealthMonitor::moved() const {
  const std::lock_guard lock(mutex_);
  std::vector<std::string> ids;
  for (const CameraHealth& camera : cameras_)
    if (camera.moved || camera.shifted || displaced_.contains(camera.camera)) ids.push_back(camera.camera);
  return ids;
}

void HealthMonitor::calibrated() {
  const std::lock_guard lock(mutex_);
  displaced_.clear();
  older_background_ = true;
  for (CameraHealth& camera : cameras_) {
    camera.moved = camera.shifted = false;
    camera.offset_px = camera.deviation = 0;
  }
}

void HealthMonitor::background_learned() {
  const std::lock_guard lock(mutex_);
  older_background_ = false;
  light_.reset();
  asked_ = false;
  for (CameraHealth& camera : cameras_) {
    if (camera.shifted) displaced_.insert(camera.camera);
    camera.shifted = false;
    camera.light_factor = camera.background_share = 1;
    camera.background_px = 0;
  }
}

std::optional<std::string> HealthMonitor::staleness(std::optional<std::chrono::seconds> age) const {
  {
    const std::lock_guard lock(mutex_);
    if (light_) return *light_ + " since the background was learned";
  }
  if (config_.max_age_h == 0 || !age || *age < std::chrono::hours(config_.max_age_h)) return std::nullopt;
  return "the background was learned " + std::to_string(std::chrono::floor<std::chrono::hours>(*age).count()) +
         " hours ago";
}

void HealthMonitor::ask_for_background(const std::string& why) {
  {
    const std::lock_guard lock(mutex_);
    if (asked_) return;
    asked_ = true;
  }
  events_.publish(Alert{Severity::warning, "background_stale",
                        why + ": empty the booth and learn its background (boothctl background learn)"});
}

}  // namespace booth
