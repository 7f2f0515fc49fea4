#pragma once

#include <functional>
#include <list>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "drivers/aravis/aravis_camera.h"
#include "drivers/aravis/gvcp.h"
#include "drivers/trigger.h"

namespace booth {

/// The cameras that a trigger is for, as they are open now.
using TriggeredCameras = std::function<std::vector<std::shared_ptr<AravisCamera>>()>;

/// Orders every camera at once, each from a thread of its own: one after the other they would be half a millisecond
/// apart each.
class SoftwareTrigger final : public Trigger {
 public:
  SoftwareTrigger(TriggeredCameras cameras, const Clock& clock, AravisCamera::Warn warn)
      : cameras_(std::move(cameras)), clock_(clock), warn_(std::move(warn)) {}
  const std::string& driver() const override { return driver_; }
  /// Does not wait for a camera that is slow to confirm, as one that hangs is for seconds: the shot has a deadline.
  /// Such a camera gets no further order until it has answered this one.
  /// @error device_lost  cameras are open, and all of them refused the order
  Result<Timestamp> fire() override;

 private:
  struct Order;
  /// A thread whose camera has not confirmed yet.
  struct Slow {
    std::shared_ptr<AravisCamera> camera;
    std::shared_ptr<const Order> order;
    size_t number = 0;
    std::jthread thread;
  };
  const TriggeredCameras cameras_;
  const Clock& clock_;
  const AravisCamera::Warn warn_;
  std::list<Slow> slow_;
  const std::string driver_ = "software";
};

/// Sends the action command, and watches that the cameras acknowledge it.
class ActionTrigger final : public Trigger {
 public:
  ActionTrigger(TriggeredCameras cameras, const AravisActionSettings& settings, ActionSender sender, const Clock& clock,
                AravisCamera::Warn warn)
      : cameras_(std::move(cameras)),
        settings_(settings),
        sender_(std::move(sender)),
        clock_(clock),
        warn_(std::move(warn)) {}
  const std::string& driver() const override { return driver_; }
  /// @error device_lost  it cannot be sent, cameras are open and none acknowledged it, or it is to be scheduled and no
  ///                     camera's clock can be read, or they do not go alike
  Result<Timestamp> fire() override;

 private:
  const TriggeredCameras cameras_;
  const AravisActionSettings settings_;
  ActionSender sender_;
  const Clock& clock_;
  const AravisCamera::Warn warn_;
  const std::string driver_ = "action";
};

}  // namespace booth
