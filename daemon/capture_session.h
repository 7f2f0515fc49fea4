#pragma once

#include <condition_variable>
#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stop_token>
#include <string>
#include <thread>
#include <variant>
#include <vector>

#include "config/booth_config.h"
#include "daemon/background_store.h"
#include "daemon/calibration_desk.h"
#include "daemon/camera_supervisor.h"
#include "daemon/capture_journal.h"
#include "daemon/device_slot.h"
#include "daemon/empty_booth.h"
#include "daemon/event_bus.h"
#include "daemon/frame_collector.h"
#include "daemon/head_start.h"
#include "daemon/job_queue.h"
#include "daemon/metrics.h"
#include "daemon/pulse.h"
#include "daemon/task_board.h"
#include "drivers/device_source.h"
#include "drivers/display/delay_calibration.h"
#include "pipeline/reconstruct.h"
#include "pipeline/thread_pool.h"
#include "replay/recording_writer.h"

namespace booth {

struct CaptureRequest {
  FaceMode face = FaceMode::automatic;
  double countdown_s = 0;  ///< 0 … 60
  std::string label = {};  ///< may be empty
};

/// The empty booth is to be learned.
struct BackgroundRequest {
  int frames = 10;          ///< of each camera, 1 … 100
  bool unattended = false;  ///< nobody says that the booth is empty: it must look as when it was learned last
};

/// One trigger is to be fired, to see which cameras answer and when.
struct TriggerTestRequest {};

/// The projector's delay is to be measured.
struct ProjectorCalibrationRequest {};

/// A shot of the calibration board is to be taken.
struct BoardRequest {
  bool floor = false;     ///< the board lies on the floor where the subject stands
  bool patterns = false;  ///< the projector lights it with its patterns, so that it is calibrated too
};

/// What a capture works with; all of it outlives the session.
struct CaptureParts {
  CaptureConfig config;
  std::filesystem::path recordings;
  std::filesystem::path projector_delay;      ///< the file that keeps what was measured
  DelayCalibrationOptions delay_calibration;  ///< how it is measured
  std::shared_ptr<DeviceSource> source;
  std::string trigger;                              ///< its driver's name
  std::optional<std::string> projector;             ///< its id, where the booth has one
  std::function<std::shared_ptr<const Rig>()> rig;  ///< the current one; null while the booth is not calibrated
  CameraSupervisor& cameras;
  TaskBoard& tasks;
  BackgroundStore& backgrounds;
  CalibrationDesk& calibration;
  const CaptureJournal& journal;
  std::function<std::vector<BoothDevice>()> devices;  ///< every camera
  JobQueue& jobs;
  HeadStart& head_start;
  EventBus& events;
  Metrics& metrics;
  const Clock& clock;
  std::function<void(BoothState)> set_state;  ///< called without a lock held
  /// Whether there is room for so many frames of each camera, and the patterns. @error disk_full
  std::function<Result<void>(int frames, bool patterns)> check_disk;
  /// Called when the background was learned, or could not be learned unattended.
  std::function<void(const Result<void>&)> background_learned = [](const Result<void>&) {};
};

/// Does what needs the cameras together, one thing at a time, on a thread of its own. A capture: countdown, the body
/// shot, the face's patterns, a durable recording, a queued job; either all of that, or nothing remains. Learning the
/// background and testing the trigger: tasks. Any thread may call.
class CaptureSession {
 public:
  explicit CaptureSession(CaptureParts parts);
  ~CaptureSession();

  /// Takes the id of a capture that began and is on the disk, so that whatever happens now it will be there or be named
  /// as failed; or why it failed at once. From another thread.
  using Acknowledge = std::function<void(const Result<std::string>&)>;

  /// Begins a capture, which a SIGKILL from now on does not make forgotten.
  /// @param acknowledge  called once, when a power cut does not either, unless start() fails
  /// @return its id; @error busy  another one is under way; disk_full, io  it cannot be written down
  Result<std::string> start(const CaptureRequest& request, Acknowledge acknowledge = {});
  /// Begins a task. @return its id; @error busy, not_calibrated
  Result<std::string> learn_background(const BackgroundRequest& request);
  /// Likewise. @error busy
  Result<std::string> test_trigger();
  /// Likewise. @error busy; unsupported  there is no projector whose flips are known
  Result<std::string> calibrate_projector();
  /// Likewise. @error busy; unsupported  patterns are wanted and there is no projector
  Result<std::string> capture_board(const BoardRequest& request);
  /// @error invalid_state  it is over, or can no longer be stopped; not_found
  Result<void> cancel(const std::string& id);
  /// Of a capture under way nothing will remain, whatever it has done so far. Others: nothing happens.
  void abandon(const std::string& id);
  /// Waits until that capture is no longer under way.
  void wait_over(const std::string& id);

  /// The capture under way.
  std::optional<std::string> current() const;
  /// What is under way, capture or task, as a sentence.
  std::optional<std::string> occupation() const;
  DeviceStatus trigger() const { return trigger_.status(); }
  std::optional<DeviceStatus> projector() const;
  Pulse::TimePoint last_pulse() const { return pulse_.last(); }

