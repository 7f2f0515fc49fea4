#pragma once

#include <memory>
#include <string>

#include "drivers/clock.h"
#include "drivers/gpio/gpio_settings.h"
#include "pipeline/types/result.h"

namespace booth {

/// An output line that we hold; at rest from the beginning. The destructor frees it.
class OutputLine {
 public:
  virtual ~OutputLine() = default;
  /// @param active  whether the line has its active level, else it is at rest. @error device_lost
  virtual Result<void> set(bool active) = 0;
};

/// What the GPIO drivers ask of the operating system, so that tests can put simulated lines in its place.
class GpioSystem {
 public:
  virtual ~GpioSystem() = default;
  /// @param consumer  who holds the line, for whoever asks the kernel
  /// @error as open_gpio_trigger
  virtual Result<std::unique_ptr<OutputLine>> request_output(const GpioLineSettings& line,
                                                             const std::string& consumer) = 0;
  /// Returns when the booth's clock has reached `then`.
  virtual void sleep_until(Timestamp then) = 0;
};

/// This machine's chips, by libgpiod.
std::shared_ptr<GpioSystem> linux_gpio_system();

}  // namespace booth
