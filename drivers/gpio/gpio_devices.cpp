#include "drivers/gpio/gpio_devices.h"

#include <algorithm>
#include <string>
#include <utility>

#include "drivers/gpio/gpio_system.h"

namespace booth {
namespace {

constexpr Timestamp microseconds(int count) { return Timestamp{count} * 1000; }

/// A line that comes to rest whatever happens while it is active.
class Activation {
 public:
  explicit Activation(OutputLine& line) : line_(line) {}
  ~Activation() {
    // Nobody can be told here; rest() tells.
    if (active_) [[maybe_unused]]
      const auto rested = line_.set(false);
  }
  Activation(const Activation&) = delete;
  Activation& operator=(const Activation&) = delete;

  Result<void> begin() {
    active_ = true;
    return line_.set(true);
  }
  Result<void> rest() {
    auto rested = line_.set(false);
    active_ = !rested.ok();
    return rested;
  }

 private:
  OutputLine& line_;
  bool active_ = false;
};

class GpioTrigger final : public Trigger {
 public:
  GpioTrigger(GpioTriggerSettings settings, const Clock& clock, std::shared_ptr<GpioSystem> system,
              std::unique_ptr<OutputLine> trigger, std::unique_ptr<OutputLine> lights)
      : settings_(std::move(settings)),
        clock_(clock),
        system_(std::move(system)),
        trigger_(std::move(trigger)),
        lights_(std::move(lights)) {
    prepare(ShotRole::body);
  }
  const std::string& driver() const override { return driver_; }

  void prepare(ShotRole role) noexcept override {
    lit_ =
        lights_ && std::find(settings_.lit_roles.begin(), settings_.lit_roles.end(), role) != settings_.lit_roles.end();
  }

  Result<Timestamp> fire() override {
    if (!lit_) return pulse();
    Activation lights(*lights_);
    if (auto lit = lights.begin(); !lit) return lit.error();
    system_->sleep_until(clock_.now() + microseconds(settings_.lights_lead_us));
    const auto fired = pulse();
    if (!fired) return fired;
    system_->sleep_until(*fired + microseconds(settings_.lights_hold_us));
    if (auto dark = lights.rest(); !dark) return dark.error();
    return fired;
  }

 private:
  Result<Timestamp> pulse() {
    Activation trigger(*trigger_);
    // Taken before the edge: what a camera does about it is later.
    const Timestamp fired = clock_.now();
    if (auto began = trigger.begin(); !began) return began.error();
    system_->sleep_until(clock_.now() + microseconds(settings_.pulse_us));
    if (auto rested = trigger.rest(); !rested) return rested.error();
    return fired;
  }

  const GpioTriggerSettings settings_;
  const Clock& clock_;
  const std::shared_ptr<GpioSystem> system_;
  const std::unique_ptr<OutputLine> trigger_;
  const std::unique_ptr<OutputLine> lights_;  ///< nullptr where there is none
  bool lit_ = false;
  const std::string driver_ = "gpio";
};

class GpioProjector final : public Projector {
 public:
  GpioProjector(GpioProjectorSettings settings, const Clock& clock, std::shared_ptr<GpioSystem> system,
                std::unique_ptr<OutputLine> step, std::unique_ptr<OutputLine> reset)
      : settings_(std::move(settings)),
        info_{settings_.id, "gpio", settings_.pattern},
        clock_(clock),
        system_(std::move(system)),
        step_(std::move(step)),
        reset_(std::move(reset)) {}
  ~GpioProjector() override { dark(); }
  const ProjectorInfo& info() const override { return info_; }

  /// Brings it to where its position is known.
  Result<void> reset() {
    position_ = unknown;
    if (auto pulsed = pulse(*reset_); !pulsed) return pulsed;
    position_ = before_first;
    return {};
  }

