#include "drivers/v4l2/v4l2_camera.h"

#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <cstring>
#include <utility>

#include "drivers/v4l2/mjpeg.h"
#include "drivers/v4l2/yuyv.h"
#include "pipeline/image/codec.h"

namespace booth {
namespace {

/// A camera that is silent for this long, while its stream runs, hangs: opening it anew is what helps.
constexpr int longest_silence_ms = 5000;

/// A stream that nobody wants any more goes on for this long: it may be wanted again at once, as when a preview makes
/// way for a capture, and beginning anew costs the first frames.
constexpr std::chrono::milliseconds stream_linger{1000};

/// The clock cannot wake anybody: who waits for it looks again at least this often.
constexpr std::chrono::milliseconds longest_nap{100};

/// What is wrong with the bytes of a buffer; empty where nothing is. Shortens a JPEG to its end.
std::string damage_of(const FilledBuffer& buffer, const VideoMode& mode, std::span<const uint8_t>& bytes) {
  bytes = buffer.bytes;
  if (buffer.error) return "the driver marked it as damaged";
  if (mode.format == V4l2Format::mjpg) {
    const auto length = whole_jpeg(bytes);
    if (!length) return "it is no whole JPEG (" + std::to_string(bytes.size()) + " bytes)";
    bytes = bytes.first(*length);
    return {};
  }
  const size_t expected = size_t{mode.bytes_per_line} * static_cast<size_t>(mode.height);
  if (bytes.size() < expected)
    return "it was cut off: " + std::to_string(bytes.size()) + " of " + std::to_string(expected) + " bytes";
  return {};
}

/// What a raw format's samples are; nothing of formats that are pictures already.
std::optional<Mosaic> mosaic_of(V4l2Format format) {
  switch (format) {
    case V4l2Format::bayer_rggb: return Mosaic{BayerPattern::rggb};
    case V4l2Format::bayer_grbg: return Mosaic{BayerPattern::grbg};
    case V4l2Format::bayer_gbrg: return Mosaic{BayerPattern::gbrg};
    case V4l2Format::bayer_bggr: return Mosaic{BayerPattern::bggr};
    case V4l2Format::automatic:
    case V4l2Format::mjpg:
    case V4l2Format::yuyv:
    case V4l2Format::grey: break;
  }
  return std::nullopt;
}

Image single_channel(std::span<const uint8_t> bytes, const VideoMode& mode) {
  Image image(mode.width, mode.height, 1);
  for (int y = 0; y < mode.height; ++y)
    std::memcpy(image.pixel(0, y), bytes.data() + static_cast<size_t>(y) * mode.bytes_per_line,
                static_cast<size_t>(mode.width));
  return image;
}

}  // namespace

V4l2Camera::V4l2Camera(std::unique_ptr<VideoDevice> device, V4l2CameraSettings settings, CameraInfo info,
                       const Clock& clock, std::function<void()> on_close)
    : settings_(std::move(settings)),
      info_(std::move(info)),
      clock_(clock),
      on_close_(std::move(on_close)),
      device_(std::move(device)),
      wakeup_fd_(::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)) {
  if (wakeup_fd_ < 0) throw std::runtime_error(info_.id + ": no event descriptor: " + std::strerror(errno));
}

V4l2Camera::~V4l2Camera() {
  stop();
  end_stream();
  device_.reset();
  ::close(wakeup_fd_);
  on_close_();
}

/// Its first frames after a pulse are what was asked for.
int V4l2Camera::warm_up_frames() const { return is_triggered() ? 0 : settings_.warm_up_frames; }

void V4l2Camera::wake_stream() noexcept {
  const uint64_t one = 1;
  // It can only fail when the counter is full, and then the thread is awake already.
  [[maybe_unused]] const auto written = ::write(wakeup_fd_, &one, sizeof one);
}

Error V4l2Camera::lost() const { return *lost_; }

void V4l2Camera::lose(const Error& error) {
  const std::lock_guard lock(mutex_);
  if (!lost_) lost_ = Error{ErrorCode::device_lost, error.message};
  armed_ = false;
  changed_.notify_all();
}

