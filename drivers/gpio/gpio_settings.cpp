#include "drivers/gpio/gpio_settings.h"

#include <utility>

#include "pipeline/types/rig.h"

namespace booth {
namespace {

struct Number {
  const char* setting;
  int value;
  int lowest, highest;
};

Result<void> check_numbers(const std::string& where, std::initializer_list<Number> numbers) {
  for (const Number& number : numbers)
    if (number.value < number.lowest || number.value > number.highest)
      return Error{ErrorCode::invalid_argument, where + ": " + number.setting + " is " + std::to_string(number.value) +
                                                    ", expected " + std::to_string(number.lowest) + " … " +
                                                    std::to_string(number.highest)};
  return {};
}

Result<void> check_line(const std::string& where, const GpioLineSettings& line) {
  if (line.chip.empty()) return Error{ErrorCode::invalid_argument, where + ": chip is empty, expected a GPIO chip"};
  if (line.line.empty())
    return Error{ErrorCode::invalid_argument, where + ": line is empty, expected its offset or its name"};
  return {};
}

Result<void> check_pair(const std::string& first_name, const GpioLineSettings& first, const std::string& second_name,
                        const GpioLineSettings& second) {
  if (auto checked = check_line(first_name, first); !checked) return checked;
  if (auto checked = check_line(second_name, second); !checked) return checked;
  if (first.chip == second.chip && first.line == second.line)
    return Error{ErrorCode::invalid_argument,
                 first_name + " and " + second_name + " are both line " + first.line + " of " + first.chip};
  return {};
}

constexpr int shortest_pulse_us = 10;
constexpr int longest_pulse_us = 100'000;
constexpr int longest_wait_us = 1'000'000;

}  // namespace

Result<void> check(const GpioTriggerSettings& settings) {
  const auto lines = settings.lights ? check_pair("gpio.trigger", settings.trigger, "gpio.lights", *settings.lights)
                                     : check_line("gpio.trigger", settings.trigger);
  if (!lines) return lines;
  return check_numbers("gpio", {{"pulse_us", settings.pulse_us, shortest_pulse_us, longest_pulse_us},
                                {"lights_lead_us", settings.lights_lead_us, 0, longest_wait_us},
                                {"lights_hold_us", settings.lights_hold_us, 0, longest_wait_us}});
}

Result<void> check(const GpioProjectorSettings& settings) {
  if (!is_safe_id(settings.id))
    return Error{ErrorCode::invalid_argument,
                 "gpio projector: id is \"" + settings.id + "\", expected a file-name safe name"};
  if (auto lines = check_pair(settings.id + ".step", settings.step, settings.id + ".reset", settings.reset); !lines)
    return lines;
  constexpr int largest_side = 16384;
  return check_numbers(settings.id, {{"width", settings.pattern.width, 1, largest_side},
                                     {"height", settings.pattern.height, 1, largest_side},
                                     {"pulse_us", settings.pulse_us, shortest_pulse_us, longest_pulse_us},
                                     {"pause_us", settings.pause_us, 10, longest_wait_us},
                                     {"settle_us", settings.settle_us, 0, longest_wait_us}});
}

}  // namespace booth
