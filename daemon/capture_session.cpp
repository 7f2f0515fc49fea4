#include "daemon/capture_session.h"

#include <pthread.h>
#include <spdlog/spdlog.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <exception>
#include <future>
#include <map>
#include <utility>

#include "daemon/collected_camera.h"
#include "daemon/identifier.h"
#include "daemon/projector_delay.h"
#include "replay/durable_folder.h"
#include "replay/recording_file.h"

namespace booth {
namespace {

constexpr Timestamp arm_patience = seconds(3);     ///< a camera that was just lost may be opened again within it
constexpr Timestamp arm_before_zero = seconds(1);  ///< so that the picture is taken at zero, not a while after
constexpr std::chrono::milliseconds countdown_slice{100};
constexpr std::chrono::milliseconds device_pause{1000};  ///< between two tries to open the trigger or the projector
constexpr size_t remembered_failures = 256;
constexpr int background_repeats = 3;                       ///< triggers in place of those that somebody missed
constexpr std::chrono::milliseconds background_pause{100};  ///< between two of its frames, so that motion is seen
constexpr double moved_share = 0.01;    ///< of a picture's cells, that change only when something moves
constexpr double altered_share = 0.03;  ///< of a picture's cells, that say that the booth is not what it was
/// A pattern that a camera missed is shown once more while the subject is still there; this many times in a sequence,
/// lest a bad cable keep somebody standing.
constexpr int most_repeats = 8;
/// So long the subject waits for a face camera that was lost in the sequence.
constexpr Timestamp return_patience = seconds(3);
constexpr std::chrono::milliseconds return_slice{20};

constexpr const char* background_shot = "background";
constexpr const char* body_shot = "body";
constexpr const char* face_shot = "face";

std::string join(const std::vector<std::string>& words) {
  std::string text;
  for (const std::string& word : words) text += (text.empty() ? "" : ", ") + word;
  return text;
}

Error was_cancelled() { return {ErrorCode::cancelled, "the capture was cancelled"}; }

bool has_all(const std::map<std::string, Frame>& frames, const std::vector<std::string>& cameras) {
  return std::all_of(cameras.begin(), cameras.end(),
                     [&](const std::string& camera) { return frames.contains(camera); });
}

/// What the calling thread does from now on waits for whoever takes frames.
void yield_to_cameras() {
  constexpr int niceness = 10;
  // Where that is refused, it competes.
  (void)::setpriority(PRIO_PROCESS, static_cast<id_t>(::gettid()), niceness);
}

double elapsed_s(Timestamp from, Timestamp to) { return static_cast<double>(to - from) / 1e9; }

}  // namespace

CaptureSession::CaptureSession(CaptureParts parts)
    : parts_(std::move(parts)),
      trigger_(parts_.trigger, [source = parts_.source] { return source->open_trigger(); }),
      encoders_(0) {
  if (parts_.projector)
    projector_.emplace(*parts_.projector, [source = parts_.source] { return source->open_projector(); });
  tend_devices();
  thread_ = std::jthread([this](const std::stop_token& stop) { run(stop); });
  pthread_setname_np(thread_.native_handle(), "capture");
}

CaptureSession::~CaptureSession() {
  drain(std::chrono::milliseconds(0));
  thread_.request_stop();
  thread_.join();
  end_announced();
}

std::optional<DeviceStatus> CaptureSession::projector() const {
  if (!projector_) return std::nullopt;
  return projector_->status();
}

std::optional<std::string> CaptureSession::current() const {
  const std::lock_guard lock(mutex_);
  if (!operation_ || !operation_->is_capture()) return std::nullopt;
  return operation_->id;
}

std::optional<std::string> CaptureSession::occupation() const {
  const std::lock_guard lock(mutex_);
  if (!operation_) return std::nullopt;
  if (std::holds_alternative<BackgroundRequest>(operation_->request)) return "the background is being learned";
  if (std::holds_alternative<TriggerTestRequest>(operation_->request)) return "the trigger is being tested";
  if (std::holds_alternative<ProjectorCalibrationRequest>(operation_->request))
    return "the projector is being calibrated";
  if (std::holds_alternative<BoardRequest>(operation_->request)) return "a shot of the board is being taken";
  return "capture " + operation_->id + " is under way";
}

Result<std::string> CaptureSession::start(const CaptureRequest& request, Acknowledge acknowledge) {
  if (request.face == FaceMode::active && !projector_)
    return Error{ErrorCode::unsupported, "this booth has no projector: choose the face mode passive or none"};
  const std::string id = make_capture_id(std::chrono::system_clock::now());
  const auto begun = begin({.id = id, .request = request, .stop = {}, .acknowledge = std::move(acknowledge)},
                           request.countdown_s > 0 ? BoothState::countdown : BoothState::capturing);
  if (!begun) return begun.error();
  return id;
}

Result<std::string> CaptureSession::learn_background(const BackgroundRequest& request) {
  if (parts_.rig() == nullptr)
    return Error{ErrorCode::not_calibrated,
                 "the booth is not calibrated: calibrate it before its background is learned"};
  return begin_task(TaskKind::background, request, BoothState::learning_background);
}

Result<std::string> CaptureSession::test_trigger() {
  return begin_task(TaskKind::trigger_test, TriggerTestRequest{}, BoothState::calibrating);
}

Result<std::string> CaptureSession::calibrate_projector() {
  if (!projector_) return Error{ErrorCode::unsupported, "this booth has no projector"};
  return begin_task(TaskKind::projector_calibration, ProjectorCalibrationRequest{}, BoothState::calibrating);
}

Result<std::string> CaptureSession::begin_task(TaskKind kind, const Request& request, BoothState state) {
  if (const auto busy = occupation()) return Error{ErrorCode::busy, *busy};
  const std::string task = parts_.tasks.begin(kind);
  const auto begun = begin({.id = task, .request = request, .stop = {}}, state);
  if (begun) return task;
  parts_.tasks.finish(task, begun.error());
  return begun.error();
}

Result<void> CaptureSession::begin(Operation operation, BoothState state) {
  const std::lock_guard transition(transition_mutex_);
  if (const auto busy = occupation()) return Error{ErrorCode::busy, *busy};
  if (operation.is_capture())
    if (const auto noted = parts_.journal.begin(operation.id); !noted) return noted;
  bool taken = false;
  {
    const std::lock_guard lock(mutex_);
    if (taken = !draining_; taken) operation_ = operation;
  }
  if (!taken) {
    if (operation.is_capture()) end_journal(operation.id);
    return Error{ErrorCode::not_ready, "the booth is stopping"};
  }
  // Before the thread may see it: the states that it sets come after this one.
  parts_.set_state(state);
  {
    const std::lock_guard lock(mutex_);
    pending_ = true;
  }
  changed_.notify_all();
  return {};
}

Result<void> CaptureSession::cancel(const std::string& id) {
  const std::lock_guard lock(mutex_);
  const Error over{ErrorCode::invalid_state, "capture " + id + " is over"};
  if (operation_ && operation_->id == id && operation_->is_capture()) {
    if (operation_->committing) return over;
    operation_->stop.request_stop();
    return {};
  }
  if (parts_.jobs.find(id) || std::find(over_.begin(), over_.end(), id) != over_.end()) return over;
  return Error{ErrorCode::not_found, "there is no capture " + id};
}

void CaptureSession::abandon(const std::string& id) {
  const std::lock_guard lock(mutex_);
  over_.erase(std::remove(over_.begin(), over_.end(), id), over_.end());
  if (!operation_ || operation_->id != id) return;
  operation_->abandoned = true;
  operation_->stop.request_stop();
}

void CaptureSession::wait_over(const std::string& id) {
  std::unique_lock lock(mutex_);
  changed_.wait(lock, [&] { return !operation_ || operation_->id != id; });
}

void CaptureSession::drain(std::chrono::milliseconds patience) {
  std::unique_lock lock(mutex_);
  draining_ = true;
  if (operation_ && operation_->stoppable) operation_->stop.request_stop();
  if (changed_.wait_for(lock, patience, [this] { return !operation_; })) return;
  operation_->stop.request_stop();
  changed_.wait(lock, [this] { return !operation_; });
}

bool CaptureSession::begin_commit(const std::string& id) {
  const std::lock_guard lock(mutex_);
  if (!operation_ || operation_->id != id || operation_->stop.stop_requested()) return false;
  return operation_->committing = true;
}

void CaptureSession::run(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    pulse_.beat();
    std::optional<Operation> operation;
    {
      std::unique_lock lock(mutex_);
      if (changed_.wait_for(lock, stop, device_pause, [this] { return pending_; })) {
        pending_ = false;
        operation = operation_;
      }
    }
    try {
      if (operation)
        std::visit([&](const auto& request) { carry_out(*operation, request); }, operation->request);
      else
        tend_devices(), end_announced();
    } catch (const std::exception& fault) {
      spdlog::error("the capture thread: {}", fault.what());
    }
  }
}

