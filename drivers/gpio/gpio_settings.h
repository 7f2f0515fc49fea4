#pragma once

#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

enum class ActiveLevel { high, low };

/// One line of a GPIO chip.
struct GpioLineSettings {
  std::string chip;  ///< "/dev/gpiochip0", "gpiochip0", "0", or the chip's label, which does not change between boots
  std::string line;  ///< its offset ("4") or its name ("camera-trigger")
  ActiveLevel active = ActiveLevel::high;  ///< the level that means "on"; at rest a line has the other one
};

/// The trigger line, fanned out to all cameras by hardware, and the line that switches the lights.
struct GpioTriggerSettings {
  GpioLineSettings trigger;
  int pulse_us = 500;  ///< how long the trigger line is active, 10 … 100'000

  std::optional<GpioLineSettings> lights = {};
  int lights_lead_us = 1000;   ///< from lights on to the trigger, 0 … 1'000'000
  int lights_hold_us = 20000;  ///< from the trigger to lights off, 0 … 1'000'000; it includes the pulse
  /// Shots that are lit. Gray codes want darkness.
  std::vector<ShotRole> lit_roles = {ShotRole::background, ShotRole::body, ShotRole::calibration_board};
};

/// A projector that holds the pattern sequence itself and goes on by one pattern at each pulse (as a LightCrafter 4500
/// in pattern-sequence mode with external trigger does). A pulse on the reset line brings it to the dark state before
/// the first pattern.
struct GpioProjectorSettings {
  std::string id = "projector";                              ///< as in the rig
  GrayCodePattern pattern = {.width = 1024, .height = 768};  ///< what is stored in the projector
  GpioLineSettings step;
  GpioLineSettings reset;
  int pulse_us = 500;    ///< how long a line is active, 10 … 100'000
  int pause_us = 1000;   ///< at least, between two pulses, 10 … 1'000'000
  int settle_us = 5000;  ///< from the last pulse until the pattern is on the subject, 0 … 1'000'000
};

/// @error invalid_argument  naming setting, value and what would do
Result<void> check(const GpioTriggerSettings& settings);
Result<void> check(const GpioProjectorSettings& settings);

}  // namespace booth
