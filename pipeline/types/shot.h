#pragma once

#include <optional>
#include <string>
#include <string_view>

namespace booth {

/// What a shot is taken for.
enum class ShotRole { background, body, gray_code, calibration_board };

/// The role's name in recording.json ("gray_code").
std::string_view to_string(ShotRole role);
/// The role of that name, if it is one.
std::optional<ShotRole> shot_role_from(std::string_view name);

/// A Gray-code sequence in the order of OpenCV's structured_light::GrayCodePattern: column bits from the most
/// significant, each followed by its inverse, then row bits likewise, then all white, then all black.
struct GrayCodePattern {
  int width = 0;   ///< projector pixels
  int height = 0;  ///< projector pixels
  bool columns = true;
  bool rows = true;
  bool inverse = true;
};

/// How many images the sequence has: 42 for 1024 × 768 with columns, rows and inverses.
int pattern_count(const GrayCodePattern& pattern);

/// A ChArUco board: a chessboard with a marker in each of its white squares.
struct CalibrationBoard {
  std::string type = "charuco";
  int squares_x = 0, squares_y = 0;   ///< along the board's x and y axes
  double square_m = 0, marker_m = 0;  ///< edges of a square and of a marker, metres
  std::string dictionary;             ///< OpenCV's name of the markers' dictionary: "DICT_5X5_250"
};

}  // namespace booth