Result<void> V4l2Camera::start_stream(const std::optional<int>& exposure_us) {
  end_stream();
  {
    const std::lock_guard lock(mutex_);
    stop_wanted_ = false;
    warm_up_left_ = warm_up_frames();
    last_sequence_.reset();
  }
  if (auto started = device_->start(settings_.buffers); !started) return started;
  // Many cameras forget their settings when a stream begins.
  if (auto applied = device_->apply_controls(settings_, exposure_us); !applied) {
    device_->stop();
    return applied;
  }
  {
    const std::lock_guard lock(mutex_);
    streaming_ = true;
  }
  thread_ = std::jthread([this] { stream(); });
  return {};
}

void V4l2Camera::end_stream() noexcept {
  if (!thread_.joinable()) return;
  {
    const std::lock_guard lock(mutex_);
    stop_wanted_ = true;
  }
  wake_stream();
  thread_.join();
}

Result<void> V4l2Camera::arm(const CaptureSettings& settings, int count) {
  if (settings.mode == CaptureMode::triggered && count < 1)
    return Error{ErrorCode::invalid_argument, info_.id + ": cannot be armed for " + std::to_string(count)};
  if (settings.mode == CaptureMode::preview && is_triggered())
    return Error{ErrorCode::unsupported, info_.id + ": has no preview: it exposes only when its line is pulsed"};
  if (const auto present = check_presence(); !present) return present.error();
  const bool gray_code = settings.role == ShotRole::gray_code;
  const std::optional<int> exposure_us =
      gray_code && settings_.gray_code_exposure_us ? settings_.gray_code_exposure_us : settings_.exposure_us;
  bool streaming = false;
  bool same_exposure = false;
  {
    const std::lock_guard lock(mutex_);
    armed_ = false;
    unwanted_since_.reset();
    newest_.reset();
    choice_.reset();
    streaming = streaming_ && !stop_wanted_;
    same_exposure = wanted_exposure_us_ == exposure_us;
    wanted_exposure_us_ = exposure_us;
  }
  Result<void> ready;
  if (!streaming) {
    ready = start_stream(exposure_us);
  } else if (!same_exposure) {
    ready = device_->apply_controls(settings_, exposure_us);
    const std::lock_guard lock(mutex_);
    warm_up_left_ = warm_up_frames();
  }
  if (ready.ok()) ready = warm_up();
  if (!ready) {
    if (ready.error().code == ErrorCode::device_lost) lose(ready.error());
    stop();
    return ready;
  }
  const auto in_force = exposure_us ? exposure_us : device_->exposure_us();
  const double fps = device_->mode().fps;
  const Timestamp period = fps > 0 ? std::llround(1e9 / fps) : 0;
  const std::lock_guard lock(mutex_);
  if (lost_) return lost();
  if (stop_wanted_) return Error{ErrorCode::cancelled, info_.id + ": was stopped"};
  exposure_us_ = in_force;
  preview_ = settings.mode == CaptureMode::preview;
  previewed_ = 0;
  if (!preview_)
    choice_.emplace(gray_code ? FrameChoice::Rule::first_after : FrameChoice::Rule::nearest, count,
                    milliseconds(settings_.max_offset_ms), period);
  armed_ = true;
  return {};
}

Result<void> V4l2Camera::warm_up() {
  std::unique_lock lock(mutex_);
  const auto waited = changed_.wait_for(lock, std::chrono::milliseconds(2 * longest_silence_ms),
                                        [&] { return lost_ || stop_wanted_ || warm_up_left_ == 0; });
  if (lost_) return lost();
  if (!waited) return Error{ErrorCode::device_lost, info_.id + ": its stream began, but it delivers no frames"};
  return {};
}

/// How long the stream's thread may wait for a frame, milliseconds, −1 for ever; nothing: the stream is to end.
std::optional<int> V4l2Camera::stream_patience() {
  const std::lock_guard lock(mutex_);
  // A camera that waits for a trigger of its own may be silent.
  const int patience = is_triggered() ? -1 : longest_silence_ms;
  if (stop_wanted_) return std::nullopt;
  if (!unwanted_since_) return patience;
  const auto left =
      std::chrono::ceil<std::chrono::milliseconds>(*unwanted_since_ + stream_linger - std::chrono::steady_clock::now());
  if (left.count() <= 0) {
    stop_wanted_ = true;
    return std::nullopt;
  }
  return static_cast<int>(left.count());
}

