#include "tests/virtual_booth/guest/guest_booth.h"

#include <cstdlib>
#include <stdexcept>
#include <utility>

namespace booth {

GuestBooth::GuestBooth() {
  // libusb hears from it of devices that are plugged in later.
  if (std::system("/lib/systemd/systemd-udevd --daemon") != 0) throw std::runtime_error("udevd does not run");
  for (const char* module : {"gpio-sim", "vhci-hcd", "uvcvideo", "vkms"})
    if (std::system((std::string("modprobe ") + module).c_str()) != 0)
      throw std::runtime_error(std::string("the kernel has no module ") + module);
  gpio_ = std::make_unique<GpioPeer>(8, std::vector<std::string>{"camera-trigger", "lights", "step", "reset"},
                                     [this](const GpioPeer::Edge& edge) {
                                       if (edge.line != trigger_line || edge.level != 1) return;
                                       const std::lock_guard lock(mutex_);
                                       if (at_trigger_) at_trigger_(edge);
                                       for (UsbCameraPeer* camera : cameras_) camera->expose();
                                     });
}

void GuestBooth::wire(UsbCameraPeer& camera) {
  const std::lock_guard lock(mutex_);
  cameras_.insert(&camera);
}

void GuestBooth::unwire(UsbCameraPeer& camera) {
  const std::lock_guard lock(mutex_);
  cameras_.erase(&camera);
}

void GuestBooth::at_trigger(std::function<void(const GpioPeer::Edge&)> action) {
  const std::lock_guard lock(mutex_);
  at_trigger_ = std::move(action);
}

GuestBooth& GuestBooth::instance() {
  static GuestBooth booth;
  return booth;
}

}  // namespace booth
