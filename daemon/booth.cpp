#include "daemon/booth.h"

#include <fcntl.h>
#include <pthread.h>
#include <spdlog/spdlog.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <exception>
#include <fstream>
#include <future>
#include <limits>
#include <set>
#include <system_error>
#include <utility>

#include "daemon/identifier.h"
#include "daemon/projector_delay.h"
#include "daemon/retention.h"
#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using SteadyClock = std::chrono::steady_clock;

constexpr uint64_t mebibyte = 1024 * 1024;
constexpr size_t most_disk_tasks = 256;
constexpr std::chrono::milliseconds house_pause{250};
constexpr std::chrono::milliseconds heartbeat_pause{1000};
constexpr std::chrono::milliseconds disk_pause{2000};  ///< between two looks at the space
constexpr std::chrono::hours sweep_pause{1};           ///< between two looks for what could not be removed at once
/// What a process of the last run was still dying in could not be removed at the start.
constexpr std::chrono::seconds first_sweep{10};
constexpr std::chrono::minutes relearning_pause{5};  ///< between two tries to learn the background unasked
constexpr size_t most_interrupted = 100;             ///< captures that ended with the daemon: the newest are kept
constexpr std::chrono::milliseconds drain_patience{10'000};  ///< for a capture under way

ErrorCode code_of(const std::string& kind) {
  for (const ErrorCode code : {ErrorCode::busy, ErrorCode::not_calibrated, ErrorCode::no_background,
                               ErrorCode::disk_full, ErrorCode::not_ready})
    if (kind == to_string(code)) return code;
  return ErrorCode::device_lost;
}

/// Entries of a folder; 0 where it cannot be listed.
uint64_t count_entries(const char* folder) {
  std::error_code code;
  uint64_t count = 0;
  for (fs::directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code)) ++count;
  return count;
}

/// Of this process; 0 where the system does not say.
double resident_bytes() {
  std::ifstream file("/proc/self/statm");
  double size = 0, resident = 0;
  file >> size >> resident;
  return resident * static_cast<double>(::sysconf(_SC_PAGESIZE));
}

}  // namespace

Booth::Booth(const BoothOptions& options, const Clock& clock)
    : options_(options),
      clock_(clock),
      health_(options.config.background, events_),
      disk_executor_("disk", most_disk_tasks),
      disk_guard_(options.config.booth, options.config.disk, options.free_space),
      state_since_(std::chrono::system_clock::now()) {}

Result<std::unique_ptr<Booth>> Booth::open(const BoothOptions& options, Result<Devices> devices, const Clock& clock) {
  std::unique_ptr<Booth> booth(new Booth(options, clock));
  if (const auto locked = booth->lock_state(); !locked) return locked.error();
  if (const auto opened = booth->open_stores(); !opened) return opened.error();
  booth->disk_guard_.measure();
  if (const auto opened = booth->open_calibration(devices); !opened) return opened.error();
  const BoothConfig& config = options.config;
  const ReconstructProgram program{.command = options.reconstruct_command,
                                   .config_file = options.config_file,
                                   .recordings = config.booth.recordings(),
                                   .avatars = config.booth.avatars(),
                                   .cache = config.booth.cache(),
                                   .threads = config.jobs.threads,
                                   .timeout = std::chrono::seconds(config.jobs.timeout_s),
                                   .most_bytes = static_cast<uint64_t>(config.jobs.memory_mib) * mebibyte};
  booth->head_start_ =
      std::make_unique<HeadStart>(program, config.jobs.head_start ? config.jobs.workers : 0, *booth->jobs_);
  if (devices) {
    booth->open_capture(*devices);
  } else {
    booth->device_fault_ = devices.error().message;
    spdlog::error("no devices: {}", booth->device_fault_);
  }
  booth->adopt_orphans();
  booth->name_interrupted();

  booth->runner_ = std::make_unique<JobRunner>(
      JobRunnerOptions{program, config.jobs.workers, config.jobs.retries}, *booth->jobs_, *booth->head_start_,
      *booth->avatars_, booth->events_, booth->metrics_,
      [self = booth.get()](const std::string& capture, const std::vector<CameraHealth>& cameras) {
        self->health_.report(capture, cameras);
      });
  booth->eraser_ = std::make_unique<Eraser>(config.booth.state_directory, *booth->jobs_, *booth->head_start_,
                                            *booth->avatars_, *booth->journal_, booth->session_.get(), booth->events_);
  booth->set_state(booth->device_fault_.empty() ? BoothState::idle : BoothState::fault);
  booth->housekeeper_ = std::jthread([self = booth.get()](const std::stop_token& stop) { self->keep_house(stop); });
  pthread_setname_np(booth->housekeeper_.native_handle(), "house");
  return booth;
}

