#pragma once

#include <string>
#include <vector>

#include "drivers/display/display_settings.h"
#include "pipeline/types/result.h"

namespace booth {

/// One mode that a display offers.
struct DisplayMode {
  int width = 0;
  int height = 0;
  double refresh_hz = 0;
  bool preferred = false;
  bool interlaced = false;  ///< shows half a pattern at a time, so that it is never chosen
};

/// @param modes  as the display lists them
/// @return the index of the mode that the settings want. @error invalid_argument  none is like that; the message lists
/// what is offered. device_lost  there is no mode at all
Result<size_t> choose_mode(const std::vector<DisplayMode>& modes, const DisplaySettings& settings);

/// The sequence in the mode's size. @error invalid_argument  the settings name another size
Result<GrayCodePattern> pattern_for(const DisplayMode& mode, const DisplaySettings& settings);

/// The value, 0 … 255, that makes the projector give the settings' brightness.
int white_level(const DisplaySettings& settings);

}  // namespace booth
