#pragma once

#include <string>

#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

/// A projector on a display output of this machine, driven without a window system.
struct DisplaySettings {
  std::string id = "projector";  ///< as in the rig

  std::string card = {};       ///< "/dev/dri/card0"; empty: the first that has a display connected
  std::string connector = {};  ///< "HDMI-A-1"; empty: the only one that is connected
  int width = 0;               ///< of the mode, pixels, 0 … 16384; 0 with height 0: the display's preferred mode
  int height = 0;              ///< pixels, 0 … 16384
  double refresh_hz = 0;       ///< of the mode, 0 … 1000, met within 0.5 Hz; 0: the most offered in that size

  /// The sequence. Its size is the mode's; 0 × 0 stands for that.
  GrayCodePattern pattern = {};
  int delay_us = 50'000;  ///< from the flip until the pattern is whole on the subject, 0 … 1'000'000; see
                          ///< delay_calibration.h, which measures it
  double brightness = 1;  ///< of white, as a part of the most light that the projector gives, 0.01 … 1
  double gamma = 2.2;     ///< of the projector's response, 1 … 4: brightness b is sent as 255 b^(1/gamma)
};

/// @error invalid_argument  naming setting, value and what would do
Result<void> check(const DisplaySettings& settings);

}  // namespace booth