  /// No more captures: one in its countdown is cancelled, another may finish within `patience`.
  void drain(std::chrono::milliseconds patience);

 private:
  using Request =
      std::variant<CaptureRequest, BackgroundRequest, TriggerTestRequest, ProjectorCalibrationRequest, BoardRequest>;
  /// The one thing that is under way.
  struct Operation {
    std::string id;  ///< the capture's, or the task's
    Request request;
    std::stop_source stop;
    Acknowledge acknowledge = {};  ///< of a capture; may be empty
    bool stoppable = true;         ///< nobody stands there yet: stopping the booth need not wait for it
    bool committing = false;       ///< it can no longer be cancelled
    bool abandoned = false;
    bool is_capture() const { return std::holds_alternative<CaptureRequest>(request); }
  };
  void run(const std::stop_token& stop);
  void tend_devices();
  Result<void> begin(Operation operation, BoothState state);
  Result<std::string> begin_task(TaskKind kind, const Request& request, BoothState state);
  void end_operation(bool failed);
  void carry_out(const Operation& operation, const CaptureRequest& request);
  template <class TaskRequest>
  void carry_out(const Operation& operation, const TaskRequest& request);
  bool is_draining() const;
  void end_announced();
  void end_journal(const std::string& id) const;
  bool conclude(const std::string& id, const CaptureRequest& request, bool taken);

  // The steps of a capture, in their order.
  Result<void> take(const std::string& id, const CaptureRequest& request, const std::stop_token& cancelled);
  Result<void> count_down(const std::string& id, Timestamp until, Timestamp zero, double& next_s,
                          const std::stop_token& cancelled);
  Result<CollectedShot> take_body(const std::string& id, FrameCollector& collector, const std::stop_token& cancelled);
  Result<std::vector<Frame>> take_patterns(const std::string& id, const std::vector<std::string>& cameras,
                                           const std::stop_token& cancelled);
  std::vector<std::string> wait_returned(const std::vector<std::string>& cameras,
                                         const std::vector<std::map<std::string, Frame>>& delivered, Timestamp deadline,
                                         const std::stop_token& cancelled);
  struct WantedPattern {
    int pattern = 0;
    const std::vector<std::string>& cameras;  ///< from which
    const std::vector<std::string>& all;      ///< that are to have it in the end
    bool again = false;                       ///< it was shown before
  };
  Result<void> take_pattern(const std::string& id, Projector& projector, const WantedPattern& wanted,
                            std::map<std::string, Frame>& delivered, FrameCollector& collector, int& repeats_left,
                            const std::stop_token& cancelled);
  Result<void> write(RecordingWriter& writer, const std::string& shot, const std::vector<Frame>& frames,
                     const Work& work, const std::stop_token& cancelled);
  void show_so_far(const std::string& id, FaceMode face, RecordingWriter& writer);

  // The tasks.
  Result<TaskResult> work(const std::string& task, const BackgroundRequest& request, const std::stop_token& cancelled);
  Result<TaskResult> learn(const std::string& task, const BackgroundRequest& request, const std::stop_token& cancelled);
  Result<TaskResult> work(const std::string& task, const TriggerTestRequest& request, const std::stop_token& cancelled);
  Result<TaskResult> work(const std::string& task, const ProjectorCalibrationRequest& request,
                          const std::stop_token& cancelled);
  Result<TaskResult> work(const std::string& task, const BoardRequest& request, const std::stop_token& cancelled);
  using Views = std::map<std::string, std::vector<CoarseView>>;  ///< by camera, in their order
  Result<Views> take_background(const std::string& task, int frames, RecordingWriter& writer,
                                const std::stop_token& cancelled);
  std::optional<std::string> compare_with_last(const Views& views) const;

  FrameCollector arm(std::vector<std::string> cameras, ShotRole role, int count) const;
  Result<CollectedShot> fire_and_collect(FrameCollector& collector, ShotRole role, const std::stop_token& cancelled);
  void tell(const std::vector<std::string>& remarks);
  Result<void> check_enough(const CollectedShot& shot) const;
  bool begin_commit(const std::string& id);
  void begin_capturing();
  bool patterns_wanted(FaceMode mode);

  const CaptureParts parts_;
  DeviceSlot<Trigger> trigger_;
  std::optional<DeviceSlot<Projector>> projector_;
  ThreadPool encoders_;
  Pulse pulse_;

  std::mutex transition_mutex_;  ///< held from an operation's beginning, or end, until the state says so; before mutex_
  mutable std::mutex mutex_;
  std::condition_variable_any changed_;
  std::optional<Operation> operation_;  ///< guarded by mutex_; the one under way
  bool pending_ = false;                ///< guarded by mutex_; it waits for the thread
  bool draining_ = false;               ///< guarded by mutex_
  std::deque<std::string> over_;        ///< guarded by mutex_; captures of this boot that failed, the newest last
  std::vector<std::string> announced_;  ///< of the thread; captures that failed: their events are on their way
  std::jthread thread_;
};

}  // namespace booth
