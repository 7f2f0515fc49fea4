#pragma once

#include <chrono>
#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "drivers/camera.h"
#include "drivers/clock.h"
#include "drivers/v4l2/frame_choice.h"
#include "drivers/v4l2/v4l2_settings.h"
#include "drivers/v4l2/video_device.h"

namespace booth {

/// A camera that streams while it is armed and a little longer, on a thread of its own; see V4l2Source.
class V4l2Camera final : public Camera {
 public:
  /// @param device    opened, its controls applied
  /// @param on_close  called at the end of the destructor, when the device is free again
  V4l2Camera(std::unique_ptr<VideoDevice> device, V4l2CameraSettings settings, CameraInfo info, const Clock& clock,
             std::function<void()> on_close);
  ~V4l2Camera() override;

  const CameraInfo& info() const override { return info_; }
  Result<void> arm(const CaptureSettings& settings, int count) override;
  Result<Frame> wait_frame(Timestamp deadline) override;
  void note_trigger(int index, Timestamp when) noexcept override;
  Result<void> check_presence() const override;
  std::vector<Statistic> statistics() const override;
  void stop() noexcept override;

 private:
  struct Counters {
    int64_t frames = 0;      ///< that arrived, damaged ones included
    int64_t damaged = 0;     ///< truncated, or marked by the driver
    int64_t lost = 0;        ///< gaps in the driver's count
    int64_t unanswered = 0;  ///< triggers without a frame
    double trigger_offset_ms = 0;
    double max_trigger_offset_ms = 0;
  };

  Result<void> start_stream(const std::optional<int>& exposure_us);
  void end_stream() noexcept;
  Result<void> warm_up();
  bool is_triggered() const { return settings_.trigger == V4l2TriggerSource::line; }
  int warm_up_frames() const;
  void wake_stream() noexcept;
  void stream();
  std::optional<int> stream_patience();
  bool takes_frames() const;
  Result<void> drain();
  void take(const FilledBuffer& buffer, Timestamp begin, std::vector<uint8_t> bytes, std::string damage);
  void lose(const Error& error);
  Error lost() const;
  Result<Frame> answer(FrameChoice::Answer answer, std::unique_lock<std::mutex> lock);
  Result<Frame> develop(StreamedFrame streamed, int index) const;

  const V4l2CameraSettings settings_;
  CameraInfo info_;
  const Clock& clock_;
  const std::function<void()> on_close_;
  std::unique_ptr<VideoDevice> device_;
  int wakeup_fd_;  ///< an eventfd that interrupts the stream thread's waiting

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  // Below: guarded by mutex_.
  std::optional<Error> lost_;
  bool armed_ = false;
  bool streaming_ = false;
  bool stop_wanted_ = false;
  std::optional<std::chrono::steady_clock::time_point> unwanted_since_;  ///< while nobody wants the stream
  bool preview_ = false;
  std::optional<FrameChoice> choice_;    ///< of the triggered frames
  std::optional<StreamedFrame> newest_;  ///< of the preview
  int previewed_ = 0;
  int warm_up_left_ = 0;
  std::optional<int> wanted_exposure_us_;
  std::optional<int> exposure_us_;  ///< in force, whoever chose it
  std::optional<uint32_t> last_sequence_;
  Counters counters_;

  std::jthread
      thread_;  ///< started by arm; ends when nobody wants the stream any more; joined by arm and the destructor
};

}  // namespace booth
