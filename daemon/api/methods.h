#pragma once

#include <array>
#include <optional>
#include <string_view>

namespace booth::api {

/// Everything that can be asked of the booth.
enum class Method {
  system_describe,
  system_status,
  system_metrics,
  system_history,
  system_shutdown,
  camera_discover,
  preview_start,
  preview_stop,
  background_learn,
  trigger_test,
  projector_calibrate,
  calibration_capture,
  calibration_solve,
  calibration_apply,
  calibration_discard,
  calibration_restore,
  calibration_status,
  capture_start,
  capture_cancel,
  capture_delete,
  job_list,
  job_retry,
  job_cancel,
  avatar_list,
  avatar_get,
  avatar_fetch,
  avatar_delete
};

struct MethodEntry {
  Method method;
  std::string_view name;
  bool changes;  ///< changes or starts something, and so takes a `key`
};

inline constexpr std::array<MethodEntry, 27> methods{{
    {Method::system_describe, "system.describe", false},
    {Method::system_status, "system.status", false},
    {Method::system_metrics, "system.metrics", false},
    {Method::system_history, "system.history", false},
    {Method::system_shutdown, "system.shutdown", true},
    {Method::camera_discover, "camera.discover", true},
    {Method::preview_start, "preview.start", true},
    {Method::preview_stop, "preview.stop", true},
    {Method::background_learn, "background.learn", true},
    {Method::trigger_test, "trigger.test", true},
    {Method::projector_calibrate, "projector.calibrate", true},
    {Method::calibration_capture, "calibration.capture", true},
    {Method::calibration_solve, "calibration.solve", true},
    {Method::calibration_apply, "calibration.apply", true},
    {Method::calibration_discard, "calibration.discard", true},
    {Method::calibration_restore, "calibration.restore", true},
    {Method::calibration_status, "calibration.status", false},
    {Method::capture_start, "capture.start", true},
    {Method::capture_cancel, "capture.cancel", true},
    {Method::capture_delete, "capture.delete", true},
    {Method::job_list, "job.list", false},
    {Method::job_retry, "job.retry", true},
    {Method::job_cancel, "job.cancel", true},
    {Method::avatar_list, "avatar.list", false},
    {Method::avatar_get, "avatar.get", false},
    {Method::avatar_fetch, "avatar.fetch", false},
    {Method::avatar_delete, "avatar.delete", true},
}};

constexpr const MethodEntry* find_method(std::string_view name) {
  for (const MethodEntry& entry : methods)
    if (entry.name == name) return &entry;
  return nullptr;
}

}  // namespace booth::api