void CaptureSession::end_announced() {
  for (const std::string& id : announced_) end_journal(id);
  announced_.clear();
}

void CaptureSession::tend_devices() {
  // What opening returns is in the slots' status.
  const auto now = std::chrono::steady_clock::now();
  trigger_.tend(now);
  if (projector_) projector_->tend(now);
}

template <class TaskRequest>
void CaptureSession::carry_out(const Operation& operation, const TaskRequest& request) {
  Result<TaskResult> result = was_cancelled();
  try {
    result = work(operation.id, request, operation.stop.get_token());
  } catch (const std::exception& fault) {
    result = Error{ErrorCode::internal, "the booth's program has a fault: " + std::string(fault.what())};
  }
  end_operation(false);
  parts_.tasks.finish(operation.id, result);
}

/// @param failed  it was a capture, of which somebody may still ask what became of it
void CaptureSession::end_operation(bool failed) {
  const std::lock_guard transition(transition_mutex_);
  {
    const std::lock_guard lock(mutex_);
    if (failed && !operation_->abandoned) over_.push_back(operation_->id);
    if (over_.size() > remembered_failures) over_.pop_front();
    operation_.reset();
  }
  changed_.notify_all();
  parts_.set_state(BoothState::idle);
}

bool CaptureSession::is_draining() const {
  const std::lock_guard lock(mutex_);
  return draining_;
}

