#include "daemon/camera_supervisor.h"

#include <pthread.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <exception>
#include <stdexcept>
#include <utility>

namespace booth {
namespace {

constexpr std::chrono::milliseconds first_patience{250};  ///< before a lost camera is opened again
constexpr std::chrono::milliseconds most_patience{5000};
constexpr Timestamp frame_slice = milliseconds(100);  ///< how long one wait for a frame lasts

double age_s(Timestamp then, Timestamp now) { return static_cast<double>(now - then) / 1e9; }

}  // namespace

SupervisedCamera::SupervisedCamera(CameraInfo info, std::shared_ptr<DeviceSource> source, const Clock& clock,
                                   std::function<void(const CameraStatus&)> changed)
    : info_(std::move(info)), source_(std::move(source)), clock_(clock), changed_(std::move(changed)) {
  status_ = {.id = info_.id, .driver = info_.driver, .role = info_.role, .message = "not opened yet"};
  thread_ = std::jthread([this](const std::stop_token& stop) { run(stop); });
  pthread_setname_np(thread_.native_handle(), "camera");
}

SupervisedCamera::~SupervisedCamera() {
  thread_.request_stop();
  disarm();
  thread_.join();
}

CameraStatus SupervisedCamera::status() const {
  const std::lock_guard lock(mutex_);
  CameraStatus status = status_;
  if (last_frame_) status.last_frame_age_s = age_s(*last_frame_, clock_.now());
  return status;
}

void SupervisedCamera::arm(const CaptureSettings& settings, int count, std::shared_ptr<CameraInbox> inbox) {
  {
    const std::lock_guard lock(mutex_);
    order_ = Order{settings, count, std::move(inbox)};
    ++order_number_;
  }
  wake_.notify_all();
}

void SupervisedCamera::disarm() noexcept {
  const std::lock_guard lock(mutex_);
  order_.reset();
  ++order_number_;
  if (device_) device_->stop();
}

bool SupervisedCamera::is_current(uint64_t number) const {
  const std::lock_guard lock(mutex_);
  return order_number_ == number;
}

void SupervisedCamera::note_missing(const std::string& message) {
  {
    const std::lock_guard lock(mutex_);
    ++status_.dropped;
    if (status_.state == DeviceState::offline) return;
  }
  set_state(DeviceState::degraded, message);
}

void SupervisedCamera::set_state(DeviceState state, const std::string& message) {
  {
    const std::lock_guard lock(mutex_);
    if (status_.state == state && status_.message == message) return;
    status_.state = state;
    status_.message = message;
  }
  if (state == DeviceState::online)
    spdlog::info("camera {}: online", info_.id);
  else
    spdlog::warn("camera {}: {}: {}", info_.id, to_string(state), message);
  changed_(status());
}

void SupervisedCamera::run(const std::stop_token& stop) {
  constexpr std::chrono::milliseconds idle{1000};
  std::chrono::milliseconds patience = first_patience;
  while (!stop.stop_requested()) {
    try {
      const bool opened = device_ != nullptr || open();
      std::optional<Order> order;
      uint64_t number = 0;
      {
        std::unique_lock lock(mutex_);
        wake_.wait_for(lock, stop, opened ? idle : patience, [this] { return order_.has_value(); });
        order = std::exchange(order_, std::nullopt);
        number = order_number_;
      }
      patience = opened ? first_patience : std::min(2 * patience, most_patience);
      if (!order || stop.stop_requested()) continue;
      // Somebody wants a picture now: that is worth another try at once.
      if (device_ != nullptr || open())
        serve(*order, number, stop);
      else
        order->inbox->try_push({CameraNews::Kind::fault, info_.id, {}, {ErrorCode::device_lost, status().message}});
    } catch (const std::exception& fault) {
      lose({ErrorCode::internal, "the driver has a fault: " + std::string(fault.what())});
    }
  }
}

bool SupervisedCamera::open() {
  auto opened = source_->open_camera(info_.id);
  if (!opened) {
    set_state(DeviceState::offline, opened.error().message);
    return false;
  }
  {
    const std::lock_guard lock(mutex_);
    device_ = std::move(*opened);
  }
  set_state(DeviceState::online, "");
  return true;
}

void SupervisedCamera::lose(const Error& error) {
  std::unique_ptr<Camera> lost;
  {
    const std::lock_guard lock(mutex_);
    lost = std::move(device_);
  }
  lost.reset();  // may take its time, so not under the lock
  set_state(DeviceState::offline, error.message);
}

void SupervisedCamera::serve(const Order& order, uint64_t number, const std::stop_token& stop) {
  const auto tell = [&](CameraNews::Kind kind, std::optional<Frame> frame, const Error& error) {
    if (!order.inbox->try_push({kind, info_.id, std::move(frame), error}))
      spdlog::warn("camera {}: nobody takes its frames", info_.id);
  };
  if (const auto armed = device_->arm(order.settings, order.count); !armed) {
    if (armed.error().code == ErrorCode::device_lost)
      lose(armed.error());
    else
      set_state(DeviceState::degraded, armed.error().message);
    return tell(CameraNews::Kind::fault, {}, armed.error());
  }
  tell(CameraNews::Kind::armed, {}, {});
  while (!stop.stop_requested() && is_current(number)) {
    auto frame = device_->wait_frame(clock_.now() + frame_slice);
    if (frame) {
      {
        const std::lock_guard lock(mutex_);
        ++status_.frames;
        last_frame_ = clock_.now();
      }
      set_state(DeviceState::online, "");
      tell(CameraNews::Kind::frame, std::move(*frame), {});
      continue;
    }
    const Error& error = frame.error();
    if (error.code == ErrorCode::timeout) continue;
    if (error.code == ErrorCode::cancelled) break;
    if (error.code == ErrorCode::invalid_file) {
      note_missing(error.message);
      tell(CameraNews::Kind::fault, {}, error);
      continue;
    }
    lose(error);
    return tell(CameraNews::Kind::fault, {}, {ErrorCode::device_lost, error.message});
  }
  device_->stop();
}

CameraSupervisor::CameraSupervisor(const std::vector<CameraInfo>& cameras, const std::shared_ptr<DeviceSource>& source,
                                   const Clock& clock, const std::function<void(const CameraStatus&)>& changed) {
  for (const CameraInfo& info : cameras)
    cameras_.push_back(std::make_unique<SupervisedCamera>(info, source, clock, changed));
}

std::vector<CameraStatus> CameraSupervisor::status() const {
  std::vector<CameraStatus> all;
  for (const auto& camera : cameras_) all.push_back(camera->status());
  return all;
}

std::vector<std::string> CameraSupervisor::ids() const {
  std::vector<std::string> found;
  for (const auto& camera : cameras_) found.push_back(camera->id());
  return found;
}

std::vector<std::string> CameraSupervisor::ids(CameraRole role) const {
  std::vector<std::string> found;
  for (const auto& camera : cameras_)
    if (camera->status().role == role) found.push_back(camera->id());
  return found;
}

SupervisedCamera& CameraSupervisor::camera(const std::string& id) {
  const auto found =
      std::find_if(cameras_.begin(), cameras_.end(), [&](const auto& camera) { return camera->id() == id; });
  if (found == cameras_.end()) throw std::logic_error("no camera " + id);
  return **found;
}

}  // namespace booth
