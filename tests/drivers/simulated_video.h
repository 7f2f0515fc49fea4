#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "drivers/v4l2/video_system.h"

namespace booth {

/// A control of a simulated camera.
struct SimulatedControl {
  uint32_t id = 0;
  std::string name;
  uint32_t type = 0;
  int64_t minimum = 0, maximum = 0, step = 1, value = 0;
  std::vector<int64_t> menu = {};  ///< entries that a menu has
  uint32_t governed_by = 0;        ///< inactive while that control has not the value below
  int64_t free_when = 0;
  std::optional<int64_t> sticks_at = {};  ///< whatever is set, it takes this value
};

struct SimulatedSize {
  uint32_t fourcc = 0;
  int width = 0, height = 0;
  std::vector<int> rates = {30, 15};
};

/// What is plugged in: a device, of which every node is described apart.
struct SimulatedNode {
  std::string node;
  std::string serial = "S1";
  std::string bus = "usb-sim-1";
  uint32_t capabilities = 0;  ///< of the device as a whole
  uint32_t device_caps = 0;   ///< of this node
  std::vector<SimulatedSize> sizes = {};
  std::vector<SimulatedControl> controls = {};
  bool monotonic = true;
  std::map<unsigned long, int> errors = {};  ///< errno of an ioctl that fails
  uint32_t most_buffers = 32;                ///< that its driver grants
  bool maps = true;                          ///< its buffers can be mapped
  uint32_t fills_wrong_buffer = 0;           ///< added to the index of each that it fills
  int keeps_rate = 0;                        ///< frames a second, whatever is asked for; 0: what is asked for
  int rounds_width_to = 0;                   ///< S_FMT does not keep the width that was asked for
  bool forgets_on_stream = false;            ///< the exposure returns to its default when the stream begins
};

/// Cameras as the kernel would show them, of which a test sends every frame. Descriptors are real ones, so that poll(2)
/// works on them.
class SimulatedVideo final : public VideoSystem {
 public:
  ~SimulatedVideo() override;

  void plug_in(SimulatedNode node);
  void unplug(const std::string& node);
  /// Fills the next lent buffer. @return false where the stream does not run, or the kernel has no buffer left: the
  /// frame is lost then, and leaves a gap in the count
  bool send(const std::string& node, const std::vector<uint8_t>& bytes, int64_t timestamp_ns, uint32_t flags = 0);
  /// As a driver does whose hardware broke down.
  void break_stream(const std::string& node);
  bool streams(const std::string& node);
  int64_t control_value(const std::string& node, uint32_t id);
  int open_descriptors();

  std::vector<std::string> nodes() override;
  std::string resolve(const std::string& path) override;
  std::string serial(const std::string& node) override;
  int open(const std::string& node) override;
  void close(int fd) override;
  int control(int fd, unsigned long request, void* argument) override;
  const uint8_t* map(int fd, size_t length, int64_t offset) override;
  void unmap(const uint8_t* memory, size_t length) override;

 private:
  struct Device;
  struct Handle;
  std::shared_ptr<Device> find(const std::string& node);

  std::mutex mutex_;
  std::map<std::string, std::shared_ptr<Device>> devices_;
  std::map<int, std::shared_ptr<Handle>> handles_;
};

/// A camera with MJPG, YUYV, GREY and RGGB in small sizes and the usual controls.
SimulatedNode usual_camera(const std::string& node = "/dev/video0", const std::string& serial = "S1",
                           const std::string& bus = "usb-sim-1");

}  // namespace booth