Booth::~Booth() {
  housekeeper_.request_stop();
  if (housekeeper_.joinable()) housekeeper_.join();
  discoverer_.reset();
  eraser_.reset();
  runner_.reset();
  session_.reset();
  // What was asked of the desk and still waits for the disk comes first.
  std::promise<void> carried_out;
  if (disk_executor_.post([&carried_out] { carried_out.set_value(); })) carried_out.get_future().wait();
  if (history_ != nullptr)
    if (const auto saved = history_->save(); !saved) spdlog::warn("{}", saved.error().message);
  calibration_desk_.reset();
  cameras_.reset();
  previews_.reset();
  if (warnings_) warnings_->listen({});
  if (state_lock_ >= 0) ::close(state_lock_);
}

Result<void> Booth::lock_state() {
  const fs::path& folder = options_.config.booth.state_directory;
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be made: " + code.message()};
  const fs::path file = folder / "lock";
  state_lock_ = ::open(file.c_str(), O_CREAT | O_RDWR | O_CLOEXEC, 0600);
  if (state_lock_ < 0)
    return Error{ErrorCode::io, file.string() + ": cannot be opened: " + std::generic_category().message(errno)};
  if (::flock(state_lock_, LOCK_EX | LOCK_NB) != 0)
    return Error{ErrorCode::busy, folder.string() + ": another booth works in this state directory"};
  return {};
}

Result<void> Booth::open_stores() {
  const IdentityConfig& booth = options_.config.booth;
  if (const auto finished = Eraser::finish_interrupted(booth.state_directory); !finished) return finished;
  std::error_code code;
  fs::create_directories(booth.recordings(), code);
  if (code) return Error{ErrorCode::io, booth.recordings().string() + ": cannot be made: " + code.message()};
  for (const fs::path& folder : {booth.recordings(), booth.state_directory, booth.rig().parent_path()})
    if (const auto removed = remove_partial_folders(folder); !removed) return removed.error();
  auto jobs = JobQueue::open(booth.jobs(), events_);
  if (!jobs) return jobs.error();
  jobs_ = std::move(*jobs);
  auto avatars = AvatarStore::open(booth.avatars());
  if (!avatars) return avatars.error();
  avatars_ = std::move(*avatars);
  auto journal = CaptureJournal::open(booth.captures_under_way());
  if (!journal) return journal.error();
  journal_ = std::make_unique<CaptureJournal>(std::move(*journal));
  auto backgrounds = BackgroundStore::open(booth.backgrounds());
  if (!backgrounds) return backgrounds.error();
  backgrounds_ = std::move(*backgrounds);
  history_ = std::make_unique<HealthHistory>(health_history_file(booth.state_directory));
  return {};
}

/// @param devices  of a recording that is played, the board is that of its shots
Result<void> Booth::open_calibration(const Result<Devices>& devices) {
  CalibrationDeskOptions options{.folder = options_.config.booth.rig().parent_path(),
                                 .command = options_.calibrate_command,
                                 .board = options_.config.calibration.board,
                                 .images = options_.config.capture.images,
                                 .timeout = std::chrono::seconds(options_.config.calibration.timeout_s)};
  if (devices && devices->replayed)
    if (const Shot* shot = devices->replayed->find(ShotRole::calibration_board); shot != nullptr && shot->board)
      options.board = *shot->board;
  auto opened = CalibrationDesk::open(
      std::move(options), tasks_,
      [this] {
        const std::lock_guard lock(rig_mutex_);
        return RigInForce{rig_, calibration_.created};
      },
      [this](const RigInForce& rig) {
        set_rig(rig);
        health_.calibrated();
        refresh();
      });
  if (!opened) return opened.error();
  calibration_desk_ = std::move(*opened);
  return {};
}

void Booth::set_rig(const RigInForce& rig) {
  const std::lock_guard lock(rig_mutex_);
  rig_fault_.clear();
  rig_ = rig.rig;
  calibration_ = {.loaded = true, .rms_px = {}, .created = rig.created};
  for (const RigCamera& camera : rig_->cameras)
    if (camera.rms_px) calibration_.rms_px = std::max(calibration_.rms_px.value_or(0), *camera.rms_px);
}

