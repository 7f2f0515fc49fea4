#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "drivers/v4l2/v4l2_settings.h"
#include "drivers/v4l2/video_system.h"
#include "pipeline/types/result.h"

namespace booth {

/// The controls of an opened camera.
class VideoControls {
 public:
  /// @param name  of the camera, for messages
  VideoControls(VideoSystem& system, int fd, std::string name);

  /// As VideoDevice::apply_controls.
  Result<void> apply(const V4l2CameraSettings& settings, const std::optional<int>& exposure_us);
  std::optional<int> exposure_us() const;

 private:
  struct Control {
    std::string name;
    uint32_t id = 0;
    uint32_t type = 0;
    int64_t minimum = 0, maximum = 0, step = 1;
  };
  /// What one setting asks for.
  struct Request {
    std::string setting;  ///< as the operator wrote it
    int64_t value = 0;    ///< in the operator's unit
    int64_t unit = 1;     ///< operator's units in one of the camera's
    const char* suffix = "";
  };

  const Control* find(uint32_t id) const;
  Result<int64_t> read(const Control& control) const;
  Result<void> write(const Control& control, const Request& request);
  Result<void> write_first(const std::vector<uint32_t>& ids, const Request& request);
  Result<void> switch_off(uint32_t automatic, int64_t off, const std::string& setting);
  Result<void> apply_named(const std::map<std::string, int64_t>& values);
  bool inactive(uint32_t id) const;
  bool menu_offers(const Control& control, int64_t value) const;
  std::string range(const Control& control, const Request& request) const;

  VideoSystem& system_;
  int fd_;
  std::string name_;
  std::map<uint32_t, Control> controls_;
};

}  // namespace booth
