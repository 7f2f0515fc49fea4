#include "replay/replay_devices.h"

#include <algorithm>
#include <condition_variable>
#include <deque>
#include <map>
#include <mutex>
#include <set>
#include <thread>
#include <utility>

#include "pipeline/image/codec.h"
#include "replay/frame_cache.h"
#include "replay/recording_file.h"

namespace booth {
namespace {

constexpr const char* driver_name = "replay";
constexpr const char* trigger_name = "trigger";
constexpr const char* projector_name = "projector";

/// Between the end of an exposure and the frame's arrival: readout and transfer of a common industrial camera.
constexpr Timestamp transfer_ns = milliseconds(15);

/// Between two frames of a preview.
constexpr Timestamp preview_period_ns = milliseconds(50);

/// The clock cannot wake anybody: who waits for it looks again at least this often.
constexpr std::chrono::milliseconds longest_nap{10};

std::chrono::nanoseconds nap_until(Timestamp then, Timestamp now) {
  return std::min<std::chrono::nanoseconds>(std::chrono::nanoseconds(then - now), longest_nap);
}

/// A shot as the stage plays it: by index, then camera.
struct PlayedShot {
  std::vector<int> indices;  ///< ascending
  std::map<int, std::map<std::string, const FrameRecord*>> frames;
  std::map<int, Timestamp> begin;  ///< the earliest timestamp of each index

  explicit PlayedShot(const Shot& shot) {
    for (const FrameRecord& frame : shot.frames) {
      frames[frame.index][frame.camera] = &frame;
      const auto [first, added] = begin.emplace(frame.index, frame.timestamp_ns);
      if (!added) first->second = std::min(first->second, frame.timestamp_ns);
    }
    for (const auto& [index, set] : frames) indices.push_back(index);
  }

  const FrameRecord* find(int index, const std::string& camera) const {
    const auto set = frames.find(index);
    if (set == frames.end()) return nullptr;
    const auto frame = set->second.find(camera);
    return frame == set->second.end() ? nullptr : frame->second;
  }

  /// The usual time between two indices.
  Timestamp step() const {
    std::vector<Timestamp> steps;
    for (auto a = begin.begin(), b = a; a != begin.end() && ++b != begin.end(); a = b)
      steps.push_back(b->second - a->second);
    if (steps.empty()) return 0;
    const auto middle = steps.begin() + static_cast<ptrdiff_t>(steps.size() / 2);
    std::nth_element(steps.begin(), middle, steps.end());
    return std::clamp<Timestamp>(*middle, 0, seconds(1));
  }
};

/// A frame on its way from the trigger to whoever waits for it.
struct Arrival {
  Timestamp due = 0;
  Frame frame;  ///< without pixels
  const FrameRecord* record = nullptr;
  bool corrupt = false;
};

/// A device that can be unplugged.
struct Socket {
  bool open = false;  ///< somebody holds the device
  bool lost = false;  ///< whoever holds it has lost it
  bool plugged = true;
  Timestamp plugs_in = 0;  ///< when an unplugged device comes back by itself; 0: never
};

struct Channel : Socket {
  CameraInfo info;
  bool armed = false;
  ShotRole role = ShotRole::body;
  int count = 0;    ///< of triggers that it was armed for
  int fired = 0;    ///< of those
  int capture = 0;  ///< how often it had been armed for this role before
  std::map<ShotRole, int> arms;
  const FrameRecord* preview = nullptr;  ///< what it shows; null where it is armed for triggers
  Timestamp begun = 0, last = 0;         ///< of the preview: when it was armed, and its newest frame's time
  uint64_t frame_id = 0;
  std::deque<Arrival> arrivals;
  std::condition_variable arrived;
};

}  // namespace

/// What the devices of one source share. Everything below `mutex_` is guarded by it.
class ReplayStage {
 public:
  ReplayStage(Recording recording, ReplayOptions options, const Clock& clock)
      : recording_(std::move(recording)),
        options_(std::move(options)),
        clock_(clock),
        cache_(options_.cache_mib << 20) {
    for (const Shot& shot : recording_.shots) shots_.try_emplace(shot.role, shot);
    for (const RigCamera& camera : recording_.rig.cameras)
      channels_[camera.id].info = {camera.id, driver_name, camera.role, camera.intrinsics.width,
                                   camera.intrinsics.height};
  }

  const Recording& recording() const { return recording_; }