void V4l2Camera::stream() {
  pollfd polled[] = {{device_->descriptor(), POLLIN, 0}, {wakeup_fd_, POLLIN, 0}};
  while (const auto patience = stream_patience()) {
    const int ready = ::poll(polled, std::size(polled), *patience);
    if (ready < 0 && errno == EINTR) continue;
    if (ready < 0) {
      lose({ErrorCode::device_lost, info_.id + ": cannot be waited for: " + std::strerror(errno)});
      break;
    }
    if (ready == 0 && *patience < longest_silence_ms) continue;
    if (ready == 0) {
      lose({ErrorCode::device_lost,
            info_.id + ": has delivered no frame for " + std::to_string(longest_silence_ms / 1000) + " s"});
      break;
    }
    if (polled[1].revents != 0) {
      uint64_t woken = 0;
      [[maybe_unused]] const auto read = ::read(wakeup_fd_, &woken, sizeof woken);
    }
    if (polled[0].revents == 0) continue;
    if (const auto drained = drain(); !drained) {
      lose(drained.error());
      break;
    }
    // Nothing to fetch and nothing more to come: the device is gone, or its queue is broken.
    if ((polled[0].revents & POLLIN) == 0) {
      lose({ErrorCode::device_lost,
            info_.id + ((polled[0].revents & POLLHUP) != 0 ? ": was unplugged" : ": its stream broke off")});
      break;
    }
  }
  device_->stop();
  const std::lock_guard lock(mutex_);
  streaming_ = false;
}

bool V4l2Camera::takes_frames() const {
  const std::lock_guard lock(mutex_);
  return armed_ && warm_up_left_ == 0;
}

Result<void> V4l2Camera::drain() {
  while (true) {
    const auto filled = device_->dequeue();
    if (!filled) return filled.error();
    if (!*filled) return {};
    const FilledBuffer& buffer = **filled;
    std::span<const uint8_t> whole;
    std::string damage = damage_of(buffer, device_->mode(), whole);
    // The buffer goes back at once: held any longer, the device would run out of them and lose frames.
    std::vector<uint8_t> bytes;
    if (damage.empty() && takes_frames()) bytes.assign(whole.begin(), whole.end());
    if (auto enqueued = device_->enqueue(buffer); !enqueued) return enqueued;
    Timestamp begin = buffer.timestamp_ns - int64_t{settings_.latency_us} * 1000;
    if (buffer.stamped_at_end) {
      const std::lock_guard lock(mutex_);
      begin -= int64_t{exposure_us_.value_or(0)} * 1000;
    }
    take(buffer, begin, std::move(bytes), std::move(damage));
  }
}

void V4l2Camera::take(const FilledBuffer& buffer, Timestamp begin, std::vector<uint8_t> bytes, std::string damage) {
  const std::lock_guard lock(mutex_);
  ++counters_.frames;
  // Differences of unsigned counts are right across their wrap.
  if (last_sequence_ && buffer.sequence != *last_sequence_) counters_.lost += buffer.sequence - *last_sequence_ - 1;
  last_sequence_ = buffer.sequence;
  if (!damage.empty()) ++counters_.damaged;
  if (warm_up_left_ > 0) {
    if (--warm_up_left_ == 0) changed_.notify_all();
    return;
  }
  if (!armed_) return;
  StreamedFrame frame{begin, buffer.sequence, std::move(bytes), std::move(damage)};
  if (!preview_)
    choice_->add_frame(std::move(frame));
  else if (frame.damage.empty()) {
    newest_ = std::move(frame);
    ++previewed_;
  }
  changed_.notify_all();
}

void V4l2Camera::note_trigger(int index, Timestamp when) noexcept {
  const std::lock_guard lock(mutex_);
  if (!armed_ || !choice_) return;
  choice_->add_trigger(index, when);
  changed_.notify_all();
}

Result<Frame> V4l2Camera::wait_frame(Timestamp deadline) {
  std::unique_lock lock(mutex_);
  while (true) {
    if (lost_) return lost();
    if (!armed_) return Error{ErrorCode::cancelled, info_.id + ": was stopped"};
    if (preview_ && newest_) {
      StreamedFrame frame = *std::exchange(newest_, std::nullopt);
      const int index = previewed_ - 1;
      lock.unlock();
      return develop(std::move(frame), index);
    }
    if (!preview_)
      if (auto next = choice_->next()) return answer(*std::move(next), std::move(lock));
    const Timestamp now = clock_.now();
    if (now >= deadline) {
      if (!preview_)
        if (auto damaged = choice_->next_damaged()) return answer(*std::move(damaged), std::move(lock));
      return Error{ErrorCode::timeout, info_.id + ": delivered no frame in time"};
    }
    changed_.wait_for(lock, std::min<std::chrono::nanoseconds>(std::chrono::nanoseconds(deadline - now), longest_nap));
  }
}