void Booth::open_capture(const Devices& devices) {
  load_rig(devices);
  background_is_played_ = devices.replayed.has_value();
  if (devices.replayed) {
    const auto now = std::chrono::system_clock::now();
    if (const auto adopted = backgrounds_->adopt(*devices.replayed, make_capture_id(now), devices.replayed->created);
        !adopted)
      spdlog::error("the replayed recording gives no background: {}", adopted.error().message);
  }

  drivers_ = devices.drivers;
  warnings_ = devices.warnings;
  if (warnings_)
    warnings_->listen([this](const std::string& sentence) {
      spdlog::warn("{}", sentence);
      metrics_.add("driver_warnings");
      events_.publish(Alert{Severity::warning, "camera_unavailable", sentence});
    });
  mount_rotations_ = devices.mount_rotations;
  std::vector<CameraInfo> cameras = devices.cameras;
  const auto rig = this->rig();
  for (CameraInfo& camera : cameras)
    if (const RigCamera* calibrated = rig ? rig->find(camera.id) : nullptr; calibrated != nullptr) {
      camera.width = calibrated->intrinsics.width;
      camera.height = calibrated->intrinsics.height;
    }
  cameras_ = std::make_unique<CameraSupervisor>(cameras, devices.source, clock_, [this](const CameraStatus& camera) {
    events_.publish(CameraChanged{camera.id, camera.state, camera.message});
  });
  previews_ = std::make_unique<PreviewBoard>(*cameras_, metrics_, clock_, events_.wakeup());
  session_ = std::make_unique<CaptureSession>(
      CaptureParts{.config = options_.config.capture,
                   .recordings = options_.config.booth.recordings(),
                   .projector_delay = projector_delay_file(options_.config.booth.state_directory),
                   .delay_calibration = options_.delay_calibration,
                   .source = devices.source,
                   .trigger = devices.trigger,
                   .projector = devices.projector,
                   .rig = [this] { return this->rig(); },
                   .cameras = *cameras_,
                   .tasks = tasks_,
                   .backgrounds = *backgrounds_,
                   .calibration = *calibration_desk_,
                   .journal = *journal_,
                   .devices = [this] { return this->devices(); },
                   .jobs = *jobs_,
                   .head_start = *head_start_,
                   .events = events_,
                   .metrics = metrics_,
                   .clock = clock_,
                   .set_state = [this](BoothState state) { set_state(state); },
                   .check_disk = [this](int frames, bool patterns) { return check_disk(frames, patterns); },
                   .background_learned =
                       [this](const Result<void>& learned) {
                         if (learned) return health_.background_learned();
                         health_.ask_for_background("the booth could not learn its background by itself: " +
                                                    learned.error().message);
                       }});
  constexpr size_t most_discoveries = 4;
  discoverer_ = std::make_unique<SerialExecutor>("discover", most_discoveries);
}

void Booth::load_rig(const Devices& devices) {
  if (devices.rig) return set_rig({std::make_shared<const Rig>(*devices.rig), devices.rig_created});
  const std::lock_guard lock(rig_mutex_);
  rig_fault_ = devices.rig_fault;
}

std::shared_ptr<const Rig> Booth::rig() const {
  const std::lock_guard lock(rig_mutex_);
  return rig_;
}

/// The daemon may have died after a capture was on the disk and before its job was, or between the two deletions of an
/// earlier program version, and a disk may fail to give what it has: recordings without a job get one, jobs without a
/// recording go, done ones without an avatar are done again.
void Booth::adopt_orphans() {
  const IdentityConfig& booth = options_.config.booth;
  std::error_code code;
  for (fs::directory_iterator entry(booth.recordings(), code), end; !code && entry != end; entry.increment(code)) {
    const std::string id = entry->path().filename().string();
    if (!is_safe_id(id) || jobs_->find(id)) continue;
    const auto recording = read_recording(entry->path());
    if (!recording) {
      spdlog::warn("{}: not a recording: {}", entry->path().string(), recording.error().message);
      continue;
    }
    spdlog::info("capture {}: had no job, it gets one", id);
    const bool done = avatars_->find(id).has_value();
    jobs_->add({.id = id,
                .face = face_mode_from(recording->face) ? recording->face : "auto",
                .label = recording->label,
                .state = done ? JobState::done : JobState::queued,
                .fraction = done ? 1.0 : 0.0});
    if (const auto written = jobs_->persist(id); !written) spdlog::error("{}", written.error().message);
    jobs_->release(id);
  }
  for (const Job& job : jobs_->list()) {
    if (!job.recorded || avatars_->find(job.id)) continue;
    if (fs::exists(booth.recordings() / job.id, code)) {
      jobs_->redo(job.id);
      continue;
    }
    spdlog::info("job {}: its recording is gone, and so it goes", job.id);
    jobs_->forget(job.id);
    if (const auto written = jobs_->persist(job.id); !written) spdlog::error("{}", written.error().message);
  }
}

