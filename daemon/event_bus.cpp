#include "daemon/event_bus.h"

#include <utility>

#include "daemon/identifier.h"

namespace booth {

std::string_view to_string(BoothState state) {
  switch (state) {
    case BoothState::starting: return "starting";
    case BoothState::idle: return "idle";
    case BoothState::countdown: return "countdown";
    case BoothState::capturing: return "capturing";
    case BoothState::learning_background: return "learning_background";
    case BoothState::calibrating: return "calibrating";
    case BoothState::fault: return "fault";
    case BoothState::stopping: return "stopping";
  }
  return "fault";
}

std::string_view to_string(DeviceState state) {
  switch (state) {
    case DeviceState::online: return "online";
    case DeviceState::offline: return "offline";
    case DeviceState::degraded: return "degraded";
  }
  return "offline";
}

std::string_view to_string(TaskKind kind) {
  switch (kind) {
    case TaskKind::discover: return "discover";
    case TaskKind::background: return "background";
    case TaskKind::trigger_test: return "trigger_test";
    case TaskKind::projector_calibration: return "projector_calibration";
    case TaskKind::calibration_capture: return "calibration_capture";
    case TaskKind::calibration_solve: return "calibration_solve";
  }
  return "discover";
}

std::string_view to_string(TaskState state) {
  switch (state) {
    case TaskState::running: return "running";
    case TaskState::done: return "done";
    case TaskState::failed: return "failed";
  }
  return "failed";
}

std::string_view to_string(Severity severity) {
  switch (severity) {
    case Severity::info: return "info";
    case Severity::warning: return "warning";
    case Severity::error: return "error";
  }
  return "error";
}

EventBus::EventBus(size_t capacity) : boot_(random_hex(16)), queue_(capacity) {}

void EventBus::publish(Event event) {
  {
    const std::lock_guard lock(mutex_);
    NumberedEvent numbered{++sequence_, std::chrono::system_clock::now(), std::move(event)};
    if (!queue_.try_push(std::move(numbered))) ++lost_;
  }
  wakeup_.signal();
}

uint64_t EventBus::sequence() const {
  const std::lock_guard lock(mutex_);
  return sequence_;
}

}  // namespace booth
