#pragma once

#include <atomic>
#include <chrono>
#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "config/booth_config.h"
#include "daemon/avatar_store.h"
#include "daemon/background_store.h"
#include "daemon/calibration_desk.h"
#include "daemon/camera_supervisor.h"
#include "daemon/capture_journal.h"
#include "daemon/capture_session.h"
#include "daemon/disk_guard.h"
#include "daemon/eraser.h"
#include "daemon/event_bus.h"
#include "daemon/head_start.h"
#include "daemon/health_history.h"
#include "daemon/health_monitor.h"
#include "daemon/job_queue.h"
#include "daemon/job_runner.h"
#include "daemon/metrics.h"
#include "daemon/preview_board.h"
#include "daemon/serial_executor.h"
#include "daemon/task_board.h"
#include "daemon/warning_relay.h"
#include "drivers/clock.h"
#include "drivers/device_source.h"
#include "replay/recording.h"

namespace booth {

/// A driver by its name.
struct Driver {
  std::string name;
  std::shared_ptr<DeviceSource> source;
};

/// The devices that the configuration names, and the rig that they belong to.
struct Devices {
  std::shared_ptr<DeviceSource> source;
  std::vector<Driver> drivers;                 ///< where camera.discover looks
  std::vector<CameraInfo> cameras;             ///< id, driver and role of each
  std::map<std::string, int> mount_rotations;  ///< by camera, as configured: for those that the rig does not have
  std::string trigger;                         ///< its driver's name
  std::optional<std::string> projector;        ///< its id
  std::optional<Rig> rig;                      ///< nothing: the booth is not calibrated
  std::string rig_fault;                       ///< why there is none, where one was there but cannot be used
  std::string rig_created;                     ///< ISO 8601, UTC; may be empty
  std::shared_ptr<WarningRelay> warnings;      ///< of the drivers; may be null
  std::optional<Recording> replayed;           ///< whose background is the booth's, where the devices are played back
};

/// @error as the driver's; unsupported  no driver of that name
Result<Devices> open_devices(const BoothConfig& config, const Clock& clock);

struct BoothOptions {
  BoothConfig config;
  std::filesystem::path config_file;          ///< handed to the reconstruction; may be empty
  std::filesystem::path reconstruct_command;  ///< see JobRunnerOptions::command
  std::filesystem::path calibrate_command;    ///< see CalibrationDeskOptions::command
  DelayCalibrationOptions delay_calibration = {.max_delay_ms = 300, .repeats = 3};  ///< some ten seconds
  FreeSpace free_space = free_space_at;
};

struct CalibrationStatus {
  bool loaded = false;
  std::optional<double> rms_px;         ///< the worst camera's
  std::string created;                  ///< may be empty
  std::vector<std::string> moved = {};  ///< cameras that the latest capture shows not to stand where they were
  std::optional<CalibrationSessionStatus> session = {};  ///< of the calibration under way
};
struct BackgroundStatus {
  bool learned = false;
  std::string created;                    ///< may be empty
  std::optional<std::string> stale = {};  ///< why it is to be learned again
};
struct DiskStatus {
  uint64_t free_bytes = 0;
  uint64_t limit_bytes = 0;    ///< with less free no capture starts
  uint64_t used_bytes = 0;     ///< of recordings, avatars and backgrounds
  uint64_t quota_bytes = 0;    ///< most that these may take; 0: there is no such limit
  uint64_t capture_bytes = 0;  ///< most that the next capture may take
};

/// Everything at one instant.
struct BoothStatus {
  BoothState state = BoothState::starting;
  std::chrono::system_clock::time_point state_since;
  std::string boot;
  uint64_t sequence = 0;  ///< what events up to it say is in here
  std::vector<Reason> not_ready;
  std::optional<std::string> capture;
  std::vector<CameraStatus> cameras;
  std::optional<DeviceStatus> projector, trigger;
  CalibrationStatus calibration;
  BackgroundStatus background;
  std::vector<Task> tasks;  ///< under way
  std::vector<Job> queue;   ///< not done
  DiskStatus disk;
  double uptime_s = 0;
};

/// The booth: its devices, its captures, its jobs and its avatars, put together. It knows nothing of how it is talked
/// to. Any thread may call; calls that wait for the disk say so.
class Booth {
 public:
  /// Reads the state directory, opens the devices and goes on with what was under way. Devices that cannot be opened
  /// are no reason not to start: the status says so.
  ///
  /// @param devices  an error makes the state `fault`
  /// @param clock    outlives the booth
  /// @error io, disk_full  the state directory cannot be used; busy  another process uses it
  static Result<std::unique_ptr<Booth>> open(const BoothOptions& options, Result<Devices> devices, const Clock& clock);
  ~Booth();

  EventBus& events() { return events_; }
  Metrics& metrics() { return metrics_; }
  /// Work that waits for the disk, for those who may not.
  SerialExecutor& disk() { return disk_executor_; }
  const std::string& name() const { return options_.config.booth.name; }
  const std::filesystem::path& state_directory() const { return options_.config.booth.state_directory; }

  BoothStatus status() const;
  std::map<std::string, double> measurements() const;
  /// How it has been, over restarts.
  const HealthHistory& history() const { return *history_; }

  // Tasks: each returns its id at once, and `task` events tell how it goes.
  /// Every camera that the drivers see. @error busy, not_ready
  Result<std::string> discover_cameras();
  /// @param frames  of each camera, 1 … 100; nothing: as configured. @error busy, not_ready, not_calibrated,
  /// device_lost
  Result<std::string> learn_background(std::optional<int> frames);
  /// Fires once and tells which cameras answer, and when. @error busy, not_ready, device_lost
  Result<std::string> test_trigger();
  /// Measures the delay from a flip of the projector to the subject, by a face camera, and keeps it. The scene must
  /// hold still. @error busy, not_ready; unsupported  the booth has no projector on a display output
  Result<std::string> calibrate_projector();