/// Captures that somebody was told to have begun, and that ended with the last process before they were recorded, are
/// failed jobs from now on: the queue, the list of jobs and an event say so, until they are deleted.
void Booth::name_interrupted() {
  const auto unfinished = journal_->unfinished();
  if (!unfinished) return spdlog::error("{}", unfinished.error().message);
  const IdentityConfig& booth = options_.config.booth;
  std::error_code code;
  for (const std::string& id : *unfinished) {
    if (!jobs_->find(id)) {
      if (fs::exists(booth.recordings() / id, code)) continue;  // one that the disk does not give now, but may yet
      const Error error{ErrorCode::internal, "the booth was stopped while capturing"};
      spdlog::warn("capture {}: failed: {}", id, error.message);
      metrics_.add("captures_failed");
      jobs_->add({.id = id,
                  .face = "auto",
                  .state = JobState::failed,
                  .error = Reason{std::string(to_string(error.code)), error.message},
                  .recorded = false});
      events_.publish(CaptureFailed{id, error});
      const auto written = jobs_->persist(id);
      jobs_->release(id);
      if (!written) {
        spdlog::error("{}", written.error().message);
        continue;
      }
    }
    if (const auto ended = journal_->end(id); !ended) spdlog::warn("{}", ended.error().message);
  }
  std::vector<std::string> unrecorded;
  for (const Job& job : jobs_->list())
    if (!job.recorded) unrecorded.push_back(job.id);
  for (size_t i = 0; i + most_interrupted < unrecorded.size(); ++i) {
    jobs_->forget(unrecorded[i]);
    if (const auto written = jobs_->persist(unrecorded[i]); !written) spdlog::warn("{}", written.error().message);
  }
}

void Booth::set_state(BoothState state) {
  {
    const std::lock_guard lock(state_mutex_);
    // A booth that stops does nothing else any more; one without devices cannot.
    if (state_ == BoothState::stopping || state_ == state) return;
    state_ = state;
    state_since_ = std::chrono::system_clock::now();
  }
  refresh();
}

/// Tells listeners when the state, or why no capture can start, is no longer what they were told last.
void Booth::refresh() {
  const std::lock_guard lock(state_mutex_);
  std::vector<Reason> reasons = find_reasons(state_);
  if (announced_ && announced_state_ == state_ && *announced_ == reasons) return;
  events_.publish(StateChanged{state_, announced_state_, reasons.empty(), reasons});
  announced_state_ = state_;
  announced_ = std::move(reasons);
}

std::vector<Reason> Booth::find_reasons(BoothState state) const {
  std::vector<Reason> reasons;
  if (state == BoothState::starting) reasons.push_back({"not_ready", "the booth is starting"});
  if (state == BoothState::stopping) reasons.push_back({"not_ready", "the booth is stopping"});
  if (state == BoothState::fault) reasons.push_back({"not_ready", "the booth has no devices: " + device_fault_});
  if (session_ != nullptr) {
    if (const auto busy = session_->occupation()) reasons.push_back({"busy", *busy});
    if (const DeviceStatus trigger = session_->trigger(); trigger.state == DeviceState::offline)
      reasons.push_back({"camera_unavailable", "the trigger is offline: " + trigger.message});
  }
  find_calibration_reasons(reasons);
  if (cameras_ != nullptr) {
    int online = 0;
    std::string offline;
    for (const CameraStatus& camera : cameras_->status()) {
      if (camera.role != CameraRole::body) continue;
      if (camera.state != DeviceState::offline)
        ++online;
      else
        offline += (offline.empty() ? "" : "; ") + camera.id + ": " + camera.message;
    }
    if (const int needed = options_.config.capture.min_cameras; online < needed)
      reasons.push_back({"camera_unavailable", std::to_string(online) + " body cameras are online, at least " +
                                                   std::to_string(needed) +
                                                   " are needed. Offline: " + (offline.empty() ? "none" : offline)});
  }
  if (backgrounds_->current() == nullptr)
    reasons.push_back({"no_background", "the booth has not learned its background yet"});
  if (const auto disk = check_disk(1, true); !disk) reasons.push_back({"disk_full", disk.error().message});
  return reasons;
}

