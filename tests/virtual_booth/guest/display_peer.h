#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

namespace booth {

/// What a display shows.
struct Screen {
  int width = 0;
  int height = 0;
  std::vector<uint32_t> pixels;  ///< 0xRRGGBB, row by row

  bool is_black() const;
};

/// Looks at the frame buffer that a card shows now, whoever drew it. Nothing where the output is off.
std::optional<Screen> look_at(const std::string& card);
/// Likewise its first pixel alone, which is quick.
std::optional<uint32_t> look_at_first_pixel(const std::string& card);

}  // namespace booth
