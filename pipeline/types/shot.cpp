#include "pipeline/types/shot.h"

#include <bit>

namespace booth {
namespace {

/// Bits that tell `size` columns or rows apart.
int bits_for(int size) { return size < 2 ? 0 : std::bit_width(static_cast<unsigned>(size - 1)); }

}  // namespace

std::string_view to_string(ShotRole role) {
  switch (role) {
    case ShotRole::background: return "background";
    case ShotRole::body: return "body";
    case ShotRole::gray_code: return "gray_code";
    case ShotRole::calibration_board: return "calibration_board";
  }
  return "body";
}

std::optional<ShotRole> shot_role_from(std::string_view name) {
  for (const ShotRole role : {ShotRole::background, ShotRole::body, ShotRole::gray_code, ShotRole::calibration_board})
    if (name == to_string(role)) return role;
  return std::nullopt;
}

int pattern_count(const GrayCodePattern& pattern) {
  const int bits = (pattern.columns ? bits_for(pattern.width) : 0) + (pattern.rows ? bits_for(pattern.height) : 0);
  constexpr int white_and_black = 2;
  return bits * (pattern.inverse ? 2 : 1) + white_and_black;
}

}  // namespace booth
