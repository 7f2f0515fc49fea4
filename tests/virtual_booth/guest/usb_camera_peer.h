#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

namespace booth {

/// A USB Video Class camera in user space, plugged into the kernel's virtual host controller (vhci-hcd), so that the
/// product meets the kernel's own uvcvideo driver. It exposes a frame when it is told to, or all the time.
/// Sources: USB Device Class Definition for Video Devices 1.1; the kernel's Documentation/usb/usbip_protocol.rst.
class UsbCameraPeer {
 public:
  struct Mode {
    std::string fourcc;  ///< "MJPG", "YUYV", "GREY", "RGGB"
    int width = 0;
    int height = 0;
  };
  enum class Fault {
    none,
    error_bit,  ///< the camera itself marks the frame as damaged
    cut_short,  ///< half of it is missing
    swallow     ///< it never comes
  };

  /// @param free_running  exposes all the time at the rate that was agreed on, else on expose()
  UsbCameraPeer(std::string serial, std::vector<Mode> modes, bool free_running);
  ~UsbCameraPeer();
  UsbCameraPeer(const UsbCameraPeer&) = delete;
  UsbCameraPeer& operator=(const UsbCameraPeer&) = delete;

  /// Returns when the kernel's driver shows its video node. @return that node, or nothing if it never came
  std::optional<std::string> plug_in();
  /// Returns when the node is gone.
  void unplug();

  /// What is exposed in turn, from the first again after the last.
  void set_frames(std::vector<std::vector<uint8_t>> frames);
  /// The trigger line. Ignored while it does not stream or still reads out, as cameras do.
  void expose();
  void fail_next(Fault fault);

  int exposed() const;  ///< frames that were begun, swallowed ones included
  int missed() const;   ///< triggers that were ignored
  /// A control as the host set it: entity 1 is the camera terminal, 2 the processing unit.
  uint32_t control(int entity, int selector) const;

 private:
  using Bytes = std::vector<uint8_t>;
  struct Control {
    int entity, selector;
    size_t size;
    uint32_t minimum, maximum, step, initial, value;
  };
  struct Request {
    uint32_t command, sequence, device, direction, endpoint;
    uint32_t words[5];
    uint8_t setup[8];
  };
  struct Pending {
    uint32_t sequence;
    uint32_t length;
  };

  void describe();
  Bytes stream_parameters(int format, uint32_t interval) const;
  void run();
  bool serve();
  void answer_control(const Request& request, const Bytes& data);
  std::optional<Bytes> standard_request(const Request& request);
  std::optional<Bytes> class_request(const Request& request, const Bytes& data);
  void reply(uint32_t sequence, int status, const Bytes& data, uint32_t length);
  void begin_frame();
  void pump();
  size_t frame_size(const Mode& mode) const;

  const std::string serial_;
  const std::vector<Mode> modes_;
  const bool free_running_;
  Bytes configuration_;

  mutable std::mutex mutex_;
  // Below: guarded by mutex_.
  std::vector<Control> controls_;
  std::vector<Bytes> frames_;
  size_t next_frame_ = 0;
  int exposed_ = 0;
  int missed_ = 0;
  Fault fault_ = Fault::none;
  int socket_ = -1;
  bool streaming_ = false;
  Bytes probe_, commit_;
  int64_t interval_ns_ = 0;
  std::deque<Pending> pending_;  ///< bulk transfers that the host waits for
  Bytes sending_;
  size_t sent_ = 0;
  bool sends_ = false;
  bool marks_error_ = false;
  uint8_t frame_toggle_ = 0;

  std::jthread thread_;
};

}  // namespace booth
