#pragma once

#include <algorithm>
#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <utility>

#include "daemon/event.h"
#include "drivers/clock.h"
#include "pipeline/types/result.h"

namespace booth {

/// Whether opening a device again is of no use as long as nobody changes anything.
inline bool is_permanent(ErrorCode code) {
  return code == ErrorCode::invalid_argument || code == ErrorCode::unsupported || code == ErrorCode::not_found;
}

struct DeviceStatus {
  std::string name;  ///< the projector's id, the trigger's driver
  DeviceState state = DeviceState::offline;
  std::string message;
  bool permanent = false;  ///< what keeps it offline does not mend itself
};

/// Keeps one device (the trigger, the projector) open: opens it again after a loss, with growing patience. One thread
/// uses the device; any thread may ask for the status.
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
    if (!opened) {
      set(DeviceState::offline, opened.error());
      return opened.error();
    }
    device_ = std::move(*opened);
    set(DeviceState::online, {});
    return device_.get();
  }
  /// Tries to open it where it is not there and it is time to try again.
  void tend(std::chrono::steady_clock::time_point now) {
    if (device_ || now < next_try_) return;
    if (get()) {
      patience_ = first_patience;
      return;
    }
    next_try_ = now + patience_;
    patience_ = std::min(2 * patience_, most_patience);
  }
  /// Closes it; the next get() opens it with what is configured then.
  void reopen() {
    device_.reset();
    next_try_ = {};
  }
  /// It is gone, or misbehaves: the next get() opens it anew.
  void lose(const Error& error) {
    device_.reset();
    set(DeviceState::offline, error);
  }
  DeviceStatus status() const {
    const std::lock_guard lock(mutex_);
    return status_;
  }

 private:
  static constexpr std::chrono::milliseconds first_patience{1000}, most_patience{10'000};

  void set(DeviceState state, const Error& error) {
    const std::lock_guard lock(mutex_);
    status_.state = state;
    status_.message = error.message;
    status_.permanent = state == DeviceState::offline && is_permanent(error.code);
  }

  const Open open_;
  std::unique_ptr<Device> device_;
  std::chrono::steady_clock::time_point next_try_{};
  std::chrono::milliseconds patience_ = first_patience;
  mutable std::mutex mutex_;
  DeviceStatus status_;  ///< guarded by mutex_
};

}  // namespace booth