  std::vector<CameraInfo> plugged_cameras() {
    const std::lock_guard lock(mutex_);
    std::vector<CameraInfo> infos;
    for (const RigCamera& camera : recording_.rig.cameras)
      if (Channel& channel = channels_.at(camera.id); is_plugged(channel)) infos.push_back(channel.info);
    return infos;
  }

  Result<void> open_camera(const std::string& camera) {
    const auto found = channels_.find(camera);
    if (found == channels_.end()) return Error{ErrorCode::not_found, camera + ": the recording has no such camera"};
    return open(camera, found->second);
  }
  Result<void> open_trigger() { return open(trigger_name, trigger_); }
  Result<void> open_projector() { return open(projector_name, projector_); }

  void close_camera(const std::string& camera) {
    disarm(camera);
    close(channels_.at(camera));
  }
  void close_trigger() { close(trigger_); }
  void close_projector() {
    darken();
    close(projector_);
  }

  void unplug(const std::string& device) {
    const std::lock_guard lock(mutex_);
    if (const auto camera = channels_.find(device); camera != channels_.end()) return unplug(camera->second, 0);
    if (device == trigger_name) unplug(trigger_, 0);
    if (device == projector_name) unplug(projector_, 0);
  }

  void plug_in(const std::string& device) {
    const std::lock_guard lock(mutex_);
    if (const auto camera = channels_.find(device); camera != channels_.end()) {
      camera->second.plugged = true;
    } else if (device == trigger_name) {
      trigger_.plugged = true;
    } else if (device == projector_name) {
      projector_.plugged = true;
    }
  }

  const CameraInfo& info(const std::string& camera) const { return channels_.at(camera).info; }

  Result<void> check_presence(const std::string& camera) {
    const std::lock_guard lock(mutex_);
    if (channels_.at(camera).lost) return lost(camera);
    return {};
  }

  Result<void> arm(const std::string& camera, const CaptureSettings& settings, int count) {
    if (settings.mode == CaptureMode::preview) return arm_preview(camera, settings.role);
    if (const auto armed = arm_triggered(camera, settings.role, count); !armed) return armed;
    // As a real camera's sensor, a played one should have its picture ready when it is asked for it.
    if (settings.role == ShotRole::body || settings.role == ShotRole::background) preload(camera, settings.role);
    return {};
  }

  Result<void> arm_preview(const std::string& camera, ShotRole role) {
    const std::lock_guard lock(mutex_);
    Channel& channel = channels_.at(camera);
    if (channel.lost) return lost(camera);
    channel.preview = first_picture(camera, role);
    for (auto shot = shots_.begin(); shot != shots_.end() && channel.preview == nullptr; ++shot)
      channel.preview = first_picture(camera, shot->first);
    if (channel.preview == nullptr)
      return Error{ErrorCode::unsupported, camera + ": the recording " + recording_.id + " has no picture of it"};
    channel.armed = true;
    channel.arrivals.clear();
    channel.begun = channel.last = clock_.now();
    return {};
  }

  Result<void> arm_triggered(const std::string& camera, ShotRole role, int count) {
    const std::lock_guard lock(mutex_);
    Channel& channel = channels_.at(camera);
    if (channel.lost) return lost(camera);
    if (count < 1) return Error{ErrorCode::invalid_argument, camera + ": cannot be armed for " + std::to_string(count)};
    if (!shots_.contains(role))
      return Error{ErrorCode::unsupported, camera + ": the recording " + recording_.id + " has no " +
                                               std::string(to_string(role)) + " shot to replay"};
    channel.armed = true;
    channel.preview = nullptr;
    channel.role = role;
    channel.count = count;
    channel.fired = 0;
    channel.capture = channel.arms[role]++;
    channel.arrivals.clear();
    return {};
  }

  void disarm(const std::string& camera) {
    const std::lock_guard lock(mutex_);
    Channel& channel = channels_.at(camera);
    channel.armed = false;
    channel.arrivals.clear();
    channel.arrived.notify_all();
  }