void Booth::find_calibration_reasons(std::vector<Reason>& reasons) const {
  std::shared_ptr<const Rig> rig;
  std::string fault;
  {
    const std::lock_guard lock(rig_mutex_);
    rig = rig_;
    fault = rig_fault_;
  }
  if (rig == nullptr) {
    reasons.push_back({"not_calibrated", "the booth is not calibrated" + (fault.empty() ? "" : ": " + fault)});
    return;
  }
  if (cameras_ == nullptr) return;
  std::string without, otherwise;
  for (const CameraStatus& camera : cameras_->status()) {
    const RigCamera* calibrated = rig->find(camera.id);
    if (calibrated == nullptr)
      without += (without.empty() ? "" : ", ") + camera.id;
    else if (calibrated->role != camera.role)
      otherwise += (otherwise.empty() ? "" : ", ") + camera.id;
  }
  if (!without.empty())
    reasons.push_back({"not_calibrated", "the calibration does not know " + without +
                                             ": calibrate the booth, or take them out of the configuration"});
  if (!otherwise.empty())
    reasons.push_back({"not_calibrated", "body and face cameras are not those that were calibrated: " + otherwise +
                                             " has another role now"});
}

/// @param tolerated  kinds of reasons that do not matter now. @error the first of the others
Result<void> Booth::check_ready(const std::vector<std::string>& tolerated) const {
  BoothState state{};
  {
    const std::lock_guard lock(state_mutex_);
    state = state_;
  }
  for (const Reason& reason : find_reasons(state))
    if (std::find(tolerated.begin(), tolerated.end(), reason.kind) == tolerated.end())
      return Error{code_of(reason.kind), reason.message};
  return {};
}

Result<std::string> Booth::discover_cameras() {
  if (discoverer_ == nullptr) return Error{ErrorCode::not_ready, "the booth has no devices: " + device_fault_};
  const std::string task = tasks_.begin(TaskKind::discover);
  const bool taken = discoverer_->post([this, task] {
    try {
      tasks_.finish(task, TaskResult(look_for_cameras()));
    } catch (const std::exception& fault) {
      tasks_.finish(task, Error{ErrorCode::internal, "a driver has a fault: " + std::string(fault.what())});
    }
  });
  if (taken) return task;
  const Error busy{ErrorCode::busy, "the booth is looking for cameras already; try again in a moment"};
  tasks_.finish(task, busy);
  return busy;
}

CamerasDiscovered Booth::look_for_cameras() const {
  CamerasDiscovered found;
  for (const Driver& driver : drivers_) {
    const auto seen = driver.source->discover();
    if (!seen) {
      found.faults.push_back(driver.name + ": " + seen.error().message);
      continue;
    }
    for (const CameraInfo& camera : *seen) found.cameras.push_back({camera, cameras_->has(camera.id)});
  }
  return found;
}

Result<std::string> Booth::learn_background(std::optional<int> frames) {
  if (const auto ready = check_ready({"no_background"}); !ready) return ready.error();
  return session_->learn_background({.frames = frames.value_or(options_.config.capture.background_frames)});
}

Result<std::string> Booth::test_trigger() {
  if (session_ == nullptr) return Error{ErrorCode::not_ready, "the booth has no devices: " + device_fault_};
  return session_->test_trigger();
}

Result<std::string> Booth::calibrate_projector() {
  if (session_ == nullptr) return Error{ErrorCode::not_ready, "the booth has no devices: " + device_fault_};
  return session_->calibrate_projector();
}

/// A booth that is not calibrated, or has no background yet, needs neither for it.
Result<std::string> Booth::capture_board(const BoardRequest& request) {
  if (const auto ready = check_ready({"not_calibrated", "no_background"}); !ready) return ready.error();
  return session_->capture_board(request);
}

