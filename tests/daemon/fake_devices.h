#pragma once

#include <atomic>
#include <condition_variable>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "drivers/clock.h"
#include "drivers/device_source.h"
#include "drivers/display/display_projector.h"

namespace booth::test {

/// A clock that a test turns.
class HandClock final : public Clock {
 public:
  Timestamp now() const override { return now_; }
  void advance(Timestamp by) { now_ += by; }

 private:
  std::atomic<Timestamp> now_{seconds(1000)};
};

/// How a fake camera answers one trigger.
struct FakeAnswer {
  enum class Kind { frame, nothing, corrupt, lost };
  Kind kind = Kind::frame;
  Timestamp delay = 0;           ///< until the frame arrives
  Timestamp offset = 0;          ///< of its timestamp from the trigger
  int index_off = 0;             ///< added to the index that it should have
  std::optional<int> grey = {};  ///< of its pixels; else the shown pattern's number, or 100
};

/// Cameras, a trigger and a projector that do what a test tells them to.
class FakeDevices final : public DeviceSource, public std::enable_shared_from_this<FakeDevices> {
 public:
  static constexpr int width = 16, height = 8;

  struct Channel {
    CameraInfo info;
    bool plugged = true;
    bool open = false, lost = false, armed = false;
    CaptureSettings settings;
    int count = 0, fired = 0;
    int opened = 0;                                ///< how often
    std::vector<std::pair<int, Timestamp>> noted;  ///< triggers that it was told of since it was armed
    std::optional<Error> refusal;                  ///< of open_camera
    int width = FakeDevices::width;                ///< of what it delivers
    bool blind = false;                            ///< shows no preview
    std::vector<std::string> warnings;
    std::deque<std::pair<Timestamp, Result<Frame>>> arrivals;
    int previewed = 0;
    std::function<void(Image&)> paint;  ///< what its triggered frames show
  };
  using Script = std::function<FakeAnswer(const std::string& camera, ShotRole role, int trigger)>;

  FakeDevices(const std::vector<std::string>& ids, const Clock& clock) : clock_(clock) {
    for (const std::string& id : ids) {
      const CameraRole role = id[0] == 'f' ? CameraRole::face : CameraRole::body;
      channels_[id].info = {.id = id,
                            .driver = "fake",
                            .role = role,
                            .width = width,
                            .height = height,
                            .model = "Fake 1",
                            .serial = "S-" + id,
                            .address = "10.0.0.1"};
    }
  }

  /// The answers from now on; `trigger` counts since the camera was armed.
  void play(Script script) {
    const std::lock_guard lock(mutex_);
    script_ = std::move(script);
  }
  void change(const std::string& camera, const std::function<void(Channel&)>& change) {
    const std::lock_guard lock(mutex_);
    change(channels_.at(camera));
    arrived_.notify_all();
  }
  /// Paints the frames that the camera takes from now on.
  void set_pixels(const std::string& camera, std::function<void(Image&)> paint) {
    change(camera, [&](Channel& channel) { channel.paint = std::move(paint); });
  }
  void unplug(const std::string& camera) {
    change(camera, [](Channel& channel) { channel.plugged = false, channel.lost = true; });
  }
  void plug_in(const std::string& camera) {
    change(camera, [](Channel& channel) { channel.plugged = true; });
  }
  Channel see(const std::string& camera) {
    const std::lock_guard lock(mutex_);
    return channels_.at(camera);
  }
  /// Every pattern that was shown, in its order; −1: dark.
  std::vector<int> shown() {
    const std::lock_guard lock(mutex_);
    return shown_;
  }
  int triggers() {
    const std::lock_guard lock(mutex_);
    return triggers_;
  }
  /// The projector fails from that pattern on.
  void break_projector_at(int pattern) {
    const std::lock_guard lock(mutex_);
    broken_at_ = pattern;
  }
  /// Patterns that are flipped reach the subject that much later: white makes pictures bright, all others dark.
  void set_latency(Timestamp latency) {
    const std::lock_guard lock(mutex_);
    latency_ = latency;
  }
  void break_trigger(std::optional<Error> error) {
    const std::lock_guard lock(mutex_);
    trigger_error_ = std::move(error);
  }

