#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "drivers/device_source.h"

namespace booth {

/// Tells cameras of every trigger that fires, as the booth does: cameras without a trigger line go by that.
class NotingSource final : public DeviceSource {
 public:
  using OpenTrigger = std::function<Result<std::unique_ptr<Trigger>>()>;
  NotingSource(std::shared_ptr<DeviceSource> cameras, OpenTrigger open_trigger)
      : cameras_(std::move(cameras)), open_trigger_(std::move(open_trigger)) {}

  Result<std::vector<CameraInfo>> discover() override { return cameras_->discover(); }
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override {
    auto camera = cameras_->open_camera(id);
    if (!camera) return camera.error();
    return std::unique_ptr<Camera>(std::make_unique<NotedCamera>(*std::move(camera), listeners_));
  }
  Result<std::unique_ptr<Trigger>> open_trigger() override {
    auto trigger = open_trigger_();
    if (!trigger) return trigger.error();
    return std::unique_ptr<Trigger>(std::make_unique<NotingTrigger>(*std::move(trigger), listeners_));
  }
  Result<std::unique_ptr<Projector>> open_projector() override { return cameras_->open_projector(); }

 private:
  class NotedCamera;
  struct Listeners {
    std::mutex mutex;
    std::set<NotedCamera*> cameras;
  };

  class NotedCamera final : public Camera {
   public:
    NotedCamera(std::unique_ptr<Camera> camera, std::shared_ptr<Listeners> listeners)
        : camera_(std::move(camera)), listeners_(std::move(listeners)) {
      const std::lock_guard lock(listeners_->mutex);
      listeners_->cameras.insert(this);
    }
    ~NotedCamera() override {
      const std::lock_guard lock(listeners_->mutex);
      listeners_->cameras.erase(this);
    }
    const CameraInfo& info() const override { return camera_->info(); }
    Result<void> arm(const CaptureSettings& settings, int count) override {
      auto armed = camera_->arm(settings, count);
      const std::lock_guard lock(listeners_->mutex);
      next_ = 0;
      return armed;
    }
    Result<Frame> wait_frame(Timestamp deadline) override { return camera_->wait_frame(deadline); }
    Result<void> check_presence() const override { return camera_->check_presence(); }
    std::vector<Statistic> statistics() const override { return camera_->statistics(); }
    void stop() noexcept override { camera_->stop(); }
    /// Under the listeners' mutex.
    void fired(Timestamp when) { camera_->note_trigger(next_++, when); }

   private:
    std::unique_ptr<Camera> camera_;
    std::shared_ptr<Listeners> listeners_;
    int next_ = 0;
  };

  class NotingTrigger final : public Trigger {
   public:
    NotingTrigger(std::unique_ptr<Trigger> trigger, std::shared_ptr<Listeners> listeners)
        : trigger_(std::move(trigger)), listeners_(std::move(listeners)) {}
    const std::string& driver() const override { return trigger_->driver(); }
    Result<Timestamp> fire() override {
      auto fired = trigger_->fire();
      if (!fired) return fired;
      const std::lock_guard lock(listeners_->mutex);
      for (NotedCamera* camera : listeners_->cameras) camera->fired(*fired);
      return fired;
    }

   private:
    std::unique_ptr<Trigger> trigger_;
    std::shared_ptr<Listeners> listeners_;
  };

  std::shared_ptr<DeviceSource> cameras_;
  OpenTrigger open_trigger_;
  std::shared_ptr<Listeners> listeners_ = std::make_shared<Listeners>();
};

}  // namespace booth
