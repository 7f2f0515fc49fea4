#pragma once

#include <memory>

#include "drivers/clock.h"
#include "drivers/gpio/gpio_settings.h"
#include "drivers/projector.h"
#include "drivers/trigger.h"

namespace booth {

class GpioSystem;

/// A trigger on a GPIO line: fire() switches the lights on where the shot is lit (Trigger::prepare), waits their lead,
/// pulses the line, and returns the instant of its active edge once lights and line are back at rest.
///
/// Lines are requested at rest, and brought to rest by the destructor and after every error. When the process is killed
/// the kernel frees them: chips that have pulls, which are asked for, then pull them to rest; what others do is up to
/// them (most keep the last level, some float). rest_gpio_lines() is for whoever cleans up after the process.
/// @param clock   outlives the trigger
/// @param system  a simulated one for tests; nullptr: this machine's chips
/// @error invalid_argument  as check(settings), or two lines are the same; not_found  no such line on the chip;
///        device_lost  no such chip now; busy  somebody else, named, holds the line; io  not permitted
Result<std::unique_ptr<Trigger>> open_gpio_trigger(const GpioTriggerSettings& settings, const Clock& clock,
                                                   std::shared_ptr<GpioSystem> system = nullptr);

/// A projector stepped by a GPIO line. It is reset, thus dark, when it is opened, by dark(), in the destructor and
/// after an error; show() pulses as often as the way to the pattern needs, over the reset where it lies behind.
/// @param as open_gpio_trigger
/// @error as open_gpio_trigger
Result<std::unique_ptr<Projector>> open_gpio_projector(const GpioProjectorSettings& settings, const Clock& clock,
                                                       std::shared_ptr<GpioSystem> system = nullptr);

/// Brings lines to rest that a process may have left active, and a stepped projector to where it is dark.
/// @param trigger, projector  nullptr: there is none
/// @error as open_gpio_trigger, of the first that cannot be had; the other one is brought to rest all the same
Result<void> rest_gpio_lines(const GpioTriggerSettings* trigger, const GpioProjectorSettings* projector,
                             const Clock& clock, const std::shared_ptr<GpioSystem>& system = nullptr);

}  // namespace booth