  Result<std::vector<CameraInfo>> discover() override {
    const std::lock_guard lock(mutex_);
    std::vector<CameraInfo> found;
    for (const auto& [id, channel] : channels_)
      if (channel.plugged) found.push_back(channel.info);
    found.push_back({.id = "stranger", .driver = "fake", .serial = "S-0"});
    return found;
  }
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override;
  Result<std::unique_ptr<Trigger>> open_trigger() override;
  Result<std::unique_ptr<Projector>> open_projector() override;

 private:
  friend class FakeCamera;
  friend class FakeTrigger;
  friend class FakeProjector;

  Frame frame(const Channel& channel, int index, Timestamp when, int grey) const {
    Image image(channel.width, height, 1, static_cast<uint8_t>(grey));
    if (channel.paint && channel.settings.mode == CaptureMode::triggered) channel.paint(image);
    return {.camera = channel.info.id,
            .index = index,
            .timestamp_ns = when,
            .frame_id = static_cast<uint64_t>(index) + 1,
            .exposure_us = 4000,
            .pixels = std::make_shared<const Image>(std::move(image))};
  }
  Result<Timestamp> fire() {
    const std::lock_guard lock(mutex_);
    if (trigger_error_) return *trigger_error_;
    ++triggers_;
    const Timestamp now = clock_.now();
    for (auto& [id, channel] : channels_) {
      if (!channel.armed || channel.settings.mode == CaptureMode::preview || channel.fired == channel.count) continue;
      const int trigger = channel.fired++;
      const FakeAnswer answer = script_ ? script_(id, channel.settings.role, trigger) : FakeAnswer{};
      if (answer.kind == FakeAnswer::Kind::nothing) continue;
      if (answer.kind == FakeAnswer::Kind::lost) {
        channel.lost = true;
        channel.plugged = false;
        continue;
      }
      const int pattern = latency_                              ? light_at(now - *latency_)
                          : shown_.empty() || shown_.back() < 0 ? 100
                                                                : shown_.back();
      Result<Frame> made =
          frame(channel, trigger + answer.index_off, now + answer.offset, answer.grey.value_or(pattern));
      if (answer.kind == FakeAnswer::Kind::corrupt) made = Error{ErrorCode::invalid_file, id + ": packets are missing"};
      channel.arrivals.emplace_back(now + answer.delay, std::move(made));
    }
    arrived_.notify_all();
    return now;
  }

  /// What a camera sees of the pattern that was flipped to by then.
  int light_at(Timestamp when) const {
    constexpr int white = 6, bright = 200, dim = 10;
    int pattern = -1;
    for (const auto& [flipped, index] : flips_)
      if (flipped <= when) pattern = index;
    return pattern == white ? bright : dim;
  }

  const Clock& clock_;
  std::mutex mutex_;
  std::vector<std::pair<Timestamp, int>> flips_;
  std::optional<Timestamp> latency_;
  std::condition_variable arrived_;
  std::map<std::string, Channel> channels_;
  Script script_;
  std::vector<int> shown_;
  int triggers_ = 0;
  int broken_at_ = 1'000'000;
  std::optional<Error> trigger_error_;
};

class FakeCamera final : public Camera {
 public:
  FakeCamera(std::shared_ptr<FakeDevices> devices, FakeDevices::Channel& channel)
      : devices_(std::move(devices)), channel_(channel), info_(channel.info) {}
  ~FakeCamera() override {
    const std::lock_guard lock(devices_->mutex_);
    channel_.open = channel_.armed = false;
  }
  const CameraInfo& info() const override { return info_; }
  Result<void> arm(const CaptureSettings& settings, int count) override {
    const std::lock_guard lock(devices_->mutex_);
    if (channel_.lost) return gone();
    channel_.armed = true;
    channel_.settings = settings;
    channel_.count = count;
    channel_.fired = 0;
    channel_.noted.clear();
    channel_.arrivals.clear();
    return {};
  }
  Result<Frame> wait_frame(Timestamp deadline) override {
    std::unique_lock lock(devices_->mutex_);
    for (;;) {
      if (channel_.lost) return gone();
      if (!channel_.armed) return Error{ErrorCode::cancelled, info_.id + ": was stopped"};
      const Timestamp now = devices_->clock_.now();
      if (!channel_.arrivals.empty() && channel_.arrivals.front().first <= now) {
        Result<Frame> frame = std::move(channel_.arrivals.front().second);
        channel_.arrivals.pop_front();
        return frame;
      }
      constexpr std::chrono::milliseconds pause{5};
      if (channel_.settings.mode == CaptureMode::preview && !channel_.blind) {
        devices_->arrived_.wait_for(lock, pause);
        if (channel_.lost || !channel_.armed) continue;
        return devices_->frame(channel_, channel_.previewed++, devices_->clock_.now(), 100);
      }
      if (now >= deadline) return Error{ErrorCode::timeout, info_.id + ": delivered no frame in time"};
      devices_->arrived_.wait_for(lock, std::chrono::milliseconds(1));
    }
  }
  void note_trigger(int index, Timestamp when) noexcept override {
    const std::lock_guard lock(devices_->mutex_);
    channel_.noted.emplace_back(index, when);
  }
  Result<void> check_presence() const override {
    const std::lock_guard lock(devices_->mutex_);
    return channel_.lost ? Result<void>(gone()) : Result<void>();
  }
  std::vector<Statistic> statistics() const override { return {{"n_missing_packets", 3}}; }
  std::vector<std::string> warnings() const override {
    const std::lock_guard lock(devices_->mutex_);
    return channel_.warnings;
  }
  void stop() noexcept override {
    const std::lock_guard lock(devices_->mutex_);
    channel_.armed = false;
    devices_->arrived_.notify_all();
  }

