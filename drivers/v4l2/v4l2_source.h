#pragma once

#include <memory>
#include <vector>

#include "drivers/clock.h"
#include "drivers/device_source.h"
#include "drivers/v4l2/v4l2_settings.h"

namespace booth {

class VideoSystem;
class V4l2Registry;

/// USB cameras through Video4Linux. They have no trigger line: an armed camera streams all the time, and
/// Camera::note_trigger chooses the frame whose exposure begins nearest the trigger (in Gray-code shots the first one
/// that begins after it, for an earlier one may show the pattern before). How far off it was is in the statistics
/// trigger_offset_ms (the last) and max_trigger_offset_ms, and in the frame's time stamp: the beginning of its exposure
/// on CLOCK_MONOTONIC.
///
/// MJPG frames keep the camera's bytes as Frame::encoded, and a truncated one is never delivered; YUYV becomes RGB;
/// GREY stays as it is; Bayer samples too, with Frame::mosaic. A camera whose stream breaks off or that is unplugged is
/// lost, and can be opened again when it is back: all settings are applied and verified again.
class V4l2Source final : public DeviceSource {
 public:
  /// @param clock   CLOCK_MONOTONIC, or in tests the simulated system's; outlives the source and its devices
  /// @param system  a simulated one for tests; nullptr: this machine's
  /// @error invalid_argument  as check(settings)
  static Result<std::shared_ptr<V4l2Source>> open(V4l2Settings settings, const Clock& clock,
                                                  std::shared_ptr<VideoSystem> system = nullptr);
  ~V4l2Source() override;

  /// Also cameras that are not configured: their id is their bus, their role body.
  Result<std::vector<CameraInfo>> discover() override;
  /// Besides what DeviceSource says: @error invalid_argument  a setting that the camera cannot meet, with its range;
  /// @error unsupported  the device is no camera, or stamps its frames with another clock
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override;
  /// @error unsupported
  Result<std::unique_ptr<Trigger>> open_trigger() override;
  /// @error unsupported
  Result<std::unique_ptr<Projector>> open_projector() override;

 private:
  explicit V4l2Source(std::shared_ptr<V4l2Registry> registry);
  std::shared_ptr<V4l2Registry> registry_;
};

}  // namespace booth