  /// Takes a shot of the calibration board. @error busy, not_ready, disk_full, device_lost, unsupported
  Result<std::string> capture_board(const BoardRequest& request);
  /// Its shots are solved and a solution put in force here.
  CalibrationDesk& calibration() { return *calibration_desk_; }

  /// @param settings  its rotation is the camera's own. @error not_found  no such camera
  Result<void> start_preview(const std::string& camera, PreviewSettings settings);
  Result<void> stop_preview(const std::string& camera);
  /// What previews show now; events().wakeup() tells when there is something.
  std::vector<PreviewPicture> take_previews();

  /// The current calibration; null while there is none.
  std::shared_ptr<const Rig> rig() const;

  /// @error busy, unsupported, not_ready, not_calibrated, no_background, disk_full, device_lost
  /// @param acknowledge  see CaptureSession::start
  Result<std::string> start_capture(const CaptureRequest& request, CaptureSession::Acknowledge acknowledge = {});
  Result<void> cancel_capture(const std::string& capture);
  /// @param done  called when nothing is left, from another thread or at once
  Result<void> delete_capture(const std::string& capture, std::function<void(Result<void>)> done);
  /// Deletes its recording too.
  Result<void> delete_avatar(const std::string& avatar, std::function<void(Result<void>)> done);

  JobQueue& jobs() { return *jobs_; }
  AvatarStore& avatars() { return *avatars_; }
  const AvatarStore& avatars() const { return *avatars_; }

  /// No new work; what is under way ends soon, and the processes of jobs at once. Waits for that, some seconds at most.
  void drain();
  /// When the least lively thread last gave a sign of life.
  Pulse::TimePoint last_pulse() const;

 private:
  Booth(const BoothOptions& options, const Clock& clock);
  Result<void> lock_state();
  Result<void> open_stores();
  void open_capture(const Devices& devices);
  void adopt_orphans();
  void name_interrupted();
  void set_state(BoothState state);
  void refresh();
  CamerasDiscovered look_for_cameras() const;
  void load_rig(const Devices& devices);
  void set_rig(const RigInForce& rig);
  Result<void> open_calibration(const Result<Devices>& devices);
  std::vector<BoothDevice> devices() const;
  std::vector<Reason> find_reasons(BoothState state) const;
  void find_calibration_reasons(std::vector<Reason>& reasons) const;
  Result<void> check_ready(const std::vector<std::string>& tolerated) const;
  Result<void> check_disk(int frames, bool patterns) const;
  uint64_t capture_bytes(int frames, bool patterns) const;
  void make_room();
  void sweep() const;
  void keep_house(const std::stop_token& stop);
  std::optional<std::chrono::seconds> background_age() const;
  /// Has what was learned of the empty booth brought into the form that jobs use. @pre called by the housekeeper
  void prepare_background();
  void tend_background();
  void note_health();

  const BoothOptions options_;
  const Clock& clock_;
  const std::chrono::steady_clock::time_point started_ = std::chrono::steady_clock::now();
  EventBus events_;
  Metrics metrics_;
  HealthMonitor health_;
  int state_lock_ = -1;  ///< an open descriptor, locked while this booth uses the state directory

  std::unique_ptr<JobQueue> jobs_;
  std::unique_ptr<HeadStart> head_start_;
  std::unique_ptr<AvatarStore> avatars_;
  std::unique_ptr<CaptureJournal> journal_;
  std::unique_ptr<HealthHistory> history_;
  SerialExecutor disk_executor_;    ///< its tasks use those above
  std::filesystem::path prepared_;  ///< the background that was prepared last; the housekeeper's
  std::unique_ptr<BackgroundStore> backgrounds_;
  TaskBoard tasks_{events_};
  mutable std::mutex rig_mutex_;
  std::shared_ptr<const Rig> rig_;  ///< guarded by rig_mutex_
  CalibrationStatus calibration_;   ///< guarded by rig_mutex_
  std::string rig_fault_;           ///< guarded by rig_mutex_
  std::map<std::string, int> mount_rotations_;
  std::unique_ptr<CalibrationDesk> calibration_desk_;
  bool background_is_played_ = false;                        ///< it is that of a recording, and does not grow old
  std::chrono::steady_clock::time_point next_relearning_{};  ///< of the housekeeper
  std::string device_fault_;                                 ///< why there are no devices; empty when there are
  std::vector<Driver> drivers_;
  std::shared_ptr<WarningRelay> warnings_;
  std::unique_ptr<PreviewBoard> previews_;  ///< the cameras' threads use it
  std::unique_ptr<CameraSupervisor> cameras_;
  std::unique_ptr<CaptureSession> session_;
  std::unique_ptr<JobRunner> runner_;
  std::unique_ptr<Eraser> eraser_;
  std::unique_ptr<SerialExecutor> discoverer_;  ///< looking for cameras takes seconds

  DiskGuard disk_guard_;
  std::atomic<int> retiring_{0};  ///< deletions of make_room() that are under way
  mutable std::mutex state_mutex_;
  BoothState state_ = BoothState::starting;            ///< guarded by state_mutex_
  std::chrono::system_clock::time_point state_since_;  ///< guarded by state_mutex_
  std::optional<std::vector<Reason>> announced_;       ///< guarded by state_mutex_; of the last state event
  BoothState announced_state_ = BoothState::starting;  ///< guarded by state_mutex_
  Pulse house_pulse_;
  std::jthread housekeeper_;
};

}  // namespace booth
