#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "pipeline/types/image.h"

namespace booth {

/// A USB3 Vision camera in user space, plugged into the kernel's virtual host controller (vhci-hcd): bootstrap
/// registers, a GenICam description with the features of the virtual GigE camera, and a stream of grey pictures. It
/// exposes when its trigger line is pulsed, or ten times a second where no trigger is on.
/// Sources: USB3 Vision 1.0 and GenCP 1.1 as Aravis 0.8 speaks them; the kernel's Documentation/usb/usbip_protocol.rst.
class Usb3VisionPeer {
 public:
  /// @param pictures  grey ones of one size, exposed in turn, from the first again after the last
  Usb3VisionPeer(std::string serial, std::vector<std::shared_ptr<const Image>> pictures);
  ~Usb3VisionPeer();
  Usb3VisionPeer(const Usb3VisionPeer&) = delete;
  Usb3VisionPeer& operator=(const Usb3VisionPeer&) = delete;

  /// Returns when the kernel shows it. @return whether it ever did
  bool plug_in();
  /// Returns when the kernel has noticed.
  void unplug();
  /// The trigger line. Ignored while it does not acquire or still reads out, as cameras do.
  void expose();
  /// Of the next frame half is missing.
  void cut_next_frame();
  /// A feature's floating-point register: 0x8050 is ExposureTime.
  double float_register(uint32_t address) const;

 private:
  using Bytes = std::vector<uint8_t>;
  struct Request {
    uint32_t command, sequence, device, direction, endpoint;
    uint32_t words[5];
    uint8_t setup[8];
  };
  struct Pending {
    uint32_t sequence;
    uint32_t length;
  };

  void reset();
  void run();
  bool serve();
  void reply(uint32_t sequence, int status, const Bytes& data, uint32_t length);
  void answer_standard_request(const Request& request);
  Bytes execute(const Bytes& command);
  void written(uint32_t address);
  uint32_t word(uint32_t address) const;
  void set_word(uint32_t address, uint32_t value);
  void begin_frame();
  void pump();

  const std::string serial_;
  const std::vector<std::shared_ptr<const Image>> pictures_;

  mutable std::mutex mutex_;
  // Below: guarded by mutex_.
  Bytes memory_;
  int socket_ = -1;
  size_t next_picture_ = 0;
  uint64_t frame_id_ = 0;
  bool cut_next_ = false;
  std::map<uint32_t, std::deque<Pending>> pending_;  ///< bulk transfers to the host that it waits for, by endpoint
  std::deque<Bytes> answers_;                        ///< of the control channel
  std::deque<Bytes> sending_;                        ///< the frame: leader, payload, trailer

  std::jthread thread_;
};

}  // namespace booth
