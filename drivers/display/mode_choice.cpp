#include "drivers/display/mode_choice.h"

#include <cmath>
#include <sstream>

namespace booth {
namespace {

/// Displays say 59.94 where people say 60.
constexpr double refresh_tolerance_hz = 0.5;

void describe(std::ostream& text, int width, int height, double refresh_hz) {
  text << width << "x" << height;
  if (refresh_hz != 0) text << " at " << std::round(refresh_hz * 100) / 100 << " Hz";
}

}  // namespace

Result<size_t> choose_mode(const std::vector<DisplayMode>& modes, const DisplaySettings& settings) {
  if (modes.empty()) return Error{ErrorCode::device_lost, settings.id + ": the display offers no mode"};
  const auto meets = [&](const DisplayMode& mode) {
    if (mode.interlaced) return false;
    if (settings.width != 0 && (mode.width != settings.width || mode.height != settings.height)) return false;
    return settings.refresh_hz == 0 || std::abs(mode.refresh_hz - settings.refresh_hz) <= refresh_tolerance_hz;
  };
  const auto better = [&](const DisplayMode& mode, const DisplayMode& best) {
    // Without a size the display's own counts; in one size, the fastest.
    if (settings.width == 0 && mode.preferred != best.preferred) return mode.preferred;
    return mode.width == best.width && mode.height == best.height && mode.refresh_hz > best.refresh_hz;
  };
  size_t best = modes.size();
  for (size_t i = 0; i < modes.size(); ++i)
    if (meets(modes[i]) && (best == modes.size() || better(modes[i], modes[best]))) best = i;
  if (best < modes.size()) return best;
  std::ostringstream message;
  message << settings.id << ": the mode ";
  if (settings.width != 0)
    describe(message, settings.width, settings.height, settings.refresh_hz);
  else
    message << "with " << settings.refresh_hz << " Hz";
  message << " is not offered; the display offers ";
  constexpr size_t most = 24;
  for (size_t i = 0; i < modes.size() && i < most; ++i) {
    if (i > 0) message << ", ";
    describe(message, modes[i].width, modes[i].height, modes[i].refresh_hz);
    if (modes[i].interlaced) message << " interlaced";
  }
  if (modes.size() > most) message << " and more";
  return Error{ErrorCode::invalid_argument, message.str()};
}

Result<GrayCodePattern> pattern_for(const DisplayMode& mode, const DisplaySettings& settings) {
  GrayCodePattern pattern = settings.pattern;
  if (pattern.width == 0) {
    pattern.width = mode.width;
    pattern.height = mode.height;
  }
  if (pattern.width == mode.width && pattern.height == mode.height) return pattern;
  std::ostringstream message;
  message << settings.id << ": the pattern is " << pattern.width << "x" << pattern.height << ", but the display shows "
          << mode.width << "x" << mode.height << "; they must be the same, so that no pixel is scaled";
  return Error{ErrorCode::invalid_argument, message.str()};
}

int white_level(const DisplaySettings& settings) {
  return static_cast<int>(std::lround(255 * std::pow(settings.brightness, 1 / settings.gamma)));
}

}  // namespace booth
