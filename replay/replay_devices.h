#pragma once

#include <memory>
#include <string>

#include "drivers/clock.h"
#include "drivers/device_source.h"
#include "replay/recording.h"
#include "replay/replay_options.h"

namespace booth {

class ReplayStage;

/// Plays a recording through the drivers' interfaces, as often as asked: one camera for each of the rig's, a
/// trigger, and the projector where the rig has one.
///
/// A camera armed for a role answers trigger k with its frame of the k-th index that the recording's first shot of
/// that role has (from the first again when there are fewer). A gray_code shot is answered with the frame of the
/// pattern that the projector shows at that instant (dark: the all-black one), a calibration_board shot with the pose
/// after the last one, also across arms. A camera without such a frame stays silent, as a broken one would. Timestamps
/// are the trigger's instant plus the recorded offset between the cameras. Frames are decoded by the thread that waits
/// for them, and carry their encoded bytes. In preview mode a camera shows its first picture of the role it was armed
/// for (of any role, where it has none), 20 times a second.
class ReplaySource final : public DeviceSource {
 public:
  /// @param clock  outlives the source and its devices
  /// @error as read_recording; invalid_argument  a fault names a camera that the rig does not have
  static Result<std::shared_ptr<ReplaySource>> open(const ReplayOptions& options, const Clock& clock);
  ~ReplaySource() override;

  Result<std::vector<CameraInfo>> discover() override;
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override;
  Result<std::unique_ptr<Trigger>> open_trigger() override;
  Result<std::unique_ptr<Projector>> open_projector() override;
  const Rig* rig() const override;

  const Recording& recording() const;

  /// Unplugs a camera by its id, or the "trigger" or the "projector": whatever it is asked returns device_lost, and
  /// it cannot be opened until plug_in.
  void unplug(const std::string& device);
  void plug_in(const std::string& device);

 private:
  explicit ReplaySource(std::shared_ptr<ReplayStage> stage);
  std::shared_ptr<ReplayStage> stage_;
};

}  // namespace booth
