#pragma once

#include <string>
#include <vector>

#include "drivers/clock.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"

namespace booth {

struct CameraInfo {
  std::string id;      ///< as in the rig; of a camera that is not configured, what tells it from the others
  std::string driver;  ///< "replay", "aravis", "v4l2"
  CameraRole role = CameraRole::body;
  int width = 0;  ///< of the frames it delivers; 0 where that is not known before it is open
  int height = 0;
  std::string model = {};    ///< maker and model, for people; empty where there is none
  std::string serial = {};   ///< as the device says it
  std::string address = {};  ///< where the driver finds it: an IP address, a device node
};

/// Triggered: one frame for each trigger. Preview: frames as they come, for people to look at.
enum class CaptureMode { triggered, preview };

/// What a camera is armed for. Exposure and the like belong to the driver's own configuration, by role.
struct CaptureSettings {
  ShotRole role = ShotRole::body;
  CaptureMode mode = CaptureMode::triggered;
};

/// One number of a device's transport: "n_missing_packets", 3. Counters count from the device's opening.
struct Statistic {
  std::string name;
  double value = 0;
};

/// One camera. closed ──open──▶ idle ⇄ armed: an open_* function creates it, the destructor closes it.
/// One thread at a time calls arm and wait_frame; the others may come from any.
class Camera {
 public:
  virtual ~Camera() = default;
  virtual const CameraInfo& info() const = 0;

  /// Ready to deliver `count` triggered frames, indices 0 … count − 1; further triggers are not answered. An armed
  /// camera begins anew: frames that were not fetched are dropped. Settings that the device cannot meet are an
  /// error, never rounded. In preview mode `count` has no meaning: triggers are not waited for, indices rise with
  /// gaps where frames were skipped, and wait_frame returns the newest frame. @error device_lost, invalid_argument,
  /// unsupported
  virtual Result<void> arm(const CaptureSettings& settings, int count) = 0;

  /// The next frame in trigger order; its index says which trigger it answers, so a lost frame leaves a gap.
  /// @error timeout      nothing arrived until `deadline`; the camera stays armed
  /// @error invalid_file a frame arrived damaged and was dropped; the camera stays armed
  /// @error cancelled    stop() was called, or the camera is not armed
  /// @error device_lost  the camera is gone; only the destructor may be called
  virtual Result<Frame> wait_frame(Timestamp deadline) = 0;

  /// Trigger number `index` fired at `when`. Cameras without a trigger line choose by it the frame that answers.
  virtual void note_trigger(int /*index*/, Timestamp /*when*/) noexcept {}

  /// Whether it is still there, as far as the driver has heard without asking it for a picture. Never waits.
  /// @error device_lost
  virtual Result<void> check_presence() const { return {}; }

  /// What the transport counts; empty where there is nothing to count.
  virtual std::vector<Statistic> statistics() const { return {}; }

  /// What an operator should know now though it works: "socket_buffer_kib: 16384, but the kernel allows 208: …".
  virtual std::vector<std::string> warnings() const { return {}; }

  /// Back to idle; a waiting wait_frame returns cancelled.
  virtual void stop() noexcept = 0;
};

}  // namespace booth