void CaptureSession::end_journal(const std::string& id) const {
  // An entry that stays is looked into at the next start.
  if (const auto ended = parts_.journal.end(id); !ended) spdlog::warn("{}", ended.error().message);
}

void CaptureSession::carry_out(const Operation& operation, const CaptureRequest& request) {
  const std::string& id = operation.id;
  spdlog::info("capture {}: started", id);
  const Timestamp started = parts_.clock.now();
  bool acknowledged = false;
  const auto acknowledge = [&](const Result<std::string>& begun) {
    if (operation.acknowledge) operation.acknowledge(begun);
    acknowledged = true;
  };
  Result<void> taken;
  try {
    taken = parts_.journal.sync(id);
    if (taken) {
      acknowledge(id);
      taken = take(id, request, operation.stop.get_token());
    }
  } catch (const std::exception& fault) {
    taken = Error{ErrorCode::internal, "the booth's program has a fault: " + std::string(fault.what())};
  }

  if (!conclude(id, request, taken.ok()) && taken) taken = Error{ErrorCode::cancelled, "the capture was deleted"};

  parts_.metrics.observe("capture_seconds", elapsed_s(started, parts_.clock.now()));
  if (!taken) {
    parts_.metrics.add("captures_failed");
    spdlog::warn("capture {}: failed: {}: {}", id, to_string(taken.error().code), taken.error().message);
    parts_.events.publish(CaptureFailed{id, taken.error()});
    if (!acknowledged) {
      end_journal(id);
      return acknowledge(taken.error());
    }
    // Who no longer hears that, because the booth stops or is killed now, is told after the next start.
    if (!is_draining()) announced_.push_back(id);
    return;
  }
  // Without its file the job would be made anew at the next start: nothing is lost.
  if (const auto written = parts_.jobs.persist(id); !written)
    parts_.events.publish(
        Alert{Severity::warning, std::string(to_string(written.error().code)), written.error().message});
  parts_.metrics.add("captures_done");
  spdlog::info("capture {}: done", id);
  parts_.events.publish(CaptureDone{id, id});
  parts_.jobs.release(id);  // so that listeners hear of the capture's end before the job's beginning
  end_journal(id);
}

/// The capture is over. @return whether its recording stays, and its job is queued
bool CaptureSession::conclude(const std::string& id, const CaptureRequest& request, bool taken) {
  bool stays = taken;
  if (taken) {
    const std::lock_guard lock(mutex_);
    stays = !operation_->abandoned;
    // From here on whoever deletes it finds the job.
    if (stays) parts_.jobs.add({.id = id, .face = std::string(to_string(request.face)), .label = request.label});
  }
  if (!stays) parts_.head_start.drop(id);
  if (taken && !stays) {
    // Deleted while it was written: whoever waits for its end finds nothing left.
    if (const auto removed = remove_folder(parts_.recordings, id); !removed)
      spdlog::error("capture {}: {}", id, removed.error().message);
  }
  end_operation(!stays);
  return stays;
}