  Result<Frame> wait_frame(const std::string& camera, Timestamp deadline) {
    Arrival arrival;
    {
      std::unique_lock lock(mutex_);
      Channel& channel = channels_.at(camera);
      while (true) {
        if (channel.lost) return lost(camera);
        if (!channel.armed) return Error{ErrorCode::cancelled, camera + ": was stopped"};
        const Timestamp now = clock_.now();
        if (channel.preview != nullptr) look(channel, now);
        if (!channel.arrivals.empty() && channel.arrivals.front().due <= now) break;
        if (now >= deadline) return Error{ErrorCode::timeout, camera + ": delivered no frame in time"};
        const Timestamp due = channel.arrivals.empty() ? deadline : std::min(deadline, channel.arrivals.front().due);
        channel.arrived.wait_for(lock, nap_until(due, now));
      }
      arrival = std::move(channel.arrivals.front());
      channel.arrivals.pop_front();
    }
    return decode(std::move(arrival));
  }

  Result<Timestamp> fire() {
    const std::lock_guard lock(mutex_);
    if (trigger_.lost) return lost(trigger_name);
    const Timestamp now = clock_.now();
    bool board = false;
    for (auto& [id, channel] : channels_) {
      if (!channel.armed || channel.preview != nullptr || channel.lost || channel.fired == channel.count) continue;
      board |= channel.role == ShotRole::calibration_board;
      expose(channel, now);
    }
    if (board) ++board_pose_;
    return now;
  }

  Result<void> show(int pattern) {
    std::unique_lock lock(mutex_);
    if (projector_.lost) return lost(projector_name);
    if (pattern < 0 || pattern >= patterns())
      return Error{ErrorCode::invalid_argument, std::string(projector_name) + ": has no pattern " +
                                                    std::to_string(pattern) + ", only 0 to " +
                                                    std::to_string(patterns() - 1)};
    shown_ = pattern;
    if (options_.pace == ReplayOptions::Pace::fast) return {};
    const Timestamp lit = last_shown_ + shots_.at(ShotRole::gray_code).step();
    for (Timestamp now = clock_.now(); now < lit; now = clock_.now()) {
      lock.unlock();
      std::this_thread::sleep_for(nap_until(lit, now));
      lock.lock();
    }
    last_shown_ = clock_.now();
    return {};
  }

  void darken() {
    const std::lock_guard lock(mutex_);
    shown_ = dark;
  }

 private:
  static constexpr int dark = -1;

  static Error lost(const std::string& device) { return {ErrorCode::device_lost, device + ": is not there any more"}; }

  int patterns() const { return pattern_count(*recording_.find(ShotRole::gray_code)->pattern); }

  Result<void> open(const std::string& device, Socket& socket) {
    const std::lock_guard lock(mutex_);
    if (!is_plugged(socket)) return lost(device);
    if (socket.open) return Error{ErrorCode::busy, device + ": is open already"};
    socket.open = true;
    socket.lost = false;
    return {};
  }

  void close(Socket& socket) {
    const std::lock_guard lock(mutex_);
    socket.open = false;
  }

  bool is_plugged(Socket& socket) {
    if (!socket.plugged && socket.plugs_in != 0 && clock_.now() >= socket.plugs_in) socket.plugged = true;
    return socket.plugged;
  }

  static void unplug(Socket& socket, Timestamp plugs_in) {
    socket.plugged = false;
    socket.lost = true;
    socket.plugs_in = plugs_in;
  }
  static void unplug(Channel& channel, Timestamp plugs_in) {
    unplug(static_cast<Socket&>(channel), plugs_in);
    channel.armed = false;
    channel.arrivals.clear();
    channel.arrived.notify_all();
  }

  /// The recorded frame that answers the trigger, or nullptr.
  const FrameRecord* answer(const Channel& channel, int trigger) const {
    const PlayedShot& shot = shots_.at(channel.role);
    if (shot.indices.empty()) return nullptr;
    const auto repeated = [&](int step) { return shot.indices[static_cast<size_t>(step) % shot.indices.size()]; };
    switch (channel.role) {
      case ShotRole::gray_code: return shot.find(shown_ == dark ? patterns() - 1 : shown_, channel.info.id);
      case ShotRole::calibration_board: return shot.find(repeated(board_pose_), channel.info.id);
      case ShotRole::background:
      case ShotRole::body: break;
    }
    return shot.find(repeated(trigger), channel.info.id);
  }

