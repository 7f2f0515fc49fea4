#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <utility>

#include "daemon/event.h"
#include "drivers/clock.h"
#include "pipeline/types/result.h"

namespace booth {

struct DeviceStatus {
  std::string name;  ///< the projector's id, the trigger's driver
  DeviceState state = DeviceState::offline;
  std::string message;
};

/// Keeps one device (the trigger, the projector) open: opens it again after a loss. One thread uses the device; any
/// thread may ask for the status.
template <class Device>
class DeviceSlot {
 public:
  using Open = std::function<Result<std::unique_ptr<Device>>()>;
  DeviceSlot(std::string name, Open open)
      : open_(std::move(open)), status_{std::move(name), DeviceState::offline, "not opened yet"} {}

  /// The device; opened first where it is not. @error what opening returns
  Result<Device*> get() {
    if (device_) return device_.get();
    auto opened = open_();
    if (!opened) return set(DeviceState::offline, opened.error().message), opened.error();
    device_ = std::move(*opened);
    set(DeviceState::online, "");
    return device_.get();
  }
  /// It is gone, or misbehaves: the next get() opens it anew.
  void lose(const Error& error) {
    device_.reset();
    set(DeviceState::offline, error.message);
  }
  DeviceStatus status() const {
    const std::lock_guard lock(mutex_);
    return status_;
  }

 private:
  void set(DeviceState state, const std::string& message) {
    const std::lock_guard lock(mutex_);
    status_.state = state;
    status_.message = message;
  }

  const Open open_;
  std::unique_ptr<Device> device_;
  mutable std::mutex mutex_;
  DeviceStatus status_;  ///< guarded by mutex_
};

}  // namespace booth
