#pragma once

#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "daemon/bounded_queue.h"
#include "daemon/event.h"
#include "drivers/camera.h"
#include "drivers/clock.h"
#include "drivers/device_source.h"

namespace booth {

struct CameraStatus {
  std::string id, driver;
  CameraRole role = CameraRole::body;
  DeviceState state = DeviceState::offline;
  std::string message;     ///< why it is not online
  bool permanent = false;  ///< an offline camera's fault does not mend itself: a setting is wrong, not a cable loose
  uint64_t frames = 0, dropped = 0;  ///< of triggers
  std::optional<double> last_frame_age_s = {};
  std::vector<Statistic> statistics = {};  ///< of its transport, a second old at most while nothing happens
  std::vector<std::string> warnings = {};  ///< sentences: what an operator should know though it works
};

/// What an armed camera has to say: that it is armed, a frame, or what went wrong.
struct CameraNews {
  enum class Kind { armed, frame, fault };
  Kind kind = Kind::armed;
  std::string camera;
  std::optional<Frame> frame;  ///< of Kind::frame
  Error error;                 ///< of Kind::fault
};
using CameraInbox = BoundedQueue<CameraNews>;

/// Takes the frames of a preview, in the camera's thread: it must be quick.
using PreviewSink = std::function<void(const Frame&)>;

/// One camera and the thread that lives with it. It opens the camera, and again after a loss: each time with all its
/// settings, and it is online only when a test frame has come. Faults that may pass are tried again with growing
/// patience, those that only a changed setting mends seldom. In between the thread waits for frames. Any thread may
/// call.
class SupervisedCamera {
 public:
  /// @param info     width and height as the rig has them, which the test frame must have; 0: any
  /// @param changed  called from this camera's thread, or the caller's of note_missing, when its state changes
  SupervisedCamera(CameraInfo info, std::shared_ptr<DeviceSource> source, const Clock& clock,
                   std::function<void(const CameraStatus&)> changed);
  ~SupervisedCamera();

  const std::string& id() const { return info_.id; }
  CameraStatus status() const;

  /// Arms it, soon; a preview makes way. The inbox hears whether that went well and then of each frame, until disarm().
  /// A camera that is offline says so at once.
  void arm(const CaptureSettings& settings, int count, std::shared_ptr<CameraInbox> inbox);
  void disarm() noexcept;
  /// Trigger number `index` since it was armed fired at `when`.
  void note_trigger(int index, Timestamp when) noexcept;
  /// A frame that should have come did not: the camera is degraded until the next one comes.
  void note_missing(const std::string& message);

  /// Shows what it sees whenever it is not armed, until an empty sink comes.
  void set_preview(PreviewSink sink);

 private:
  struct Order {
    CaptureSettings settings;
    int count = 0;
    std::shared_ptr<CameraInbox> inbox;
  };
  using TimePoint = std::chrono::steady_clock::time_point;
  void run(const std::stop_token& stop);
  void tend(const std::stop_token& stop);
  bool open(const std::stop_token& stop);
  Result<void> take_test_frame(const std::stop_token& stop);
  void serve(const Order& order, uint64_t number, const std::stop_token& stop);
  void show(const PreviewSink& sink, uint64_t number, const std::stop_token& stop);
  void lose(const Error& error);
  void set_state(DeviceState state, const std::string& message, bool permanent = false);
  bool is_current(uint64_t number) const;
  void read_statistics();

  const CameraInfo info_;
  const std::shared_ptr<DeviceSource> source_;
  const Clock& clock_;
  const std::function<void(const CameraStatus&)> changed_;

  std::chrono::milliseconds patience_{0};  ///< of the camera's thread, as the next
  TimePoint next_try_{};

  mutable std::mutex mutex_;
  std::condition_variable_any wake_;
  std::unique_ptr<Camera> device_;  ///< replaced under mutex_ by the camera's thread alone, which reads it without
  std::optional<Order> order_;      ///< guarded by mutex_
  PreviewSink preview_;             ///< guarded by mutex_
  uint64_t order_number_ = 0;       ///< guarded by mutex_; changes when an order or a preview is given or withdrawn
  CameraStatus status_;             ///< guarded by mutex_
  std::optional<Timestamp> last_frame_;  ///< guarded by mutex_
  std::jthread thread_;
};

/// All cameras of the booth.
class CameraSupervisor {
 public:
  CameraSupervisor(const std::vector<CameraInfo>& cameras, const std::shared_ptr<DeviceSource>& source,
                   const Clock& clock, const std::function<void(const CameraStatus&)>& changed);

  std::vector<CameraStatus> status() const;
  /// The ids of the cameras; with `role`, of those of that role.
  std::vector<std::string> ids() const;
  std::vector<std::string> ids(CameraRole role) const;
  bool has(const std::string& id) const;
  SupervisedCamera& camera(const std::string& id);

 private:
  std::vector<std::unique_ptr<SupervisedCamera>> cameras_;
};

}  // namespace booth