  /// One camera sees the trigger.
  void expose(Channel& channel, Timestamp now) {
    const int trigger = channel.fired++;
    const uint64_t frame_id = ++channel.frame_id;
    Arrival arrival;
    arrival.record = answer(channel, trigger);
    Timestamp delay = 0;
    for (const ReplayFault& fault : options_.faults) {
      const bool meant = (fault.camera.empty() || fault.camera == channel.info.id) &&
                         fault.role.value_or(channel.role) == channel.role &&
                         fault.index.value_or(trigger) == trigger &&
                         fault.capture.value_or(channel.capture) == channel.capture;
      if (!meant) continue;
      switch (fault.kind) {
        case ReplayFault::Kind::missing: arrival.record = nullptr; break;
        case ReplayFault::Kind::late: delay += milliseconds(fault.delay_ms); break;
        case ReplayFault::Kind::corrupt: arrival.corrupt = true; break;
        case ReplayFault::Kind::lost:
          return unplug(channel, fault.delay_ms == 0 ? 0 : now + milliseconds(fault.delay_ms));
      }
    }
    if (arrival.record == nullptr) return;
    const FrameRecord& record = *arrival.record;
    const Timestamp offset = record.timestamp_ns - shots_.at(channel.role).begin.at(record.index);
    arrival.frame = {.camera = channel.info.id,
                     .index = trigger,
                     .timestamp_ns = now + offset,
                     .frame_id = frame_id,
                     .exposure_us = record.exposure_us,
                     .gain_db = record.gain_db,
                     .pixels = nullptr,
                     .mosaic = record.mosaic};
    arrival.due = now + delay;
    if (options_.pace == ReplayOptions::Pace::real)
      arrival.due += offset + static_cast<Timestamp>(record.exposure_us * 1000) + transfer_ns;
    channel.arrivals.push_back(std::move(arrival));
    channel.arrived.notify_all();
  }

  /// Puts the preview's newest frame among the arrivals, when it is time for one.
  static void look(Channel& channel, Timestamp now) {
    const Timestamp step = (now - channel.begun) / preview_period_ns;
    const Timestamp taken = channel.begun + step * preview_period_ns;
    if (!channel.arrivals.empty() && channel.arrivals.front().due >= taken) return;
    channel.arrivals.clear();
    Arrival arrival;
    arrival.record = channel.preview;
    arrival.due = taken > channel.last ? taken : taken + preview_period_ns;
    const auto index = (arrival.due - channel.begun) / preview_period_ns;
    channel.last = arrival.due;
    arrival.frame = {.camera = channel.info.id,
                     .index = static_cast<int>(index - 1),
                     .timestamp_ns = arrival.due,
                     .frame_id = ++channel.frame_id,
                     .exposure_us = channel.preview->exposure_us,
                     .gain_db = channel.preview->gain_db,
                     .pixels = nullptr};
    channel.arrivals.push_back(std::move(arrival));
  }

  /// The camera's first frame in the shot of that role, or nullptr.
  const FrameRecord* first_picture(const std::string& camera, ShotRole role) const {
    const auto shot = shots_.find(role);
    if (shot == shots_.end()) return nullptr;
    for (const auto& [index, frames] : shot->second.frames)
      if (const auto frame = frames.find(camera); frame != frames.end()) return frame->second;
    return nullptr;
  }

  /// Decodes that picture, where there is one and it is not damaged.
  void preload(const std::string& camera, ShotRole role) {
    const FrameRecord* record = first_picture(camera, role);
    if (record == nullptr || cache_.find(record->file).pixels) return;
    if (auto loaded = load_frame(recording_, *record)) cache_.keep(record->file, *loaded);
  }

  Result<Frame> decode(Arrival arrival) {
    const FrameRecord& record = *arrival.record;
    const auto damaged = [&](const std::string& what) {
      return Error{ErrorCode::invalid_file,
                   record.camera + ": frame " + std::to_string(arrival.frame.index) + " arrived damaged: " + what};
    };
    Frame content = cache_.find(record.file);
    if (!content.pixels) {
      auto loaded = load_frame(recording_, record);
      if (!loaded) return damaged(loaded.error().message);
      content = *std::move(loaded);
      cache_.keep(record.file, content);
    }
    if (arrival.corrupt) {
      const std::span<const uint8_t> whole(*content.encoded);
      const auto decoded = decode_image(whole.first(whole.size() / 2));
      return damaged(decoded ? "it was cut off" : decoded.error().message);
    }
    arrival.frame.pixels = std::move(content.pixels);
    arrival.frame.encoded = std::move(content.encoded);
    return std::move(arrival.frame);
  }

  const Recording recording_;
  const ReplayOptions options_;
  const Clock& clock_;
  FrameCache cache_;
  std::map<ShotRole, PlayedShot> shots_;