Result<void> CaptureSession::take(const std::string& id, const CaptureRequest& request,
                                  const std::stop_token& cancelled) {
  if (const auto room = parts_.check_disk(1, request.face == FaceMode::active || request.face == FaceMode::automatic);
      !room)
    return room;
  const auto rig = parts_.rig();
  if (rig == nullptr) return Error{ErrorCode::not_calibrated, "the booth is not calibrated"};
  const auto background = parts_.backgrounds.current();
  if (background == nullptr) return Error{ErrorCode::no_background, "the booth has not learned its background yet"};
  auto writer = RecordingWriter::begin(parts_.recordings,
                                       {.id = id,
                                        .created = iso8601(std::chrono::system_clock::now()),
                                        .label = request.label,
                                        .face = std::string(to_string(request.face))},
                                       *rig, parts_.config.images);
  if (!writer) return writer.error();
  if (const auto added = (*writer)->add_shot(*background, *background->find(ShotRole::background)); !added)
    return added.error().code == ErrorCode::disk_full
               ? added.error()
               : Error{ErrorCode::no_background,
                       "the learned background does not fit, learn it again: " + added.error().message};
  show_so_far(id, request.face, **writer);

  CollectedShot body;
  {
    const Timestamp zero = parts_.clock.now() + static_cast<Timestamp>(request.countdown_s * 1e9);
    double next_s = request.countdown_s > 0 ? request.countdown_s : -1;
    if (const auto counted = count_down(id, zero - arm_before_zero, zero, next_s, cancelled); !counted) return counted;
    FrameCollector collector = arm(parts_.cameras.ids(), ShotRole::body, 1 + parts_.config.retries);
    collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);
    if (const auto counted = count_down(id, zero, zero, next_s, cancelled); !counted) return counted;
    begin_capturing();
    auto taken = take_body(id, collector, cancelled);
    if (!taken) return taken.error();
    body = std::move(*taken);
  }
  const bool patterns = patterns_wanted(request.face);
  if (const auto begun = (*writer)->begin_shot({.name = body_shot, .role = ShotRole::body}); !begun) return begun;
  // Beside the patterns, so that the reconstruction can begin while they are shown.
  auto body_written = std::async(patterns ? std::launch::async : std::launch::deferred, [&, patterns] {
    if (patterns) yield_to_cameras();
    const auto written = write(**writer, body_shot, body.set.frames, patterns ? Work{} : encoders_.work(), cancelled);
    if (written) show_so_far(id, request.face, **writer);
    return written;
  });
  std::vector<Frame> face;
  if (patterns) {
    auto taken = take_patterns(id, parts_.cameras.ids(CameraRole::face), cancelled);
    if (taken)
      face = std::move(*taken);
    else if (request.face == FaceMode::active || cancelled.stop_requested())
      return taken.error();
    else
      parts_.events.publish(Alert{Severity::warning, "camera_unavailable",
                                  "the face is made without the projector: " + taken.error().message});
  }

  // The subject may move again; the disk has time.
  if (const auto written = body_written.get(); !written) return written;
  if (!face.empty()) {
    const auto projector = projector_->get();
    if (!projector) return projector.error();
    if (const auto begun = (*writer)->begin_shot(
            {.name = face_shot, .role = ShotRole::gray_code, .pattern = (*projector)->info().pattern});
        !begun)
      return begun;
    if (const auto written = write(**writer, face_shot, face, encoders_.work(), cancelled); !written) return written;
  }
  if (!begin_commit(id)) return was_cancelled();
  pulse_.beat();
  return (*writer)->commit();
}

/// Lets the reconstruction begin with what there is.
void CaptureSession::show_so_far(const std::string& id, FaceMode face, RecordingWriter& writer) {
  const auto folder = writer.show_so_far();
  if (!folder) return spdlog::warn("capture {}: its reconstruction begins later: {}", id, folder.error().message);
  parts_.head_start.grow(id, std::string(to_string(face)), *folder);
}

/// Announces the seconds that are left, from `next_s` on, until `until`.
Result<void> CaptureSession::count_down(const std::string& id, Timestamp until, Timestamp zero, double& next_s,
                                        const std::stop_token& cancelled) {
  for (;;) {
    pulse_.beat();
    const Timestamp now = parts_.clock.now();
    while (next_s >= 0 && now >= zero - static_cast<Timestamp>(next_s * 1e9)) {
      parts_.events.publish(CountdownTick{id, next_s});
      next_s = next_s == 0 ? -1 : std::ceil(next_s) - 1;
    }
    if (now >= until) return {};
    std::unique_lock lock(mutex_);
    const auto left = std::chrono::nanoseconds(until - now);
    changed_.wait_for(lock, cancelled, std::min<std::chrono::nanoseconds>(left, countdown_slice), [] { return false; });
    if (cancelled.stop_requested()) return was_cancelled();
  }
}

void CaptureSession::begin_capturing() {
  {
    const std::lock_guard lock(mutex_);
    operation_->stoppable = false;
  }
  parts_.set_state(BoothState::capturing);
}

