#include "daemon/capture_session.h"

#include <pthread.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <exception>
#include <map>
#include <utility>

#include "daemon/identifier.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

constexpr Timestamp arm_patience = seconds(3);     ///< a camera that was just lost may be opened again within it
constexpr Timestamp arm_before_zero = seconds(1);  ///< so that the picture is taken at zero, not a while after
constexpr std::chrono::milliseconds countdown_slice{100};
constexpr std::chrono::milliseconds device_pause{1000};  ///< between two tries to open the trigger or the projector
constexpr size_t remembered_failures = 256;
/// A pattern that a camera missed is shown once more while the subject is still there; this many times in a sequence,
/// lest a bad cable keep somebody standing.
constexpr int most_repeats = 8;

constexpr const char* body_shot = "body";
constexpr const char* face_shot = "face";

std::string join(const std::vector<std::string>& words) {
  std::string text;
  for (const std::string& word : words) text += (text.empty() ? "" : ", ") + word;
  return text;
}

Error was_cancelled() { return {ErrorCode::cancelled, "the capture was cancelled"}; }

double elapsed_s(Timestamp from, Timestamp to) { return static_cast<double>(to - from) / 1e9; }

}  // namespace

CaptureSession::CaptureSession(CaptureParts parts)
    : parts_(std::move(parts)),
      trigger_("trigger", [source = parts_.source] { return source->open_trigger(); }),
      encoders_(0) {
  if (parts_.rig.projector)
    projector_.emplace(parts_.rig.projector->id, [source = parts_.source] { return source->open_projector(); });
  tend_devices();
  thread_ = std::jthread([this](const std::stop_token& stop) { run(stop); });
  pthread_setname_np(thread_.native_handle(), "capture");
}

CaptureSession::~CaptureSession() {
  drain(std::chrono::milliseconds(0));
  thread_.request_stop();
}

std::optional<DeviceStatus> CaptureSession::projector() const {
  if (!projector_) return std::nullopt;
  return projector_->status();
}

std::optional<std::string> CaptureSession::current() const {
  const std::lock_guard lock(mutex_);
  if (!capture_) return std::nullopt;
  return capture_->id;
}

Result<std::string> CaptureSession::start(const CaptureRequest& request) {
  if (request.face == FaceMode::active && !projector_)
    return Error{ErrorCode::unsupported, "this booth has no projector: choose the face mode passive or none"};
  const std::string id = make_capture_id(std::chrono::system_clock::now());
  const std::lock_guard transition(transition_mutex_);
  {
    const std::lock_guard lock(mutex_);
    if (draining_) return Error{ErrorCode::not_ready, "the booth is stopping"};
    if (capture_) return Error{ErrorCode::busy, "capture " + capture_->id + " is under way"};
    capture_ = Capture{.id = id, .request = request, .stop = {}};
  }
  // Before the thread may see it: the states that it sets come after this one.
  parts_.set_state(request.countdown_s > 0 ? BoothState::countdown : BoothState::capturing);
  {
    const std::lock_guard lock(mutex_);
    pending_ = true;
  }
  changed_.notify_all();
  return id;
}

Result<void> CaptureSession::cancel(const std::string& id) {
  const std::lock_guard lock(mutex_);
  const Error over{ErrorCode::invalid_state, "capture " + id + " is over"};
  if (capture_ && capture_->id == id) {
    if (capture_->committing) return over;
    capture_->stop.request_stop();
    return {};
  }
  if (parts_.jobs.find(id) || std::find(over_.begin(), over_.end(), id) != over_.end()) return over;
  return Error{ErrorCode::not_found, "there is no capture " + id};
}

void CaptureSession::abandon(const std::string& id) {
  const std::lock_guard lock(mutex_);
  over_.erase(std::remove(over_.begin(), over_.end(), id), over_.end());
  if (!capture_ || capture_->id != id) return;
  capture_->abandoned = true;
  capture_->stop.request_stop();
}

void CaptureSession::wait_over(const std::string& id) {
  std::unique_lock lock(mutex_);
  changed_.wait(lock, [&] { return !capture_ || capture_->id != id; });
}

void CaptureSession::drain(std::chrono::milliseconds patience) {
  std::unique_lock lock(mutex_);
  draining_ = true;
  if (capture_ && capture_->counting_down) capture_->stop.request_stop();
  if (changed_.wait_for(lock, patience, [this] { return !capture_; })) return;
  capture_->stop.request_stop();
  changed_.wait(lock, [this] { return !capture_; });
}

bool CaptureSession::begin_commit(const std::string& id) {
  const std::lock_guard lock(mutex_);
  if (!capture_ || capture_->id != id || capture_->stop.stop_requested()) return false;
  return capture_->committing = true;
}