std::vector<BoothDevice> Booth::devices() const {
  std::vector<BoothDevice> devices;
  const auto rig = this->rig();
  for (const CameraStatus& camera : cameras_->status()) {
    BoothDevice& device = devices.emplace_back(BoothDevice{.id = camera.id, .role = camera.role});
    if (const RigCamera* calibrated = rig ? rig->find(camera.id) : nullptr; calibrated != nullptr)
      device.mount_rotation_deg = calibrated->mount_rotation_deg;
    // 0 may mean that nobody has said anything.
    if (const auto configured = mount_rotations_.find(camera.id);
        configured != mount_rotations_.end() && configured->second != 0)
      device.mount_rotation_deg = configured->second;
  }
  return devices;
}

Result<void> Booth::start_preview(const std::string& camera, PreviewSettings settings) {
  if (cameras_ == nullptr || !cameras_->has(camera)) return Error{ErrorCode::not_found, "there is no camera " + camera};
  const auto rig = this->rig();
  if (const RigCamera* calibrated = rig ? rig->find(camera) : nullptr; calibrated != nullptr)
    settings.rotation_deg = calibrated->mount_rotation_deg;
  else if (const auto configured = mount_rotations_.find(camera); configured != mount_rotations_.end())
    settings.rotation_deg = configured->second;
  previews_->start(camera, settings);
  return {};
}

Result<void> Booth::stop_preview(const std::string& camera) {
  if (cameras_ == nullptr || !cameras_->has(camera)) return Error{ErrorCode::not_found, "there is no camera " + camera};
  previews_->stop(camera);
  return {};
}

std::vector<PreviewPicture> Booth::take_previews() {
  if (previews_ == nullptr) return {};
  return previews_->take();
}

uint64_t Booth::capture_bytes(int frames, bool patterns) const {
  const auto rig = this->rig();
  return rig ? largest_capture_bytes(*rig, options_.config.capture.images, frames, patterns) : 0;
}

Result<void> Booth::check_disk(int frames, bool patterns) const {
  return disk_guard_.check(capture_bytes(frames, patterns));
}

/// Deletes what the configuration wants deleted; the next round comes when that is done.
void Booth::make_room() {
  const RetentionConfig& config = options_.config.retention;
  if (retiring_ > 0 || (config.max_age_h == 0 && config.max_captures == 0 && !config.make_room)) return;
  const auto avatars = avatars_->list(std::numeric_limits<size_t>::max(), "");
  if (!avatars) return;
  for (const std::string& id :
       avatars_to_delete(config, *avatars, *jobs_, std::chrono::system_clock::now(), check_disk(1, true).ok())) {
    spdlog::info("avatar {}: deleted with its recording, as [retention] says", id);
    metrics_.add("retired");
    ++retiring_;
    const auto begun = delete_avatar(id, [this](const Result<void>&) {
      --retiring_;  // what went wrong is in the log, and the next round tries again
    });
    if (!begun) --retiring_;
  }
}

/// A disk may have failed to remove what was deleted or given up; a booth runs for months between two starts.
void Booth::sweep() const {
  const IdentityConfig& booth = options_.config.booth;
  for (const fs::path& folder : {booth.recordings(), booth.avatars(), booth.backgrounds()})
    if (const auto removed = remove_partial_folders(folder); !removed) spdlog::warn("{}", removed.error().message);
}

std::optional<std::chrono::seconds> Booth::background_age() const {
  const auto background = backgrounds_->current();
  if (background == nullptr || background_is_played_) return std::nullopt;
  const auto created = parse_iso8601(background->created);
  if (!created) return std::nullopt;
  return std::max(std::chrono::seconds(0),
                  std::chrono::floor<std::chrono::seconds>(std::chrono::system_clock::now() - *created));
}

/// A background that no longer fits is learned again while nobody is there; who could be is not learned by himself.
void Booth::tend_background() {
  const BackgroundConfig& config = options_.config.background;
  if (session_ == nullptr || background_is_played_ || backgrounds_->current() == nullptr) return;
  const auto stale = health_.staleness(background_age());
  if (!stale) return;
  if (!config.relearn) return health_.ask_for_background(*stale);
  const auto now = SteadyClock::now();
  {
    const std::lock_guard lock(state_mutex_);
    if (state_ != BoothState::idle || now < next_relearning_ ||
        std::chrono::system_clock::now() - state_since_ < std::chrono::seconds(config.quiet_s))
      return;
  }
  if (!check_ready({})) return;
  next_relearning_ = now + relearning_pause;
  spdlog::info("the background is learned again: {}", *stale);
  if (const auto task =
          session_->learn_background({.frames = options_.config.capture.background_frames, .unattended = true});
      !task)
    spdlog::warn("the background is not learned again: {}", task.error().message);
}