FrameCollector CaptureSession::arm(std::vector<std::string> cameras, ShotRole role, int count) const {
  return {parts_.cameras, std::move(cameras), role, count, milliseconds(parts_.config.max_skew_ms), parts_.clock};
}

Result<CollectedShot> CaptureSession::fire_and_collect(FrameCollector& collector, ShotRole role,
                                                       const std::stop_token& cancelled) {
  pulse_.beat();
  const auto trigger = trigger_.get();
  if (!trigger) return Error{ErrorCode::device_lost, "the trigger cannot be used: " + trigger.error().message};
  (*trigger)->prepare(role);
  const auto fired = (*trigger)->fire();
  if (!fired) {
    trigger_.lose(fired.error());
    return Error{ErrorCode::device_lost, "the trigger did not fire: " + fired.error().message};
  }
  CollectedShot shot = collector.collect(*fired, *fired + milliseconds(parts_.config.frame_timeout_ms), cancelled);
  if (cancelled.stop_requested()) return was_cancelled();
  tell(shot.remarks);
  return shot;
}

void CaptureSession::tell(const std::vector<std::string>& remarks) {
  for (const std::string& remark : remarks) {
    parts_.metrics.add("shot_remarks");
    parts_.events.publish(Alert{Severity::warning, "camera_unavailable", remark});
  }
}

/// The person still stands there: what a camera missed is taken again at once, by all cameras, for the frames of a shot
/// must show one instant. The shot with the most cameras counts.
Result<CollectedShot> CaptureSession::take_body(const std::string& id, FrameCollector& collector,
                                                const std::stop_token& cancelled) {
  const Timestamp begun = parts_.clock.now();
  CollectedShot best;
  int retries = 0;
  for (int attempt = 0; attempt <= parts_.config.retries; ++attempt) {
    auto shot = fire_and_collect(collector, ShotRole::body, cancelled);
    if (!shot) return shot;
    retries = attempt;
    const bool worth_it = std::any_of(shot->missing.begin(), shot->missing.end(),
                                      [&](const std::string& camera) { return collector.is_reachable(camera); });
    if (attempt == 0 || shot->set.frames.size() > best.set.frames.size()) best = std::move(*shot);
    if (best.missing.empty() || !worth_it) break;
  }
  const Timestamp decided = parts_.clock.now();
  parts_.metrics.observe("shot_decision_seconds", elapsed_s(begun, decided));
  parts_.metrics.add("shot_retries", retries);
  parts_.events.publish(ShotTaken{.capture = id,
                                  .role = ShotRole::body,
                                  .index = 0,
                                  .of = 1,
                                  .cameras = static_cast<int>(best.set.frames.size()),
                                  .missing = best.missing,
                                  .skew_us = best.skew_us,
                                  .retries = retries,
                                  .offsets_us = best.offsets_us,
                                  .decided_ms = 1e3 * elapsed_s(begun, decided)});
  if (const auto enough = check_enough(best); !enough) return enough.error();
  for (Frame& frame : best.set.frames) frame.index = 0;
  return best;
}

/// @error device_lost  names the cameras that are missing
Result<void> CaptureSession::check_enough(const CollectedShot& shot) const {
  int delivered = 0;
  for (const std::string& camera : parts_.cameras.ids(CameraRole::body))
    delivered += std::find(shot.missing.begin(), shot.missing.end(), camera) == shot.missing.end() ? 1 : 0;
  if (delivered >= parts_.config.min_cameras) return {};
  return Error{ErrorCode::device_lost, "only " + std::to_string(delivered) + " body cameras delivered, at least " +
                                           std::to_string(parts_.config.min_cameras) +
                                           " are needed; missing: " + join(shot.missing)};
}

bool CaptureSession::patterns_wanted(FaceMode mode) {
  if (mode == FaceMode::active) return true;
  if (mode != FaceMode::automatic || !projector_) return false;
  const auto without = [&](const std::string& why) {
    parts_.events.publish(
        Alert{Severity::warning, "camera_unavailable", "the face is made without the projector: " + why});
    return false;
  };
  if (!parts_.rig()->projector) return without("it is not calibrated");
  if (parts_.cameras.ids(CameraRole::face).empty()) return without("the booth has no face cameras");
  const auto projector = projector_->get();
  return projector || without("it cannot be used: " + projector.error().message);
}

