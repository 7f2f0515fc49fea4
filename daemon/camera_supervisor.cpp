#include "daemon/camera_supervisor.h"

#include <pthread.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <exception>
#include <stdexcept>
#include <utility>

#include "daemon/device_slot.h"

namespace booth {
namespace {

using SteadyClock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds first_patience{250};  ///< before a lost camera is opened again
constexpr std::chrono::milliseconds most_patience{5000};
constexpr std::chrono::milliseconds permanent_patience{
    30'000};                                          ///< somebody may have changed the camera's own settings
constexpr std::chrono::milliseconds idle_pause{500};  ///< between two looks whether it is still there
constexpr Timestamp frame_slice = milliseconds(100);  ///< how long one wait for a frame lasts
constexpr Timestamp test_patience = seconds(3);       ///< for the test frame

double age_s(Timestamp then, Timestamp now) { return static_cast<double>(now - then) / 1e9; }

std::string size_text(int width, int height) { return std::to_string(width) + " × " + std::to_string(height); }

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
    if (device_ && preview_) device_->stop();  // so that nobody waits for the preview's next frame
  }
  wake_.notify_all();
}

void SupervisedCamera::disarm() noexcept {
  const std::lock_guard lock(mutex_);
  order_.reset();
  ++order_number_;
  if (device_) device_->stop();
}

void SupervisedCamera::note_trigger(int index, Timestamp when) noexcept {
  const std::lock_guard lock(mutex_);
  if (device_) device_->note_trigger(index, when);
}

void SupervisedCamera::set_preview(PreviewSink sink) {
  {
    const std::lock_guard lock(mutex_);
    preview_ = std::move(sink);
    ++order_number_;
  }
  wake_.notify_all();
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

void SupervisedCamera::set_state(DeviceState state, const std::string& message, bool permanent) {
  {
    const std::lock_guard lock(mutex_);
    if (status_.state == state && status_.message == message) return;
    status_.state = state;
    status_.message = message;
    status_.permanent = permanent;
  }
  if (state == DeviceState::online)
    spdlog::info("camera {}: online", info_.id);
  else
    spdlog::warn("camera {}: {}: {}", info_.id, to_string(state), message);
  changed_(status());
}

void SupervisedCamera::run(const std::stop_token& stop) {
  while (!stop.stop_requested()) {
    try {
      tend(stop);
    } catch (const std::exception& fault) {
      lose({ErrorCode::internal, "the driver has a fault: " + std::string(fault.what())});
    }
  }
}

/// One round of the camera's thread: opens the camera where it is time to, carries out what is asked, or waits a while.
void SupervisedCamera::tend(const std::stop_token& stop) {
  if (device_ == nullptr && SteadyClock::now() >= next_try_ && !open(stop)) {
    const bool permanent = status().permanent;
    patience_ = permanent                ? permanent_patience
                : patience_.count() == 0 ? first_patience
                                         : std::min(2 * patience_, most_patience);
    next_try_ = SteadyClock::now() + patience_;
  }
  std::optional<Order> order;
  PreviewSink preview;
  uint64_t number = 0;
  {
    std::unique_lock lock(mutex_);
    const auto until = device_ ? SteadyClock::now() + idle_pause : next_try_;
    wake_.wait_until(lock, stop, until, [this] { return order_.has_value() || (device_ && preview_); });
    order = std::exchange(order_, std::nullopt);
    preview = preview_;
    number = order_number_;
  }
  if (stop.stop_requested()) return;
  if (order && device_ == nullptr) {
    order->inbox->try_push({CameraNews::Kind::fault, info_.id, {}, {ErrorCode::device_lost, status().message}});
  } else if (order) {
    serve(*order, number, stop);
  } else if (device_ && preview) {
    show(preview, number, stop);
  } else if (device_) {
    if (const auto present = device_->check_presence(); !present) lose(present.error());
  }
  read_statistics();
}

bool SupervisedCamera::open(const std::stop_token& stop) {
  auto opened = source_->open_camera(info_.id);
  if (!opened) {
    set_state(DeviceState::offline, opened.error().message, is_permanent(opened.error().code));
    return false;
  }
  {
    const std::lock_guard lock(mutex_);
    device_ = std::move(*opened);
  }
  if (const auto tested = take_test_frame(stop); !tested) {
    lose(tested.error());
    return false;
  }
  patience_ = std::chrono::milliseconds(0);
  set_state(DeviceState::online, "");
  return true;
}

/// A camera that opens may still be of no use: only one that shows a picture of the right size is online.
Result<void> SupervisedCamera::take_test_frame(const std::stop_token& stop) {
  const auto armed = device_->arm({.role = ShotRole::body, .mode = CaptureMode::preview}, 1);
  // A camera that cannot show pictures without a trigger is believed.
  if (!armed) return armed.error().code == ErrorCode::unsupported ? Result<void>{} : armed;
  const Timestamp deadline = clock_.now() + test_patience;
  std::string last_fault = "nothing came";
  while (!stop.stop_requested()) {
    const Timestamp now = clock_.now();
    if (now >= deadline) {
      device_->stop();
      return Error{ErrorCode::timeout, "it can be opened, but gave no test frame within " +
                                           std::to_string(test_patience / seconds(1)) + " s: " + last_fault};
    }
    const auto frame = device_->wait_frame(std::min(deadline, now + frame_slice));
    if (frame) {
      device_->stop();
      const int width = frame->pixels->width, height = frame->pixels->height;
      if (info_.width > 0 && (width != info_.width || height != info_.height))
        return Error{ErrorCode::invalid_argument,
                     "it delivers " + size_text(width, height) + " pixels, but was calibrated with " +
                         size_text(info_.width, info_.height) + ": set its region, or calibrate it again"};
      const std::lock_guard lock(mutex_);
      last_frame_ = clock_.now();
      return {};
    }
    const Error& error = frame.error();
    if (error.code == ErrorCode::timeout) continue;
    last_fault = error.message;
    if (error.code == ErrorCode::invalid_file) continue;
    // Somebody called disarm(), which stops the camera: the test goes on.
    if (error.code != ErrorCode::cancelled) return error;
    if (const auto again = device_->arm({.role = ShotRole::body, .mode = CaptureMode::preview}, 1); !again)
      return again;
  }
  return Error{ErrorCode::cancelled, "the booth is stopping"};
}

void SupervisedCamera::read_statistics() {
  if (device_ == nullptr) return;
  std::vector<Statistic> statistics = device_->statistics();
  std::vector<std::string> warnings = device_->warnings();
  const std::lock_guard lock(mutex_);
  status_.statistics = std::move(statistics);
  status_.warnings = std::move(warnings);
}

void SupervisedCamera::lose(const Error& error) {
  std::unique_ptr<Camera> lost;
  {
    const std::lock_guard lock(mutex_);
    lost = std::move(device_);
    status_.warnings.clear();
  }
  lost.reset();  // may take its time, so not under the lock
  set_state(DeviceState::offline, error.message, is_permanent(error.code));
}

void SupervisedCamera::show(const PreviewSink& sink, uint64_t number, const std::stop_token& stop) {
  if (const auto armed = device_->arm({.role = ShotRole::body, .mode = CaptureMode::preview}, 1); !armed) {
    if (armed.error().code == ErrorCode::device_lost) return lose(armed.error());
    spdlog::warn("camera {}: has no preview: {}", info_.id, armed.error().message);
    const std::lock_guard lock(mutex_);
    if (order_number_ == number) preview_ = nullptr;
    return;
  }
  while (!stop.stop_requested() && is_current(number)) {
    const auto frame = device_->wait_frame(clock_.now() + frame_slice);
    if (frame) {
      {
        const std::lock_guard lock(mutex_);
        last_frame_ = clock_.now();
      }
      sink(*frame);
      continue;
    }
    const ErrorCode code = frame.error().code;
    if (code == ErrorCode::cancelled) break;
    if (code != ErrorCode::timeout && code != ErrorCode::invalid_file) return lose(frame.error());
  }
  device_->stop();
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

bool CameraSupervisor::has(const std::string& id) const {
  return std::any_of(cameras_.begin(), cameras_.end(), [&](const auto& camera) { return camera->id() == id; });
}

SupervisedCamera& CameraSupervisor::camera(const std::string& id) {
  const auto found =
      std::find_if(cameras_.begin(), cameras_.end(), [&](const auto& camera) { return camera->id() == id; });
  if (found == cameras_.end()) throw std::logic_error("no camera " + id);
  return **found;
}

}  // namespace booth