void Booth::note_health() {
  const auto measured = metrics_.snapshot();
  const auto total = [&measured](const char* name) {
    const auto found = measured.find(name);
    return found == measured.end() ? 0 : found->second;
  };
  HealthObservation now{.time = std::chrono::system_clock::now(),
                        .steady = SteadyClock::now(),
                        .free_bytes = disk_guard_.free_bytes(),
                        .used_bytes = disk_guard_.used_bytes(),
                        .resident_bytes = static_cast<uint64_t>(resident_bytes()),
                        .descriptors = count_entries("/proc/self/fd"),
                        .threads = count_entries("/proc/self/task"),
                        .totals = {.captures_done = total("captures_done"),
                                   .captures_failed = total("captures_failed"),
                                   .jobs_done = total("jobs_done"),
                                   .jobs_failed = total("jobs_failed"),
                                   .job_seconds = total("job_seconds_sum")}};
  {
    const std::lock_guard lock(state_mutex_);
    now.ready = announced_ && announced_->empty();
  }
  for (const Job& job : jobs_->list())
    if (job.state == JobState::queued || job.state == JobState::running) ++now.queued;
  if (cameras_ != nullptr)
    for (const CameraStatus& camera : cameras_->status())
      now.cameras.push_back({.id = camera.id,
                             .offline = camera.state == DeviceState::offline,
                             .frames = camera.frames,
                             .dropped = camera.dropped});
  if (!history_->observe(now)) return;
  // A full queue of the disk has more important things in it: the next time will do.
  disk_executor_.post([this] {
    if (const auto saved = history_->save(); !saved) spdlog::warn("{}", saved.error().message);
  });
}

void Booth::prepare_background() {
  const auto background = backgrounds_->current();
  if (background == nullptr || background->folder == prepared_) return;
  prepared_ = background->folder;
  runner_->prepare(prepared_);
}

void Booth::keep_house(const std::stop_token& stop) {
  auto next_heartbeat = SteadyClock::now(), next_disk = next_heartbeat, next_sweep = next_heartbeat + first_sweep;
  bool disk_was_full = false;
  while (!stop.stop_requested()) {
    house_pulse_.beat();
    try {
      const auto now = SteadyClock::now();
      if (now >= next_disk) {
        disk_guard_.measure();
        next_disk = SteadyClock::now() + disk_pause;
        make_room();
        if (now >= next_sweep) {
          sweep();
          next_sweep = now + sweep_pause;
        }
        const auto disk = check_disk(1, true);
        if (!disk && !disk_was_full) events_.publish(Alert{Severity::error, "disk_full", disk.error().message});
        disk_was_full = !disk;
        tend_background();
        prepare_background();
        note_health();
      }
      refresh();
      if (now >= next_heartbeat) {
        const std::lock_guard lock(state_mutex_);
        events_.publish(Heartbeat{state_, announced_ && announced_->empty()});
        next_heartbeat = std::max(next_heartbeat + heartbeat_pause, now);
      }
    } catch (const std::exception& fault) {
      spdlog::error("housekeeping: {}", fault.what());
    }
    std::this_thread::sleep_for(house_pause);
  }
}

BoothStatus Booth::status() const {
  BoothStatus status;
  // Before everything else: what events up to it say must be in what follows.
  status.sequence = events_.sequence();
  status.boot = events_.boot();
  {
    const std::lock_guard lock(state_mutex_);
    status.state = state_;
    status.state_since = state_since_;
    status.not_ready = find_reasons(state_);
  }
  if (session_ != nullptr) {
    status.capture = session_->current();
    status.trigger = session_->trigger();
    status.projector = session_->projector();
  }
  if (cameras_ != nullptr) status.cameras = cameras_->status();
  {
    const std::lock_guard lock(rig_mutex_);
    status.calibration = calibration_;
  }
  status.tasks = tasks_.list();
  status.calibration.moved = health_.moved();
  status.calibration.session = calibration_desk_->session();
  if (const auto background = backgrounds_->current()) {
    status.background = {.learned = true, .created = background->created, .stale = health_.staleness(background_age())};
  }
  for (Job& job : jobs_->list())
    if (job.state != JobState::done) status.queue.push_back(std::move(job));
  status.disk = {.free_bytes = disk_guard_.free_bytes(),
                 .limit_bytes = disk_guard_.reserve_bytes(),
                 .used_bytes = disk_guard_.used_bytes(),
                 .quota_bytes = disk_guard_.quota_bytes(),
                 .capture_bytes = capture_bytes(1, true)};
  status.uptime_s = std::chrono::duration<double>(SteadyClock::now() - started_).count();
  return status;
}

