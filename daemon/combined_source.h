#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "drivers/device_source.h"

namespace booth {

/// What a booth takes from which driver.
struct CombinedParts {
  using OpenTrigger = std::function<Result<std::unique_ptr<Trigger>>()>;
  using OpenProjector = std::function<Result<std::unique_ptr<Projector>>()>;

  std::map<std::string, std::shared_ptr<DeviceSource>> cameras;  ///< by id
  OpenTrigger trigger;
  OpenProjector projector;  ///< empty: the booth has none
  /// Where simulated cameras see only their own driver's trigger and projector: these follow the real ones.
  std::shared_ptr<DeviceSource> trigger_follower = {}, projector_follower = {};
};

/// Devices of several drivers as those of one: each camera of its own driver, and whatever fires and projects.
class CombinedSource final : public DeviceSource {
 public:
  explicit CombinedSource(CombinedParts parts) : parts_(std::move(parts)) {}
  /// What all drivers see. @error of the first driver that could not look
  Result<std::vector<CameraInfo>> discover() override;
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override;
  Result<std::unique_ptr<Trigger>> open_trigger() override;
  Result<std::unique_ptr<Projector>> open_projector() override;

 private:
  const CombinedParts parts_;
};

/// A trigger that fires nothing: it only names the instant by which cameras that stream all the time choose a frame.
class InstantTrigger final : public Trigger {
 public:
  explicit InstantTrigger(const Clock& clock) : clock_(clock) {}
  const std::string& driver() const override { return name_; }
  Result<Timestamp> fire() override { return clock_.now(); }

 private:
  const Clock& clock_;
  const std::string name_ = "none";
};

}  // namespace booth
