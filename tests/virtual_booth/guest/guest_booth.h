#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <vector>

#include "tests/virtual_booth/guest/gpio_peer.h"
#include "tests/virtual_booth/guest/usb_camera_peer.h"

namespace booth {

/// The emulated machine's hardware, wired as in a booth: the trigger line goes to every camera.
class GuestBooth {
 public:
  static constexpr int trigger_line = 0;
  static constexpr int lights_line = 1;
  static constexpr int step_line = 2;
  static constexpr int reset_line = 3;
  static constexpr const char* card = "/dev/dri/card0";

  GuestBooth();

  GpioPeer& gpio() { return *gpio_; }
  void wire(UsbCameraPeer& camera);
  void unwire(UsbCameraPeer& camera);
  /// Called at each pulse before the cameras expose, in a thread of the peer; an empty one: nothing is.
  void at_trigger(std::function<void(const GpioPeer::Edge&)> action);

  /// The booth of this program.
  static GuestBooth& instance();

 private:
  std::mutex mutex_;
  std::set<UsbCameraPeer*> cameras_;                       ///< guarded by mutex_
  std::function<void(const GpioPeer::Edge&)> at_trigger_;  ///< guarded by mutex_
  std::unique_ptr<GpioPeer> gpio_;
};

/// A camera that is wired to the trigger line while it lives.
class WiredCamera {
 public:
  WiredCamera(const std::string& serial, std::vector<UsbCameraPeer::Mode> modes)
      : peer(serial, std::move(modes), false) {
    GuestBooth::instance().wire(peer);
  }
  ~WiredCamera() { GuestBooth::instance().unwire(peer); }
  WiredCamera(const WiredCamera&) = delete;
  WiredCamera& operator=(const WiredCamera&) = delete;

  UsbCameraPeer peer;
};

}  // namespace booth
