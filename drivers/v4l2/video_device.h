#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "drivers/clock.h"
#include "drivers/v4l2/v4l2_settings.h"
#include "drivers/v4l2/video_system.h"
#include "drivers/v4l2/yuyv.h"
#include "pipeline/types/result.h"

namespace booth {

/// What a node says it is.
struct VideoNode {
  std::string node;
  std::string card;       ///< maker and model
  std::string bus;        ///< the port
  bool captures = false;  ///< streams pictures; a camera's metadata node does not
};

/// The format that camera and settings agreed on.
struct VideoMode {
  V4l2Format format = V4l2Format::automatic;
  int width = 0;
  int height = 0;
  uint32_t bytes_per_line = 0;  ///< 0 where it has no lines (MJPG)
  double fps = 0;               ///< 0 where the camera does not say
  YuvEncoding encoding = {};
};

/// A buffer that the device filled, until it is given back.
struct FilledBuffer {
  uint32_t index = 0;
  uint32_t sequence = 0;
  Timestamp timestamp_ns = 0;
  bool stamped_at_end = false;  ///< of the exposure, else at its beginning
  bool error = false;           ///< the driver knows that the content is damaged
  std::span<const uint8_t> bytes;
};

/// Reads what a node says of itself. @error device_lost, busy, io, unsupported
Result<VideoNode> identify(VideoSystem& system, const std::string& node);

/// An opened capture node. Errors name the camera. dequeue and enqueue may run on another thread than the rest.
class VideoDevice {
 public:
  /// Opens the node and agrees on a format. @param settings  checked
  /// @error invalid_argument  a format, size or rate that is not offered, with what is; unsupported  no camera;
  ///        device_lost, busy, io
  static Result<std::unique_ptr<VideoDevice>> open(std::shared_ptr<VideoSystem> system, const std::string& node,
                                                   const V4l2CameraSettings& settings);
  ~VideoDevice();
  VideoDevice(const VideoDevice&) = delete;
  VideoDevice& operator=(const VideoDevice&) = delete;

  const VideoMode& mode() const { return mode_; }
  /// For poll(2): readable when a buffer is filled; POLLHUP once the device is gone.
  int descriptor() const { return fd_; }
  /// Asks nothing of the device. @error device_lost
  Result<void> check_presence() const;

  /// Switches automatics off and sets everything that the settings name, and reads it back.
  /// @param exposure_us  instead of the settings'
  /// @error invalid_argument  the camera lacks the control or takes other values, which the message tells
  Result<void> apply_controls(const V4l2CameraSettings& settings, const std::optional<int>& exposure_us);
  /// As the camera has it now; nothing where it does not say.
  std::optional<int> exposure_us() const;

  /// Lends `buffers` to the kernel, which may take fewer, and begins to stream.
  /// @error unsupported  no monotonic time stamps; io  among others: not enough USB bandwidth
  Result<void> start(int buffers);
  void stop() noexcept;

  /// The next filled buffer; nothing where none is yet. @error device_lost  also when the stream broke off
  Result<std::optional<FilledBuffer>> dequeue();
  /// @error device_lost
  Result<void> enqueue(const FilledBuffer& buffer);

 private:
  struct Mapping {
    const uint8_t* memory = nullptr;
    size_t length = 0;
  };

  VideoDevice(std::shared_ptr<VideoSystem> system, int fd, std::string name)
      : system_(std::move(system)), fd_(fd), name_(std::move(name)) {}
  Result<void> negotiate(const V4l2CameraSettings& settings);
  Result<void> set_mode(const V4l2CameraSettings& settings, V4l2Format format, int width, int height, double fps);
  Result<void> map_buffers(int buffers);
  int ioctl(unsigned long request, void* argument) const { return system_->control(fd_, request, argument); }

  std::shared_ptr<VideoSystem> system_;
  int fd_;
  std::string name_;  ///< of the camera, for messages
  VideoMode mode_;
  std::vector<Mapping> mappings_;
};

}  // namespace booth