  Result<void> show(int index) override {
    if (index < 0 || index >= pattern_count(info_.pattern))
      return Error{ErrorCode::invalid_argument, info_.id + ": has no pattern " + std::to_string(index) +
                                                    ", only 0 to " + std::to_string(pattern_count(info_.pattern) - 1)};
    if (auto stepped = step_to(index); !stepped) {
      dark();
      return stepped;
    }
    system_->sleep_until(clock_.now() + microseconds(settings_.settle_us));
    return {};
  }

  void dark() noexcept override {
    // A line that cannot be set any more was reported by whoever showed a pattern, or will be by the next who does.
    if (position_ != before_first) [[maybe_unused]]
      const auto done = reset();
  }

 private:
  static constexpr int before_first = -1;
  static constexpr int unknown = -2;

  Result<void> step_to(int index) {
    if (position_ == unknown || position_ > index)
      if (auto done = reset(); !done) return done;
    while (position_ < index) {
      if (auto pulsed = pulse(*step_); !pulsed) {
        position_ = unknown;
        return pulsed;
      }
      ++position_;
    }
    return {};
  }

  Result<void> pulse(OutputLine& line) {
    Activation activation(line);
    if (auto began = activation.begin(); !began) return began;
    system_->sleep_until(clock_.now() + microseconds(settings_.pulse_us));
    if (auto rested = activation.rest(); !rested) return rested;
    system_->sleep_until(clock_.now() + microseconds(settings_.pause_us));
    return {};
  }

  const GpioProjectorSettings settings_;
  const ProjectorInfo info_;
  const Clock& clock_;
  const std::shared_ptr<GpioSystem> system_;
  const std::unique_ptr<OutputLine> step_;
  const std::unique_ptr<OutputLine> reset_;
  int position_ = unknown;  ///< the pattern that it shows
};

}  // namespace

Result<std::unique_ptr<Trigger>> open_gpio_trigger(const GpioTriggerSettings& settings, const Clock& clock,
                                                   std::shared_ptr<GpioSystem> system) {
  if (auto checked = check(settings); !checked) return checked.error();
  if (!system) system = linux_gpio_system();
  auto trigger = system->request_output(settings.trigger, "boothd trigger");
  if (!trigger) return Error{trigger.error().code, "gpio trigger: " + trigger.error().message};
  std::unique_ptr<OutputLine> lights;
  if (settings.lights) {
    auto requested = system->request_output(*settings.lights, "boothd lights");
    if (!requested) return Error{requested.error().code, "gpio lights: " + requested.error().message};
    lights = *std::move(requested);
  }
  return std::unique_ptr<Trigger>(
      std::make_unique<GpioTrigger>(settings, clock, std::move(system), *std::move(trigger), std::move(lights)));
}

Result<std::unique_ptr<Projector>> open_gpio_projector(const GpioProjectorSettings& settings, const Clock& clock,
                                                       std::shared_ptr<GpioSystem> system) {
  if (auto checked = check(settings); !checked) return checked.error();
  if (!system) system = linux_gpio_system();
  auto step = system->request_output(settings.step, "boothd projector step");
  if (!step) return Error{step.error().code, settings.id + ": " + step.error().message};
  auto reset = system->request_output(settings.reset, "boothd projector reset");
  if (!reset) return Error{reset.error().code, settings.id + ": " + reset.error().message};
  auto projector =
      std::make_unique<GpioProjector>(settings, clock, std::move(system), *std::move(step), *std::move(reset));
  if (auto ready = projector->reset(); !ready)
    return Error{ready.error().code, settings.id + ": " + ready.error().message};
  return std::unique_ptr<Projector>(std::move(projector));
}

Result<void> rest_gpio_lines(const GpioTriggerSettings* trigger, const GpioProjectorSettings* projector,
                             const Clock& clock, const std::shared_ptr<GpioSystem>& system) {
  Result<void> rested;
  // Opening brings to rest what closing leaves so.
  if (trigger != nullptr)
    if (const auto opened = open_gpio_trigger(*trigger, clock, system); !opened) rested = opened.error();
  if (projector != nullptr)
    if (const auto opened = open_gpio_projector(*projector, clock, system); !opened && rested) rested = opened.error();
  return rested;
}

}  // namespace booth
