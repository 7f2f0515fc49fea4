#include "drivers/display/display_settings.h"

#include <sstream>

#include "pipeline/types/rig.h"

namespace booth {

Result<void> check(const DisplaySettings& settings) {
  if (!is_safe_id(settings.id))
    return Error{ErrorCode::invalid_argument, "display: id is \"" + settings.id + "\", expected a file-name safe name"};
  struct Range {
    const char* setting;
    double value, lowest, highest;
  };
  constexpr int largest_side = 16384;
  const Range ranges[] = {{"width", static_cast<double>(settings.width), 0, largest_side},
                          {"height", static_cast<double>(settings.height), 0, largest_side},
                          {"refresh_hz", settings.refresh_hz, 0, 1000},
                          {"pattern width", static_cast<double>(settings.pattern.width), 0, largest_side},
                          {"pattern height", static_cast<double>(settings.pattern.height), 0, largest_side},
                          {"delay_us", static_cast<double>(settings.delay_us), 0, 1'000'000},
                          {"brightness", settings.brightness, 0.01, 1},
                          {"gamma", settings.gamma, 1, 4}};
  for (const Range& range : ranges)
    if (!(range.value >= range.lowest && range.value <= range.highest)) {
      std::ostringstream message;
      message.precision(9);
      message << settings.id << ": " << range.setting << " is " << range.value << ", expected " << range.lowest << " … "
              << range.highest;
      return Error{ErrorCode::invalid_argument, message.str()};
    }
  const auto halved = [](int width, int height) { return (width == 0) != (height == 0); };
  if (halved(settings.width, settings.height) || halved(settings.pattern.width, settings.pattern.height))
    return Error{ErrorCode::invalid_argument, settings.id + ": width and height must be set together"};
  if (!settings.pattern.columns && !settings.pattern.rows)
    return Error{ErrorCode::invalid_argument, settings.id + ": the pattern has neither columns nor rows"};
  return {};
}

}  // namespace booth