/// Pattern by pattern, and at the end once more those that a camera missed that is back. Frames come back with the
/// pattern's index.
Result<std::vector<Frame>> CaptureSession::take_patterns(const std::string& id, const std::vector<std::string>& cameras,
                                                         const std::stop_token& cancelled) {
  const auto opened = projector_->get();
  if (!opened) return Error{ErrorCode::device_lost, "the projector cannot be used: " + opened.error().message};
  // Nobody is left in a flickering light, whichever way this ends.
  struct Darkened {
    Projector* projector;
    ~Darkened() {
      if (projector != nullptr) projector->dark();
    }
  } lit{*opened};

  const int patterns = pattern_count(lit.projector->info().pattern);
  int repeats_left = most_repeats;
  std::vector<std::map<std::string, Frame>> delivered(static_cast<size_t>(patterns));  // by pattern and camera
  const auto take_all = [&](const std::vector<std::string>& asked, bool again) -> Result<void> {
    FrameCollector collector = arm(asked, ShotRole::gray_code, patterns + most_repeats);
    collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);
    for (int pattern = 0; pattern < patterns; ++pattern) {
      auto& frames = delivered[static_cast<size_t>(pattern)];
      if (has_all(frames, asked)) continue;
      const auto taken = take_pattern(id, *lit.projector, {pattern, asked, cameras, again}, frames, collector,
                                      repeats_left, cancelled);
      if (!taken) return taken;
    }
    return {};
  };
  auto taken = take_all(cameras, false);
  const Timestamp deadline = parts_.clock.now() + return_patience;
  while (taken) {
    const auto returned = wait_returned(cameras, delivered, deadline, cancelled);
    if (returned.empty() || parts_.clock.now() >= deadline) break;
    taken = take_all(returned, true);
    // One that is lost again, or only now found to be lost, may come back yet.
    if (!taken && taken.error().code == ErrorCode::not_ready) taken = {};
  }
  if (!taken && taken.error().code == ErrorCode::io) {
    // One that does not show what it should is opened anew next time, which leaves it dark.
    lit.projector = nullptr;
    projector_->lose(taken.error());
  }
  if (!taken)
    return cancelled.stop_requested() ? was_cancelled() : Error{ErrorCode::device_lost, taken.error().message};
  std::vector<Frame> frames;
  for (auto& of_pattern : delivered)
    for (auto& [camera, frame] : of_pattern) frames.push_back(std::move(frame));
  return frames;
}

/// The cameras that missed patterns though they took others, and are online: those that were lost are waited for until
/// `deadline`, as their frames so far are worth nothing without the rest.
std::vector<std::string> CaptureSession::wait_returned(const std::vector<std::string>& cameras,
                                                       const std::vector<std::map<std::string, Frame>>& delivered,
                                                       Timestamp deadline, const std::stop_token& cancelled) {
  std::vector<std::string> incomplete;
  for (const std::string& camera : cameras) {
    const auto count =
        std::count_if(delivered.begin(), delivered.end(), [&](const auto& frames) { return frames.contains(camera); });
    if (count > 0 && count < static_cast<std::ptrdiff_t>(delivered.size())) incomplete.push_back(camera);
  }
  const auto is_away = [&](const std::string& camera) {
    return parts_.cameras.camera(camera).status().state == DeviceState::offline;
  };
  while (std::any_of(incomplete.begin(), incomplete.end(), is_away) && parts_.clock.now() < deadline) {
    pulse_.beat();
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, cancelled, return_slice, [] { return false; });
    if (cancelled.stop_requested()) return {};
  }
  incomplete.erase(std::remove_if(incomplete.begin(), incomplete.end(), is_away), incomplete.end());
  return incomplete;
}

/// Shows one pattern and takes it with the cameras that have no frame of it yet; once more, as long as `repeats_left`
/// lasts, where one missed it.
/// @error io  the projector failed; not_ready  no camera is left that could take it; device_lost  the trigger failed
Result<void> CaptureSession::take_pattern(const std::string& id, Projector& projector, const WantedPattern& wanted,
                                          std::map<std::string, Frame>& delivered, FrameCollector& collector,
                                          int& repeats_left, const std::stop_token& cancelled) {
  const Timestamp begun = parts_.clock.now();
  ShotTaken report{.capture = id,
                   .role = ShotRole::gray_code,
                   .index = wanted.pattern,
                   .of = pattern_count(projector.info().pattern),
                   .cameras = 0,
                   .missing = {},
                   .skew_us = 0,
                   .retries = wanted.again ? 1 : 0};
  for (;; ++report.retries, --repeats_left) {
    if (cancelled.stop_requested()) return was_cancelled();
    if (collector.reachable() == 0)
      return Error{ErrorCode::not_ready, "no camera takes the projected patterns: " + join(wanted.cameras)};
    if (const auto shown = projector.show(wanted.pattern); !shown)
      return Error{ErrorCode::io, "the projector failed: " + shown.error().message};
    auto shot = fire_and_collect(collector, ShotRole::gray_code, cancelled);
    if (!shot) return shot.error();
    report.skew_us = std::max(report.skew_us, shot->skew_us);
    for (Frame& frame : shot->set.frames) {
      frame.index = wanted.pattern;
      report.offsets_us.try_emplace(frame.camera, shot->offsets_us[frame.camera]);
      delivered.try_emplace(frame.camera, std::move(frame));
    }
    const bool worth_it = std::any_of(wanted.cameras.begin(), wanted.cameras.end(), [&](const std::string& camera) {
      return !delivered.contains(camera) && collector.is_reachable(camera);
    });
    if (!worth_it || repeats_left == 0) break;
  }
  parts_.metrics.add("shot_retries", report.retries);
  report.cameras = static_cast<int>(delivered.size());
  for (const std::string& camera : wanted.all)
    if (!delivered.contains(camera)) report.missing.push_back(camera);
  report.decided_ms = 1e3 * elapsed_s(begun, parts_.clock.now());
  parts_.events.publish(report);
  return {};
}

