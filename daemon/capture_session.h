#pragma once

#include <condition_variable>
#include <deque>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <stop_token>
#include <string>
#include <thread>

#include "config/booth_config.h"
#include "daemon/background_store.h"
#include "daemon/camera_supervisor.h"
#include "daemon/device_slot.h"
#include "daemon/event_bus.h"
#include "daemon/frame_collector.h"
#include "daemon/job_queue.h"
#include "daemon/metrics.h"
#include "daemon/pulse.h"
#include "drivers/device_source.h"
#include "pipeline/reconstruct.h"
#include "pipeline/thread_pool.h"
#include "replay/recording_writer.h"

namespace booth {

struct CaptureRequest {
  FaceMode face = FaceMode::automatic;
  double countdown_s = 0;  ///< 0 … 60
  std::string label = {};  ///< may be empty
};

/// What a capture works with; all of it outlives the session.
struct CaptureParts {
  CaptureConfig config;
  std::filesystem::path recordings;
  std::shared_ptr<DeviceSource> source;
  Rig rig;
  CameraSupervisor& cameras;
  BackgroundStore& backgrounds;
  JobQueue& jobs;
  EventBus& events;
  Metrics& metrics;
  const Clock& clock;
  std::function<void(BoothState)> set_state;  ///< called without a lock held
  std::function<Result<void>()> check_disk;   ///< @error disk_full
};

/// Takes captures, one at a time, on a thread of its own: countdown, the body shot, the face's patterns, a durable
/// recording, a queued job. Either all of that, or nothing remains. Any thread may call.
class CaptureSession {
 public:
  explicit CaptureSession(CaptureParts parts);
  ~CaptureSession();

  /// Begins a capture. @return its id; @error busy  another one is under way
  Result<std::string> start(const CaptureRequest& request);
  /// @error invalid_state  it is over, or can no longer be stopped; not_found
  Result<void> cancel(const std::string& id);
  /// Of a capture under way nothing will remain, whatever it has done so far. Others: nothing happens.
  void abandon(const std::string& id);
  /// Waits until that capture is no longer under way.
  void wait_over(const std::string& id);

  std::optional<std::string> current() const;
  DeviceStatus trigger() const { return trigger_.status(); }
  std::optional<DeviceStatus> projector() const;
  Pulse::TimePoint last_pulse() const { return pulse_.last(); }

  /// No more captures: one in its countdown is cancelled, another may finish within `patience`.
  void drain(std::chrono::milliseconds patience);

 private:
  struct Capture {
    std::string id;
    CaptureRequest request;
    std::stop_source stop;
    bool counting_down = true;
    bool committing = false;  ///< it can no longer be cancelled
    bool abandoned = false;
  };
  void run(const std::stop_token& stop);
  void tend_devices();
  void carry_out(const std::string& id, const CaptureRequest& request, const std::stop_token& cancelled);
  bool conclude(const std::string& id, const CaptureRequest& request, bool taken);

  // The steps of a capture, in their order.
  Result<void> take(const std::string& id, const CaptureRequest& request, const std::stop_token& cancelled);
  Result<void> count_down(const std::string& id, Timestamp until, Timestamp zero, double& next_s,
                          const std::stop_token& cancelled);
  Result<CollectedShot> take_body(const std::string& id, FrameCollector& collector, const std::stop_token& cancelled);
  Result<std::vector<Frame>> take_face(const std::string& id, const std::stop_token& cancelled);
  Result<void> write(RecordingWriter& writer, const std::string& shot, const std::vector<Frame>& frames,
                     const std::stop_token& cancelled);

  Result<CollectedShot> fire_and_collect(FrameCollector& collector, int number, const std::stop_token& cancelled);
  bool begin_commit(const std::string& id);
  void begin_capturing();
  bool patterns_wanted(FaceMode mode);

  const CaptureParts parts_;
  DeviceSlot<Trigger> trigger_;
  std::optional<DeviceSlot<Projector>> projector_;
  ThreadPool encoders_;
  Pulse pulse_;

  std::mutex transition_mutex_;  ///< held from a capture's beginning, or end, until the state says so; before mutex_
  mutable std::mutex mutex_;
  std::condition_variable_any changed_;
  std::optional<Capture> capture_;  ///< guarded by mutex_; the one under way
  bool pending_ = false;            ///< guarded by mutex_; it waits for the thread
  bool draining_ = false;           ///< guarded by mutex_
  std::deque<std::string> over_;    ///< guarded by mutex_; captures of this boot that failed, the newest last
  std::jthread thread_;
};

}  // namespace booth