 private:
  Error gone() const { return {ErrorCode::device_lost, info_.id + ": its cable was pulled"}; }

  const std::shared_ptr<FakeDevices> devices_;
  FakeDevices::Channel& channel_;
  const CameraInfo info_;
};

class FakeTrigger final : public Trigger {
 public:
  explicit FakeTrigger(std::shared_ptr<FakeDevices> devices) : devices_(std::move(devices)) {}
  const std::string& driver() const override { return name_; }
  Result<Timestamp> fire() override { return devices_->fire(); }

 private:
  const std::shared_ptr<FakeDevices> devices_;
  const std::string name_ = "fake";
};

class FakeProjector final : public FlippingProjector {
 public:
  explicit FakeProjector(std::shared_ptr<FakeDevices> devices) : devices_(std::move(devices)) {}
  ~FakeProjector() override { dark(); }
  const ProjectorInfo& info() const override { return info_; }
  Result<void> show(int index) override {
    const std::lock_guard lock(devices_->mutex_);
    if (index >= devices_->broken_at_) return Error{ErrorCode::device_lost, "its lamp is broken"};
    devices_->shown_.push_back(index);
    return {};
  }
  Result<Timestamp> flip(int index) override {
    if (const auto shown = show(index); !shown) return shown.error();
    const std::lock_guard lock(devices_->mutex_);
    const Timestamp now = devices_->clock_.now();
    devices_->flips_.emplace_back(now, index);
    return now;
  }
  Timestamp refresh_ns() const override { return milliseconds(16); }
  void dark() noexcept override {
    const std::lock_guard lock(devices_->mutex_);
    devices_->shown_.push_back(-1);
  }

 private:
  const std::shared_ptr<FakeDevices> devices_;
  const ProjectorInfo info_{
      "beamer", "fake", {.width = 4, .height = 2, .columns = true, .rows = true, .inverse = true}};
};

inline Result<std::unique_ptr<Camera>> FakeDevices::open_camera(const std::string& id) {
  const std::lock_guard lock(mutex_);
  const auto found = channels_.find(id);
  if (found == channels_.end()) return Error{ErrorCode::not_found, "there is no camera " + id};
  Channel& channel = found->second;
  if (channel.refusal) return *channel.refusal;
  if (!channel.plugged) return Error{ErrorCode::device_lost, id + ": is not there"};
  if (channel.open) return Error{ErrorCode::busy, id + ": is open already"};
  channel.open = true;
  channel.lost = false;
  ++channel.opened;
  return std::unique_ptr<Camera>(std::make_unique<FakeCamera>(shared_from_this(), channel));
}

inline Result<std::unique_ptr<Trigger>> FakeDevices::open_trigger() {
  const std::lock_guard lock(mutex_);
  if (trigger_error_) return *trigger_error_;
  return std::unique_ptr<Trigger>(std::make_unique<FakeTrigger>(shared_from_this()));
}

inline Result<std::unique_ptr<Projector>> FakeDevices::open_projector() {
  return std::unique_ptr<Projector>(std::make_unique<FakeProjector>(shared_from_this()));
}

}  // namespace booth::test