std::map<std::string, double> Booth::measurements() const {
  std::map<std::string, double> values = metrics_.snapshot();
  values["uptime_s"] = std::chrono::duration<double>(SteadyClock::now() - started_).count();
  values["resident_bytes"] = resident_bytes();
  values["events"] = static_cast<double>(events_.sequence());
  values["events_lost"] = static_cast<double>(events_.lost());
  values["disk_free_bytes"] = static_cast<double>(disk_guard_.free_bytes());
  values["disk_used_bytes"] = static_cast<double>(disk_guard_.used_bytes());
  for (const JobState state :
       {JobState::queued, JobState::running, JobState::failed, JobState::done, JobState::cancelled})
    values["jobs_now_" + std::string(to_string(state))] = 0;
  for (const Job& job : jobs_->list()) values["jobs_now_" + std::string(to_string(job.state))] += 1;
  if (cameras_ != nullptr)
    for (const CameraStatus& camera : cameras_->status()) {
      values["camera_" + camera.id + "_frames"] = static_cast<double>(camera.frames);
      values["camera_" + camera.id + "_dropped"] = static_cast<double>(camera.dropped);
      for (const Statistic& statistic : camera.statistics)
        values["camera_" + camera.id + "_" + statistic.name] = statistic.value;
    }
  return values;
}

Result<std::string> Booth::start_capture(const CaptureRequest& request, CaptureSession::Acknowledge acknowledge) {
  if (session_ != nullptr && session_->current() == std::nullopt && request.face == FaceMode::active &&
      !session_->projector())
    return Error{ErrorCode::unsupported, "this booth has no projector: choose the face mode passive or none"};
  if (const auto ready = check_ready({}); !ready) return ready.error();
  if (request.face == FaceMode::active && !rig()->projector)
    return Error{ErrorCode::not_calibrated, "the projector is not calibrated: choose the face mode passive or none"};
  if (request.face == FaceMode::active && session_->projector()->state == DeviceState::offline)
    return Error{ErrorCode::device_lost, "the projector is offline: " + session_->projector()->message};
  return session_->start(request, std::move(acknowledge));
}

Result<void> Booth::cancel_capture(const std::string& capture) {
  if (session_ != nullptr) return session_->cancel(capture);
  if (jobs_->find(capture)) return Error{ErrorCode::invalid_state, "capture " + capture + " is over"};
  return Error{ErrorCode::not_found, "there is no capture " + capture};
}

Result<void> Booth::delete_capture(const std::string& capture, std::function<void(Result<void>)> done) {
  std::set<std::string> ids{capture};
  for (const std::string& avatar : avatars_->of_capture(capture)) ids.insert(avatar);
  // Nothing can have a name that is not one.
  if (!is_safe_id(capture)) return done({}), Result<void>{};
  return eraser_->erase(ids, std::move(done));
}

Result<void> Booth::delete_avatar(const std::string& avatar, std::function<void(Result<void>)> done) {
  if (!is_safe_id(avatar)) return done({}), Result<void>{};
  std::set<std::string> ids{avatar};
  if (const auto summary = avatars_->find(avatar); summary && !summary->capture.empty()) {
    ids.insert(summary->capture);
    for (const std::string& other : avatars_->of_capture(summary->capture)) ids.insert(other);
  }
  return eraser_->erase(ids, std::move(done));
}

void Booth::drain() {
  set_state(BoothState::stopping);
  if (session_ != nullptr) session_->drain(drain_patience);
  runner_->stop();
}

Pulse::TimePoint Booth::last_pulse() const {
  Pulse::TimePoint last = std::min({house_pulse_.last(), runner_->last_pulse(), disk_executor_.last_pulse()});
  if (session_ != nullptr) last = std::min(last, session_->last_pulse());
  return last;
}

}  // namespace booth
