#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "pipeline/types/image.h"

namespace booth::virtual_booth {

struct GigeCameraOptions {
  std::string address = {};  ///< one of this network's own IPv4 addresses
  std::string serial = "VB0001";
  std::string model = "GigE";
  /// What the sensor sees, exposure after exposure, from the first again after the last: RGB or grey, all one size.
  std::vector<std::shared_ptr<const Image>> scenes = {};
  int path_mtu = 1500;                      ///< larger packets do not arrive
  bool resend = true;                       ///< answers requests for lost packets
  bool counts_from_acquisition = true;      ///< block ids begin at 1 with each acquisition, as most cameras' do
  uint64_t tick_frequency = 1'000'000'000;  ///< of the device's clock
  double clock_error_ppm = 0;               ///< how much faster than this machine's it runs
  bool shares_clock = false;                ///< it shows this machine's time, as all cameras that follow one PTP master
  bool offers_ptp = true;
  std::string lacks = {};  ///< a feature of the description that it has not
  std::string keeps = {};  ///< a feature, as feature() knows it, that is written without effect
  double largest_exposure_us = 1'000'000;
};

/// What a camera has gone through since it was switched on.
struct GigeCameraReport {
  bool controlled = false;  ///< a client holds the control channel
  bool acquiring = false;
  bool armed = false;  ///< a pulse on Line1 now exposes
  uint64_t exposures = 0;
  uint64_t unanswered = 0;  ///< triggers that came while it was not armed or still busy
  uint64_t packets_sent = 0;
  uint64_t packets_lost = 0;
  uint64_t packets_resent = 0;
  uint64_t commands = 0;  ///< GVCP packets that were understood
};

/// A GigE Vision camera without a sensor: answers GVCP and sends GVSP as the standard says (discovery, registers with a
/// GenICam description, control privilege and heartbeat, test packets, packet resend, action commands, timestamps), and
/// goes wrong on demand. It has a thread of its own; every function may be called from any other.
class GigeCamera {
 public:
  /// Switches it on. @throw std::system_error where its address cannot be bound
  explicit GigeCamera(GigeCameraOptions options);
  ~GigeCamera();

  /// A pulse on the trigger line: one exposure, if it is armed. Returns at once.
  void pulse();

  /// What is in front of it from the next exposure on; one or more, of the size that it saw before.
  void see(std::vector<std::shared_ptr<const Image>> scenes);

  /// Loses this share of all stream packets, resent ones included.
  void lose_packets(double share);
  /// Loses that many packets of the next frame, spread over it; they can be had again.
  void lose_of_next_frame(int packets);
  /// Of the next frame nothing is ever sent.
  void swallow_next_frame();
  /// The next frame has only its first half, and the rest cannot be had again.
  void cut_next_frame();
  /// Exposes once though nothing triggered it, as a disturbed trigger line makes a camera do.
  void expose_untriggered();
  /// A hung camera: neither answers nor sends.
  void mute(bool muted);
  /// Power off: it is gone at once, without a word. And on again, all settings forgotten.
  void power_off();
  void power_on();
  /// What PtpStatus says: "Slave", "Listening", "Faulty" …
  void set_ptp_status(const std::string& status);

  GigeCameraReport report() const;
  /// Register of a feature, as the client last wrote it: "ExposureTime" …
  double feature(const std::string& name) const;
  const std::string& address() const { return options_.address; }

 private:
  class Device;
  void post(std::function<void(Device&)> order);
  void run(const std::stop_token& stop);

  const GigeCameraOptions options_;
  const int wake_;  ///< eventfd
  mutable std::mutex mutex_;
  std::deque<std::function<void(Device&)>> orders_;  ///< guarded by mutex_
  GigeCameraReport report_;                          ///< guarded by mutex_
  std::map<std::string, double> features_;           ///< guarded by mutex_
  std::condition_variable carried_out_;
  uint64_t posted_ = 0, done_ = 0;  ///< guarded by mutex_
  std::jthread thread_;
};

/// A network of its own for this process: nothing but the loopback interface, up, with the addresses 127.0.0.1 …
/// 127.0.0.(cameras + 10). Call it while the process has one thread.
/// @return empty, or why this machine does not let us
std::string enter_own_network(int addresses);
/// The address of the camera of that number, from 0: 127.0.0.11 …
std::string camera_address(int number);

}  // namespace booth::virtual_booth