Result<void> CaptureSession::write(RecordingWriter& writer, const std::string& shot, const std::vector<Frame>& frames,
                                   const Work& work, const std::stop_token& cancelled) {
  std::mutex mutex;
  Result<void> outcome;
  work.parallel_for(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !cancelled.stop_requested(); ++i) {
      const auto added = writer.add(shot, frames[i]);
      const std::lock_guard lock(mutex);
      if (!added && outcome) outcome = added;
    }
  });
  if (cancelled.stop_requested()) return was_cancelled();
  return outcome;
}

Result<TaskResult> CaptureSession::work(const std::string& task, const BackgroundRequest& request,
                                        const std::stop_token& cancelled) {
  auto learned = learn(task, request, cancelled);
  if (learned)
    parts_.background_learned({});
  else if (request.unattended && !cancelled.stop_requested())
    parts_.background_learned(learned.error());
  return learned;
}

Result<TaskResult> CaptureSession::learn(const std::string& task, const BackgroundRequest& request,
                                         const std::stop_token& cancelled) {
  if (const auto room = parts_.check_disk(request.frames, false); !room) return room.error();
  const auto rig = parts_.rig();
  if (rig == nullptr) return Error{ErrorCode::not_calibrated, "the booth is not calibrated"};
  const auto now = std::chrono::system_clock::now();
  const std::string id = make_capture_id(now);
  BackgroundLearned learned{.created = iso8601(now), .missing = {}, .warnings = {}};
  auto writer = parts_.backgrounds.begin(*rig, parts_.config.images, id, learned.created);
  if (!writer) return writer.error();
  if (const auto begun = (*writer)->begin_shot({.name = background_shot, .role = ShotRole::background}); !begun)
    return begun.error();
  const auto views = take_background(task, request.frames, **writer, cancelled);
  if (!views) return views.error();

  // Whoever stands in the booth now would be missing from every avatar.
  std::vector<std::string> moved;
  for (const auto& [camera, seen] : *views) {
    learned.frames = std::max(learned.frames, static_cast<int>(seen.size()));
    if (changed_share(seen) > moved_share) moved.push_back(camera);
  }
  if (!moved.empty())
    return Error{ErrorCode::not_ready,
                 "something moved in front of " + join(moved) +
                     ": the booth must be empty and its light steady; learn the background again"};
  if (const auto warning = compare_with_last(*views)) {
    if (request.unattended) return Error{ErrorCode::not_ready, *warning};
    learned.warnings.push_back(*warning);
  }
  for (const std::string& camera : parts_.cameras.ids())
    if (!views->contains(camera)) learned.missing.push_back(camera);
  if (!learned.missing.empty())
    learned.warnings.push_back("the background was learned without " + join(learned.missing) +
                               ", which delivered no frame");

  if (cancelled.stop_requested()) return was_cancelled();
  if (const auto stored = parts_.backgrounds.finish(**writer, id); !stored) return stored.error();
  for (const std::string& warning : learned.warnings)
    parts_.events.publish(Alert{Severity::warning, "no_background", warning});
  return TaskResult(learned);
}

