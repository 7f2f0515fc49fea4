#include "drivers/gpio/gpio_system.h"

#include <gpiod.h>

#include <cerrno>
#include <charconv>
#include <cstring>
#include <ctime>
#include <optional>
#include <utility>

namespace booth {
namespace {

struct CloseChip {
  void operator()(gpiod_chip* chip) const { gpiod_chip_close(chip); }
};
using Chip = std::unique_ptr<gpiod_chip, CloseChip>;

std::string name_of(const GpioLineSettings& settings) { return "line " + settings.line + " of " + settings.chip; }

Error failure(const GpioLineSettings& settings, const std::string& what, int error) {
  const std::string message = name_of(settings) + " " + what + ": " + std::strerror(error);
  if (error == EACCES || error == EPERM) return {ErrorCode::io, message + "; is this user in the group gpio?"};
  return {ErrorCode::device_lost, message};
}

std::optional<unsigned> offset_of(const std::string& line) {
  unsigned offset = 0;
  const auto parsed = std::from_chars(line.data(), line.data() + line.size(), offset);
  if (parsed.ec != std::errc() || parsed.ptr != line.data() + line.size()) return std::nullopt;
  return offset;
}

class GpiodLine final : public OutputLine {
 public:
  GpiodLine(Chip chip, gpiod_line* line, GpioLineSettings settings)
      : chip_(std::move(chip)), line_(line), settings_(std::move(settings)) {}
  ~GpiodLine() override { gpiod_line_release(line_); }

  Result<void> set(bool active) override {
    if (gpiod_line_set_value(line_, active ? 1 : 0) != 0) return failure(settings_, "cannot be set", errno);
    return {};
  }

 private:
  Chip chip_;
  gpiod_line* line_;  ///< the chip's
  GpioLineSettings settings_;
};

class LinuxGpioSystem final : public GpioSystem {
 public:
  Result<std::unique_ptr<OutputLine>> request_output(const GpioLineSettings& settings,
                                                     const std::string& consumer) override {
    Chip chip(gpiod_chip_open_lookup(settings.chip.c_str()));
    if (!chip) return failure(settings, "cannot be had, as the chip cannot be opened", errno);
    const auto offset = offset_of(settings.line);
    if (offset && *offset >= gpiod_chip_num_lines(chip.get()))
      return Error{ErrorCode::not_found, name_of(settings) + " does not exist: the chip has lines 0 … " +
                                             std::to_string(gpiod_chip_num_lines(chip.get()) - 1)};
    gpiod_line* line =
        offset ? gpiod_chip_get_line(chip.get(), *offset) : gpiod_chip_find_line(chip.get(), settings.line.c_str());
    if (line == nullptr)
      return Error{ErrorCode::not_found, name_of(settings) + " does not exist: no line of the chip has that name"};
    // The pull holds the line at rest once nobody drives it any more, which is all that can be had when this process is
    // killed. Chips without pulls ignore it.
    const int flags = settings.active == ActiveLevel::low
                          ? GPIOD_LINE_REQUEST_FLAG_ACTIVE_LOW | GPIOD_LINE_REQUEST_FLAG_BIAS_PULL_UP
                          : GPIOD_LINE_REQUEST_FLAG_BIAS_PULL_DOWN;
    constexpr int at_rest = 0;
    if (gpiod_line_request_output_flags(line, consumer.c_str(), flags, at_rest) != 0) {
      const int error = errno;
      if (error != EBUSY) return failure(settings, "cannot be had", error);
      const char* const holder = gpiod_line_consumer(line);
      return Error{ErrorCode::busy,
                   name_of(settings) + " is in use by " + (holder != nullptr ? holder : "another program")};
    }
    return std::unique_ptr<OutputLine>(std::make_unique<GpiodLine>(std::move(chip), line, settings));
  }

  void sleep_until(Timestamp then) override {
    const timespec when{then / seconds(1), then % seconds(1)};
    while (::clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &when, nullptr) == EINTR) {
    }
  }
};

}  // namespace

std::shared_ptr<GpioSystem> linux_gpio_system() { return std::make_shared<LinuxGpioSystem>(); }

}  // namespace booth
