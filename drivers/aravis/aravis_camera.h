#pragma once

#include <netinet/in.h>

#include <atomic>
#include <condition_variable>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "drivers/aravis/aravis_settings.h"
#include "drivers/aravis/configuration.h"
#include "drivers/aravis/device_clock.h"
#include "drivers/aravis/frame_matcher.h"
#include "drivers/aravis/gobject.h"
#include "drivers/aravis/ptp_watch.h"
#include "drivers/camera.h"
#include "drivers/clock.h"

namespace booth {

class BufferPool;

/// An open, configured camera: its control channel, its stream, and what it knows of its triggers.
///
/// Threads: Aravis receives in a thread of its own, which only announces buffers here; control features are used under
/// one lock, as GenICam trees are not thread-safe; frames are matched by the thread that waits for them.
class AravisCamera {
 public:
  using Warn = std::function<void(const std::string& sentence)>;

  /// Takes the device over, configures it, and makes its stream.
  /// @param address  of a GigE camera, to see whether it is still there; nothing for USB
  /// @param ptp      of all cameras of the source
  /// @error as Features; busy  another program controls it
  static Result<std::shared_ptr<AravisCamera>> open(GObjectPtr<ArvDevice> device, std::optional<in_addr> address,
                                                    const AravisCameraSettings& settings,
                                                    const AravisActionSettings& action, std::shared_ptr<PtpWatch> ptp,
                                                    const Clock& clock, Warn warn);
  ~AravisCamera();
  AravisCamera(const AravisCamera&) = delete;
  AravisCamera& operator=(const AravisCamera&) = delete;

  const CameraInfo& info() const { return info_; }
  const std::optional<in_addr>& address() const { return address_; }
  AravisTriggerSource trigger() const { return settings_.trigger; }
  bool is_lost() const;

  // As Camera has them.
  Result<void> arm(const CaptureSettings& settings, int count);
  Result<Frame> wait_frame(Timestamp deadline);
  void note_trigger(int index, Timestamp when) noexcept;
  Result<void> check_presence() const;
  std::vector<Statistic> statistics() const;
  std::vector<std::string> warnings() const;
  void stop() noexcept;

  /// Exposes by an order over the control channel, if it is armed. @error device_lost
  Result<void> fire_software();
  /// An instant of the booth's clock on this camera's; nothing where it cannot be asked for its time.
  std::optional<int64_t> device_time(Timestamp when) const;
  /// How far off that may be, drift since the last reading aside.
  Timestamp clock_uncertainty() const;

 private:
  /// What Aravis' threads announce; lives as long as any of its callbacks may run.
  struct Events {
    explicit Events(const Clock& clock_) : clock(clock_) {}
    const Clock& clock;
    std::mutex mutex;
    std::condition_variable changed;
    std::deque<Timestamp> arrivals;  ///< of buffers that lie in the stream's output, guarded by mutex
    bool lost = false;               ///< guarded by mutex
    bool armed = false;              ///< guarded by mutex
    bool waiting = false;            ///< a thread is in wait_frame; guarded by mutex
    FrameMatcher matcher;            ///< guarded by mutex
  };
  /// A buffer that the stream filled.
  struct Received {
    ArvBuffer* buffer = nullptr;
    uint64_t frame_id = 0;
    Timestamp exposed = 0;  ///< beginning of the exposure, on the booth's clock
  };

  AravisCamera(const AravisCameraSettings& settings, const AravisActionSettings& action, std::shared_ptr<PtpWatch> ptp,
               const Clock& clock, Warn warn);
  Result<void> configure();
  Result<void> make_stream();
  Result<void> check_packet_size();
  void enlarge_socket_buffer();
  void warn(const std::string& topic, const std::string& sentence);
  Result<void> switch_mode(CaptureMode mode);
  Result<void> apply_role(ShotRole role);
  void read_device_clock();
  void supervise_ptp();
  void restart_reception();
  Result<void> end_acquisition();
  Error lost() const;
  bool still_answers() const;
  void announce_loss();

  std::optional<Received> receive();
  bool holds_picture(const Received& received) const;
  std::optional<Result<Frame>> judge(Received received);
  Result<Frame> deliver(Received received, int index);
  std::optional<Result<Frame>> newest();
  std::optional<Result<Frame>> next();

  const AravisCameraSettings settings_;
  const AravisActionSettings action_;
  const std::shared_ptr<PtpWatch> ptp_;
  const Clock& clock_;
  const Warn warn_;
  CameraInfo info_;
  std::optional<in_addr> address_;
  AravisPicture picture_;

  const std::shared_ptr<Events> events_;
  mutable std::mutex control_;  ///< the device's features; never held while events_->mutex is
  GObjectPtr<ArvCamera> camera_;
  GObjectPtr<ArvStream> stream_;
  std::shared_ptr<BufferPool> pool_;
  std::unique_ptr<Features> features_;
  gulong loss_handler_ = 0;
  bool acquiring_ = false;                 ///< guarded by control_
  std::atomic<std::thread::id> worker_{};  ///< the thread that armed it last

  mutable std::mutex clock_mutex_;
  DeviceClock device_clock_;  ///< guarded by clock_mutex_

  CaptureMode mode_ = CaptureMode::triggered;  ///< of the thread that arms and waits, as all below
  std::optional<CaptureMode> applied_mode_;
  std::optional<ShotRole> applied_role_;
  double exposure_us_ = 0, gain_db_ = 0;  ///< as read back
  std::optional<Received> held_;          ///< whose trigger may still be noted
  int preview_index_ = -1;
  Timestamp last_sign_of_life_ = 0;

  std::atomic<uint64_t> frames_ = 0, damaged_ = 0, unwanted_ = 0, slipped_ = 0;
  std::atomic<double> temperature_ = 0, ptp_ready_ = 0;
  std::atomic<bool> has_temperature_ = false;
  std::string ptp_status_;

  mutable std::mutex warnings_mutex_;
  std::map<std::string, std::string> warnings_;  ///< by topic; guarded by warnings_mutex_
};

}  // namespace booth
