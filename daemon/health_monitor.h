#pragma once

#include <chrono>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "config/booth_config.h"
#include "daemon/event_bus.h"
#include "pipeline/types/camera_health.h"

namespace booth {

/// Whether the calibration and the background still fit what the cameras see. Any thread.
class HealthMonitor {
 public:
  HealthMonitor(BackgroundConfig config, EventBus& events) : config_(config), events_(events) {}

  /// What the latest capture says: an alert of the kind calibration_drift for each camera that was moved, which its
  /// silhouette or its background tells, one of the kind background_stale where the light is no longer that of the
  /// background.
  void report(const std::string& capture, const std::vector<CameraHealth>& cameras);

  /// By camera, of the latest capture.
  std::vector<CameraHealth> cameras() const;
  /// Ids of those that no longer stand where they were calibrated; those whose background showed it stay among them
  /// when the background is learned anew, until the booth is calibrated.
  std::vector<std::string> moved() const;

  /// The calibration is another one now: nothing is known against it. Until the background is learned again, what has
  /// shifted against it may have done so before, and tells nothing.
  void calibrated();
  /// The background was learned anew.
  void background_learned();

  /// Why the background is to be learned again, a sentence; nothing while it fits.
  /// @param age  of the background; nothing when it does not grow old
  std::optional<std::string> staleness(std::optional<std::chrono::seconds> age) const;

  /// The booth could not learn it by itself: asks an operator, once for each background.
  void ask_for_background(const std::string& why);

 private:
  const BackgroundConfig config_;
  EventBus& events_;
  mutable std::mutex mutex_;
  std::vector<CameraHealth> cameras_;  ///< guarded by mutex_
  std::set<std::string> displaced_;    ///< guarded by mutex_; shifted against a background before the present one
  bool older_background_ = false;      ///< guarded by mutex_; than the calibration
  std::optional<std::string> light_;   ///< guarded by mutex_; a sentence: how the light has changed
  bool asked_ = false;                 ///< guarded by mutex_
};

}  // namespace booth