void CaptureSession::run(const std::stop_token& stop) {
  auto tended = std::chrono::steady_clock::now();
  while (!stop.stop_requested()) {
    pulse_.beat();
    std::string id;
    CaptureRequest request;
    std::stop_token cancelled;
    {
      std::unique_lock lock(mutex_);
      if (changed_.wait_for(lock, stop, device_pause, [this] { return pending_; })) {
        pending_ = false;
        id = capture_->id;
        request = capture_->request;
        cancelled = capture_->stop.get_token();
      }
    }
    try {
      if (!id.empty()) {
        carry_out(id, request, cancelled);
      } else if (std::chrono::steady_clock::now() - tended >= device_pause) {
        tend_devices();
        tended = std::chrono::steady_clock::now();
      }
    } catch (const std::exception& fault) {
      spdlog::error("the capture thread: {}", fault.what());
    }
  }
}

void CaptureSession::tend_devices() {
  // What opening returns is in the slots' status.
  static_cast<void>(trigger_.get());
  if (projector_) static_cast<void>(projector_->get());
}

void CaptureSession::carry_out(const std::string& id, const CaptureRequest& request, const std::stop_token& cancelled) {
  spdlog::info("capture {}: started", id);
  const Timestamp started = parts_.clock.now();
  Result<void> taken;
  try {
    taken = take(id, request, cancelled);
  } catch (const std::exception& fault) {
    taken = Error{ErrorCode::internal, "the booth's program has a fault: " + std::string(fault.what())};
  }

  if (!conclude(id, request, taken.ok()) && taken) taken = Error{ErrorCode::cancelled, "the capture was deleted"};

  parts_.metrics.observe("capture_seconds", elapsed_s(started, parts_.clock.now()));
  if (!taken) {
    parts_.metrics.add("captures_failed");
    spdlog::warn("capture {}: failed: {}: {}", id, to_string(taken.error().code), taken.error().message);
    parts_.events.publish(CaptureFailed{id, taken.error()});
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
}

/// The capture is over. @return whether its recording stays, and its job is queued
bool CaptureSession::conclude(const std::string& id, const CaptureRequest& request, bool taken) {
  bool stays = taken;
  if (taken) {
    const std::lock_guard lock(mutex_);
    stays = !capture_->abandoned;
    // From here on whoever deletes it finds the job.
    if (stays) parts_.jobs.add({.id = id, .face = std::string(to_string(request.face)), .label = request.label});
  }
  if (taken && !stays) {
    // Deleted while it was written: whoever waits for its end finds nothing left.
    if (const auto removed = remove_folder(parts_.recordings, id); !removed)
      spdlog::error("capture {}: {}", id, removed.error().message);
  }
  const std::lock_guard transition(transition_mutex_);
  {
    const std::lock_guard lock(mutex_);
    if (!stays && !capture_->abandoned) over_.push_back(id);
    if (over_.size() > remembered_failures) over_.pop_front();
    capture_.reset();
  }
  changed_.notify_all();
  parts_.set_state(BoothState::idle);
  return stays;
}

Result<void> CaptureSession::take(const std::string& id, const CaptureRequest& request,
                                  const std::stop_token& cancelled) {
  if (const auto room = parts_.check_disk(); !room) return room;
  const auto background = parts_.backgrounds.current();
  if (background == nullptr) return Error{ErrorCode::no_background, "the booth has not learned its background yet"};
  auto writer = RecordingWriter::begin(parts_.recordings,
                                       {.id = id,
                                        .created = iso8601(std::chrono::system_clock::now()),
                                        .label = request.label,
                                        .face = std::string(to_string(request.face))},
                                       parts_.rig, parts_.config.images);
  if (!writer) return writer.error();
  if (const auto added = (*writer)->add_shot(*background, *background->find(ShotRole::background)); !added)
    return added.error().code == ErrorCode::disk_full
               ? added.error()
               : Error{ErrorCode::no_background,
                       "the learned background does not fit, learn it again: " + added.error().message};

  CollectedShot body;
  {
    const Timestamp zero = parts_.clock.now() + static_cast<Timestamp>(request.countdown_s * 1e9);
    double next_s = request.countdown_s > 0 ? request.countdown_s : -1;
    if (const auto counted = count_down(id, zero - arm_before_zero, zero, next_s, cancelled); !counted) return counted;
    FrameCollector collector(parts_.cameras, parts_.cameras.ids(), ShotRole::body, 1, parts_.clock);
    collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);
    if (const auto counted = count_down(id, zero, zero, next_s, cancelled); !counted) return counted;
    begin_capturing();
    auto taken = take_body(id, collector, cancelled);
    if (!taken) return taken.error();
    body = std::move(*taken);
  }
  std::vector<Frame> face;
  if (patterns_wanted(request.face)) {
    auto taken = take_face(id, cancelled);
    if (!taken) return taken.error();
    face = std::move(*taken);
  }

  // The subject may move again; the disk has time.
  if (const auto begun = (*writer)->begin_shot({.name = body_shot, .role = ShotRole::body}); !begun) return begun;
  if (const auto written = write(**writer, body_shot, body.set.frames, cancelled); !written) return written;
  if (!face.empty()) {
    const auto projector = projector_->get();
    if (!projector) return projector.error();
    if (const auto begun = (*writer)->begin_shot(
            {.name = face_shot, .role = ShotRole::gray_code, .pattern = (*projector)->info().pattern});
        !begun)
      return begun;
    if (const auto written = write(**writer, face_shot, face, cancelled); !written) return written;
  }
  if (!begin_commit(id)) return was_cancelled();
  pulse_.beat();
  return (*writer)->commit();
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
    capture_->counting_down = false;
  }
  parts_.set_state(BoothState::capturing);
}

