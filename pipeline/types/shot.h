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

}  // namespace booth
