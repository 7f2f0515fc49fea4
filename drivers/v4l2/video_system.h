#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace booth {

/// What the V4L2 driver asks of the operating system, so that tests can put simulated cameras in its place. Every
/// function may be called from several threads. Where an int is returned, negative numbers are -errno.
class VideoSystem {
 public:
  virtual ~VideoSystem() = default;
  /// Every video node, cameras or not, by number: "/dev/video0" …
  virtual std::vector<std::string> nodes() = 0;
  /// The node that a path leads to; empty where nothing is.
  virtual std::string resolve(const std::string& path) = 0;
  /// The serial number of the USB device that a node belongs to; empty where there is none.
  virtual std::string serial(const std::string& node) = 0;

  /// A non-blocking file descriptor that poll(2) understands.
  virtual int open(const std::string& node) = 0;
  virtual void close(int fd) = 0;
  /// ioctl(2).
  virtual int control(int fd, unsigned long request, void* argument) = 0;
  /// @return nullptr where it fails
  virtual const uint8_t* map(int fd, size_t length, int64_t offset) = 0;
  virtual void unmap(const uint8_t* memory, size_t length) = 0;
};

/// This machine's.
std::shared_ptr<VideoSystem> linux_video_system();

}  // namespace booth
