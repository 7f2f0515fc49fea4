#pragma once

#include <string>

#include "drivers/clock.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"

namespace booth {

struct CameraInfo {
  std::string id;      ///< as in the rig
  std::string driver;  ///< "replay", "aravis", "v4l2"
  CameraRole role = CameraRole::body;
  int width = 0;  ///< of the frames it delivers
  int height = 0;
};

/// What a camera is armed for. Exposure and the like belong to the driver's own configuration, by role.
struct CaptureSettings {
  ShotRole role = ShotRole::body;
};

/// One camera. closed ──open──▶ idle ⇄ armed: an open_* function creates it, the destructor closes it.
/// One thread at a time calls arm and wait_frame; stop may come from another.
class Camera {
 public:
  virtual ~Camera() = default;
  virtual const CameraInfo& info() const = 0;

  /// Ready to deliver `count` triggered frames, indices 0 … count − 1; further triggers are not answered. An armed
  /// camera begins anew: frames that were not fetched are dropped. Settings that the device cannot meet are an
  /// error, never rounded. @error device_lost, invalid_argument, unsupported
  virtual Result<void> arm(const CaptureSettings& settings, int count) = 0;

  /// The next frame in trigger order; its index says which trigger it answers, so a lost frame leaves a gap.
  /// @error timeout      nothing arrived until `deadline`; the camera stays armed
  /// @error invalid_file a frame arrived damaged and was dropped; the camera stays armed
  /// @error cancelled    stop() was called, or the camera is not armed
  /// @error device_lost  the camera is gone; only the destructor may be called
  virtual Result<Frame> wait_frame(Timestamp deadline) = 0;

  /// Back to idle; a waiting wait_frame returns cancelled.
  virtual void stop() noexcept = 0;
};

}  // namespace booth
