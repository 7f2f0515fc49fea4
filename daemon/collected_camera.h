#pragma once

#include <optional>
#include <stop_token>
#include <string>

#include "daemon/frame_collector.h"
#include "drivers/camera.h"

namespace booth {

/// A supervised camera as a driver's camera, for what works with one camera alone: it stays supervised meanwhile. One
/// trigger for each time that it is armed; one thread.
class CollectedCamera final : public Camera {
 public:
  /// @param id  one of the supervisor's
  CollectedCamera(CameraSupervisor& cameras, const std::string& id, Timestamp arm_patience, Timestamp most_skew,
                  const Clock& clock, std::stop_token cancelled);
  const CameraInfo& info() const override { return info_; }
  Result<void> arm(const CaptureSettings& settings, int count) override;
  Result<Frame> wait_frame(Timestamp deadline) override;
  void note_trigger(int index, Timestamp when) noexcept override;
  void stop() noexcept override { collector_.reset(); }

 private:
  CameraSupervisor& cameras_;
  const CameraInfo info_;
  const Timestamp arm_patience_, most_skew_;
  const Clock& clock_;
  const std::stop_token cancelled_;
  std::optional<FrameCollector> collector_;
  Timestamp fired_ = 0;
};

}  // namespace booth