  std::mutex mutex_;
  std::map<std::string, Channel> channels_;  ///< its keys and the cameras' infos never change
  Socket trigger_;
  Socket projector_;
  int shown_ = dark;
  int board_pose_ = 0;
  Timestamp last_shown_ = 0;
};

namespace {

class ReplayCamera final : public Camera {
 public:
  ReplayCamera(std::shared_ptr<ReplayStage> stage, const std::string& id) : stage_(std::move(stage)), id_(id) {}
  ~ReplayCamera() override { stage_->close_camera(id_); }
  const CameraInfo& info() const override { return stage_->info(id_); }
  Result<void> arm(const CaptureSettings& settings, int count) override { return stage_->arm(id_, settings, count); }
  Result<Frame> wait_frame(Timestamp deadline) override { return stage_->wait_frame(id_, deadline); }
  Result<void> check_presence() const override { return stage_->check_presence(id_); }
  void stop() noexcept override { stage_->disarm(id_); }

 private:
  std::shared_ptr<ReplayStage> stage_;
  std::string id_;
};

class ReplayTrigger final : public Trigger {
 public:
  explicit ReplayTrigger(std::shared_ptr<ReplayStage> stage) : stage_(std::move(stage)) {}
  ~ReplayTrigger() override { stage_->close_trigger(); }
  const std::string& driver() const override { return driver_; }
  Result<Timestamp> fire() override { return stage_->fire(); }

 private:
  std::shared_ptr<ReplayStage> stage_;
  std::string driver_ = driver_name;
};

class ReplayProjector final : public Projector {
 public:
  ReplayProjector(std::shared_ptr<ReplayStage> stage, ProjectorInfo info)
      : stage_(std::move(stage)), info_(std::move(info)) {}
  ~ReplayProjector() override { stage_->close_projector(); }
  const ProjectorInfo& info() const override { return info_; }
  Result<void> show(int index) override { return stage_->show(index); }
  void dark() noexcept override { stage_->darken(); }

 private:
  std::shared_ptr<ReplayStage> stage_;
  ProjectorInfo info_;
};

}  // namespace

ReplaySource::ReplaySource(std::shared_ptr<ReplayStage> stage) : stage_(std::move(stage)) {}
ReplaySource::~ReplaySource() = default;

Result<std::shared_ptr<ReplaySource>> ReplaySource::open(const ReplayOptions& options, const Clock& clock) {
  auto recording = read_recording(options.recording);
  if (!recording) return Error{recording.error().code, "replay: " + recording.error().message};
  for (const ReplayFault& fault : options.faults)
    if (!fault.camera.empty() && recording->rig.find(fault.camera) == nullptr)
      return Error{ErrorCode::invalid_argument,
                   "replay: a fault is meant for the camera " + fault.camera + ", which the recording does not have"};
  return std::shared_ptr<ReplaySource>(
      new ReplaySource(std::make_shared<ReplayStage>(*std::move(recording), options, clock)));
}

Result<std::vector<CameraInfo>> ReplaySource::discover() { return stage_->plugged_cameras(); }

Result<std::unique_ptr<Camera>> ReplaySource::open_camera(const std::string& id) {
  if (const auto opened = stage_->open_camera(id); !opened) return opened.error();
  return std::unique_ptr<Camera>(std::make_unique<ReplayCamera>(stage_, id));
}

Result<std::unique_ptr<Trigger>> ReplaySource::open_trigger() {
  if (const auto opened = stage_->open_trigger(); !opened) return opened.error();
  return std::unique_ptr<Trigger>(std::make_unique<ReplayTrigger>(stage_));
}

Result<std::unique_ptr<Projector>> ReplaySource::open_projector() {
  const auto& projector = recording().rig.projector;
  const Shot* patterns = recording().find(ShotRole::gray_code);
  if (!projector || patterns == nullptr)
    return Error{ErrorCode::unsupported, "the recording " + recording().id + " was made without a projector"};
  if (const auto opened = stage_->open_projector(); !opened) return opened.error();
  return std::unique_ptr<Projector>(
      std::make_unique<ReplayProjector>(stage_, ProjectorInfo{projector->id, driver_name, *patterns->pattern}));
}

const Rig* ReplaySource::rig() const { return &recording().rig; }

const Recording& ReplaySource::recording() const { return stage_->recording(); }

void ReplaySource::unplug(const std::string& device) { stage_->unplug(device); }
void ReplaySource::plug_in(const std::string& device) { stage_->plug_in(device); }

}  // namespace booth
