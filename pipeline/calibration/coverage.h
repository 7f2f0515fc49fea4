#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/calibration.h"
#include "pipeline/types/image.h"

namespace booth {

/// How well the views taken so far cover one camera's picture.
struct CameraCoverage {
  std::string camera;
  int columns = 0, rows = 0;  ///< of the grid that the picture is divided into
  std::vector<int> corners;   ///< how many corners lie in each cell, row by row
  int views = 0;              ///< usable views
  int shared_views = 0;       ///< of these, with another camera in the same pose
  double covered = 0;         ///< share of the cells with a corner, 0 … 1
  double tilt_rad = 0;        ///< largest angle between the directions that the board faced, as seen by the camera
  bool enough = false;
  std::string wants;  ///< what to do next for this camera, a sentence; empty when it has enough
};

struct Coverage {
  std::vector<CameraCoverage> cameras;  ///< in the order of the devices
  bool connected = false;               ///< every camera is tied to every other through poses seen in common
  bool enough = false;                  ///< each camera has enough and all are connected
  std::string wants;                    ///< the most useful next step, a sentence; empty when there is enough
};

struct CoverageOptions {
  int fewest_views = 6;         ///< of a camera, 3 … 1000
  int fewest_shared = 3;        ///< views in common with others, 1 … 1000
  double least_covered = 0.35;  ///< share of its cells, 0 … 1
  double least_tilt_rad = 0.5;  ///< 0 … π
};

/// Judges the views taken so far: after each shot the operator is told who saw the board and where it is still thin.
/// @param views  of any cameras; views without corners count for nothing
Coverage assess_coverage(std::span<const CalibrationDevice> devices, const CalibrationBoard& board,
                         std::span<const BoardView> views, const CoverageOptions& options = {});

/// A camera's picture, upright and RGB, with every corner seen so far and the cells tinted where they are thin.
/// @param backdrop  a picture of that camera as captured, or nullptr for plain grey
/// @param width     of the result, pixels, ≥ 16
Image draw_coverage(const CalibrationDevice& device, const CameraCoverage& coverage, std::span<const BoardView> views,
                    const Image* backdrop, int width);

}  // namespace booth
