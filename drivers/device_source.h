#pragma once

#include <memory>
#include <string>
#include <vector>

#include "drivers/camera.h"
#include "drivers/projector.h"
#include "drivers/trigger.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"

namespace booth {

/// A driver at work: it sees devices and opens them, one by one and again after a loss. Devices keep what they need
/// of it alive. Every function may be called from several threads.
class DeviceSource {
 public:
  virtual ~DeviceSource() = default;

  /// Every camera that the driver can see now, opened or not.
  virtual Result<std::vector<CameraInfo>> discover() = 0;

  /// @param id  as in the rig
  /// @error not_found    no such camera; @error device_lost  it is not there now, which may change
  /// @error busy         it is open already
  virtual Result<std::unique_ptr<Camera>> open_camera(const std::string& id) = 0;

  /// @error unsupported  the driver has none; @error device_lost, busy  as above
  virtual Result<std::unique_ptr<Trigger>> open_trigger() = 0;

  /// @error as open_trigger
  virtual Result<std::unique_ptr<Projector>> open_projector() = 0;

  /// The rig that belongs to the devices where the driver knows it, as a replay does; otherwise nullptr, and the
  /// booth's own calibration holds.
  virtual const Rig* rig() const { return nullptr; }
};

}  // namespace booth