Result<CollectedShot> CaptureSession::fire_and_collect(FrameCollector& collector, int number,
                                                       const std::stop_token& cancelled) {
  pulse_.beat();
  const auto trigger = trigger_.get();
  if (!trigger) return Error{ErrorCode::device_lost, "the trigger cannot be used: " + trigger.error().message};
  const auto fired = (*trigger)->fire();
  if (!fired) {
    trigger_.lose(fired.error());
    return Error{ErrorCode::device_lost, "the trigger did not fire: " + fired.error().message};
  }
  CollectedShot shot = collector.collect(number, *fired + milliseconds(parts_.config.frame_timeout_ms), cancelled);
  if (cancelled.stop_requested()) return was_cancelled();
  return shot;
}

Result<CollectedShot> CaptureSession::take_body(const std::string& id, FrameCollector& collector,
                                                const std::stop_token& cancelled) {
  auto shot = fire_and_collect(collector, 0, cancelled);
  if (!shot) return shot;
  parts_.events.publish(
      ShotTaken{id, ShotRole::body, 0, 1, static_cast<int>(shot->set.frames.size()), shot->missing, shot->skew_us});
  int delivered = 0;
  for (const std::string& camera : parts_.cameras.ids(CameraRole::body))
    delivered += std::find(shot->missing.begin(), shot->missing.end(), camera) == shot->missing.end() ? 1 : 0;
  if (delivered < parts_.config.min_cameras)
    return Error{ErrorCode::device_lost, "only " + std::to_string(delivered) + " body cameras delivered, at least " +
                                             std::to_string(parts_.config.min_cameras) +
                                             " are needed; missing: " + join(shot->missing)};
  return shot;
}

bool CaptureSession::patterns_wanted(FaceMode mode) {
  if (mode == FaceMode::active) return true;
  if (mode != FaceMode::automatic || !projector_) return false;
  const auto projector = projector_->get();
  if (!projector)
    parts_.events.publish(
        Alert{Severity::warning, "camera_unavailable",
              "the face is made without the projector, which cannot be used: " + projector.error().message});
  return projector.ok();
}

Result<std::vector<Frame>> CaptureSession::take_face(const std::string& id, const std::stop_token& cancelled) {
  const auto opened = projector_->get();
  if (!opened) return Error{ErrorCode::device_lost, "the projector cannot be used: " + opened.error().message};
  // Nobody is left in a flickering light, whichever way this ends.
  std::unique_ptr<Projector, void (*)(Projector*)> projector(*opened, [](Projector* lit) { lit->dark(); });

  const int patterns = pattern_count(projector->info().pattern);
  const std::vector<std::string> cameras = parts_.cameras.ids(CameraRole::face);
  FrameCollector collector(parts_.cameras, cameras, ShotRole::gray_code, patterns + most_repeats, parts_.clock);
  collector.wait_armed(parts_.clock.now() + arm_patience, cancelled);

  std::vector<Frame> frames;
  int triggers = 0, repeats = 0;
  for (int pattern = 0; pattern < patterns; ++pattern) {
    std::map<std::string, Frame> delivered;
    double skew_us = 0;
    for (;;) {
      if (cancelled.stop_requested()) return was_cancelled();
      if (collector.reachable() == 0)
        return Error{ErrorCode::device_lost, "no face camera takes the projected patterns: " + join(cameras)};
      if (const auto shown = projector->show(pattern); !shown) {
        projector.reset();
        projector_->lose(shown.error());
        return Error{ErrorCode::device_lost, "the projector failed: " + shown.error().message};
      }
      auto shot = fire_and_collect(collector, triggers++, cancelled);
      if (!shot) return shot.error();
      skew_us = shot->skew_us;
      for (Frame& frame : shot->set.frames) {
        frame.index = pattern;
        delivered.try_emplace(frame.camera, std::move(frame));
      }
      if (delivered.size() >= collector.reachable() || repeats == most_repeats) break;
      ++repeats;
    }
    std::vector<std::string> missing;
    for (const std::string& camera : cameras)
      if (!delivered.contains(camera)) missing.push_back(camera);
    parts_.events.publish(
        ShotTaken{id, ShotRole::gray_code, pattern, patterns, static_cast<int>(delivered.size()), missing, skew_us});
    for (auto& [camera, frame] : delivered) frames.push_back(std::move(frame));
  }
  return frames;
}

Result<void> CaptureSession::write(RecordingWriter& writer, const std::string& shot, const std::vector<Frame>& frames,
                                   const std::stop_token& cancelled) {
  std::mutex mutex;
  Result<void> outcome;
  encoders_.run(frames.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !cancelled.stop_requested(); ++i) {
      const auto added = writer.add(shot, frames[i]);
      const std::lock_guard lock(mutex);
      if (!added && outcome) outcome = added;
    }
  });
  if (cancelled.stop_requested()) return was_cancelled();
  return outcome;
}

}  // namespace booth