/// Writes frames of the empty booth, numbered by camera, and returns what they show.
Result<CaptureSession::Views> CaptureSession::take_background(const std::string& task, int frames,
                                                              RecordingWriter& writer,
                                                              const std::stop_token& cancelled) {
  const int triggers = frames + background_repeats;
  FrameCollector collector = arm(parts_.cameras.ids(), ShotRole::background, triggers);
  collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);
  Views views;
  for (int trigger = 0; trigger < triggers; ++trigger) {
    auto shot = fire_and_collect(collector, ShotRole::background, cancelled);
    if (!shot) return shot.error();
    if (trigger == 0)
      if (const auto enough = check_enough(*shot); !enough) return enough.error();
    std::vector<Frame> wanted;
    for (Frame& frame : shot->set.frames) {
      std::vector<CoarseView>& seen = views[frame.camera];
      if (seen.size() == static_cast<size_t>(frames)) continue;
      frame.index = static_cast<int>(seen.size());
      seen.push_back(coarse_view(frame));
      wanted.push_back(std::move(frame));
    }
    if (const auto written = write(writer, background_shot, wanted, encoders_.work(), cancelled); !written)
      return written.error();
    parts_.tasks.progress(task, std::min(1.0, (trigger + 1.0) / frames));
    if (std::all_of(views.begin(), views.end(),
                    [&](const auto& view) { return view.second.size() == static_cast<size_t>(frames); }))
      break;
    std::unique_lock lock(mutex_);
    changed_.wait_for(lock, cancelled, background_pause, [] { return false; });
  }
  return views;
}

/// A sentence when most cameras see something else than when the background was learned last.
std::optional<std::string> CaptureSession::compare_with_last(const Views& views) const {
  const auto before = parts_.backgrounds.current();
  if (before == nullptr) return std::nullopt;
  size_t compared = 0, altered = 0;
  for (const FrameRecord& record : before->find(ShotRole::background)->frames) {
    const auto seen = views.find(record.camera);
    if (seen == views.end() || record.index != 0) continue;
    const auto earlier = load_frame(*before, record);
    if (!earlier) continue;
    ++compared;
    const std::vector<CoarseView> pair{coarse_view(*earlier), seen->second.front()};
    altered += changed_share(pair) > altered_share ? 1 : 0;
  }
  if (2 * altered <= compared) return std::nullopt;
  return "the booth looks different from when it was learned last, for " + std::to_string(altered) + " of " +
         std::to_string(compared) + " cameras: if somebody stood in it, learn the background again";
}

Result<TaskResult> CaptureSession::work(const std::string&, const TriggerTestRequest&,
                                        const std::stop_token& cancelled) {
  FrameCollector collector = arm(parts_.cameras.ids(), ShotRole::body, 1);
  collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);
  const auto shot = fire_and_collect(collector, ShotRole::body, cancelled);
  if (!shot) return shot.error();
  return TaskResult(TriggerTested{shot->offsets_us, shot->missing, shot->skew_us, shot->remarks});
}

Result<TaskResult> CaptureSession::work(const std::string&, const ProjectorCalibrationRequest&,
                                        const std::stop_token& cancelled) {
  const auto opened = projector_->get();
  if (!opened) return Error{ErrorCode::device_lost, "the projector cannot be used: " + opened.error().message};
  auto* const projector = dynamic_cast<FlippingProjector*>(*opened);
  if (projector == nullptr)
    return Error{ErrorCode::unsupported,
                 "the projector does not tell when a pattern goes out: only one on a display output has a delay that "
                 "can be measured"};
  const auto trigger = trigger_.get();
  if (!trigger) return Error{ErrorCode::device_lost, "the trigger cannot be used: " + trigger.error().message};
  const std::vector<std::string> faces = parts_.cameras.ids(CameraRole::face);
  if (faces.empty()) return Error{ErrorCode::not_ready, "the booth has no face camera that could see the projector"};

  // The first that sees it will do.
  Result<DelayCalibration> measured = Error{};
  std::string camera, why_not;
  for (const std::string& id : faces) {
    pulse_.beat();
    camera = id;
    CollectedCamera looking(parts_.cameras, id, arm_patience, milliseconds(parts_.config.max_skew_ms), parts_.clock,
                            cancelled);
    measured = calibrate_delay(*projector, *trigger, looking, parts_.clock, parts_.delay_calibration,
                               [this] { pulse_.beat(); });
    if (cancelled.stop_requested()) return was_cancelled();
    if (measured) break;
    why_not += (why_not.empty() ? "" : "; ") + measured.error().message;
  }
  if (!measured) return Error{measured.error().code, why_not};
  if (const auto written = write_projector_delay(parts_.projector_delay, {projector->info().id, measured->delay_us,
                                                                          iso8601(std::chrono::system_clock::now())});
      !written)
    return written.error();
  projector_->reopen();
  return TaskResult(ProjectorCalibrated{measured->delay_us, measured->measured_us, measured->contrast, camera});
}

}  // namespace booth
