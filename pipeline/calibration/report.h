#pragma once

#include <string>
#include <vector>

#include "pipeline/calibration/calibration.h"

namespace booth {

/// A page for people about a calibration: the verdict and its reason, each device's figures, its residuals and how the
/// views cover its picture, and the rig from above and from the side with the capture volume and what each camera sees.
/// Self-contained HTML with drawings in SVG: no script, nothing to load.
/// @param input  what solve_calibration was given
std::string calibration_report_html(const Calibration& calibration, const CalibrationInput& input);

}  // namespace booth