Result<Frame> V4l2Camera::answer(FrameChoice::Answer answer, std::unique_lock<std::mutex> lock) {
  const std::string name = info_.id + ": frame " + std::to_string(answer.index);
  if (!answer.frame) {
    ++counters_.unanswered;
    if (!answer.damage.empty()) return Error{ErrorCode::invalid_file, name + " arrived damaged: " + answer.damage};
    return Error{ErrorCode::timeout, name + " is missing: none was exposed within " +
                                         std::to_string(settings_.max_offset_ms) + " ms of its trigger"};
  }
  counters_.trigger_offset_ms = static_cast<double>(answer.offset_ns) / 1e6;
  counters_.max_trigger_offset_ms = std::max(counters_.max_trigger_offset_ms, std::abs(counters_.trigger_offset_ms));
  lock.unlock();
  return develop(*std::move(answer.frame), answer.index);
}

Result<Frame> V4l2Camera::develop(StreamedFrame streamed, int index) const {
  const VideoMode& mode = device_->mode();
  Frame frame{.camera = info_.id,
              .index = index,
              .timestamp_ns = streamed.begin_ns,
              // Counted from 1, so that 0 is no frame's.
              .frame_id = streamed.sequence + 1,
              .pixels = nullptr};
  {
    const std::lock_guard lock(mutex_);
    frame.exposure_us = exposure_us_.value_or(0);
  }
  switch (mode.format) {
    case V4l2Format::automatic: break;
    case V4l2Format::mjpg: {
      const auto damaged = [&](const std::string& what) {
        return Error{ErrorCode::invalid_file,
                     info_.id + ": frame " + std::to_string(index) + " arrived damaged: " + what};
      };
      auto image = decode_image(streamed.bytes);
      if (!image) return damaged(image.error().message);
      if (image->width != mode.width || image->height != mode.height)
        return damaged("it is " + std::to_string(image->width) + "x" + std::to_string(image->height) + " instead of " +
                       std::to_string(mode.width) + "x" + std::to_string(mode.height));
      frame.pixels = std::make_shared<const Image>(*std::move(image));
      frame.encoded = std::make_shared<const std::vector<uint8_t>>(std::move(streamed.bytes));
      break;
    }
    case V4l2Format::yuyv:
      frame.pixels = std::make_shared<const Image>(
          rgb_from_yuyv(streamed.bytes, mode.bytes_per_line, mode.width, mode.height, mode.encoding));
      break;
    case V4l2Format::grey:
    case V4l2Format::bayer_rggb:
    case V4l2Format::bayer_grbg:
    case V4l2Format::bayer_gbrg:
    case V4l2Format::bayer_bggr:
      frame.pixels = std::make_shared<const Image>(single_channel(streamed.bytes, mode));
      frame.mosaic = mosaic_of(mode.format);
      break;
  }
  return frame;
}

Result<void> V4l2Camera::check_presence() const {
  {
    const std::lock_guard lock(mutex_);
    if (lost_) return lost();
  }
  return device_->check_presence();
}

std::vector<Statistic> V4l2Camera::statistics() const {
  const std::lock_guard lock(mutex_);
  return {{"n_frames", static_cast<double>(counters_.frames)},
          {"n_damaged_frames", static_cast<double>(counters_.damaged)},
          {"n_missing_frames", static_cast<double>(counters_.lost)},
          {"n_unanswered_triggers", static_cast<double>(counters_.unanswered)},
          {"trigger_offset_ms", counters_.trigger_offset_ms},
          {"max_trigger_offset_ms", counters_.max_trigger_offset_ms}};
}

void V4l2Camera::stop() noexcept {
  {
    const std::lock_guard lock(mutex_);
    armed_ = false;
    newest_.reset();
    choice_.reset();
    if (!unwanted_since_) unwanted_since_ = std::chrono::steady_clock::now();
    changed_.notify_all();
  }
  wake_stream();
}

}  // namespace booth
