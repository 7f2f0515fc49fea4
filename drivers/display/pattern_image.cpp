#include "drivers/display/pattern_image.h"

#include <algorithm>
#include <bit>
#include <tuple>

namespace booth {
namespace {

/// What a pattern shows: a bit of the Gray code of the column or the row, or one colour everywhere.
struct Stripes {
  enum class Kind { columns, rows, uniform } kind = Kind::uniform;
  int bit = 0;         ///< of columns and rows
  bool white = false;  ///< where the bit is 1; of uniform, everywhere
};

int code_bits(int size) { return std::bit_width(static_cast<unsigned>(size - 1)); }

Stripes stripes(const GrayCodePattern& pattern, int index) {
  const int images_per_bit = pattern.inverse ? 2 : 1;
  int rest = index;
  for (const auto& [used, kind, size] : {std::tuple{pattern.columns, Stripes::Kind::columns, pattern.width},
                                         std::tuple{pattern.rows, Stripes::Kind::rows, pattern.height}}) {
    if (!used) continue;
    const int images = images_per_bit * code_bits(size);
    if (rest < images) return {kind, code_bits(size) - 1 - rest / images_per_bit, rest % images_per_bit == 0};
    rest -= images;
  }
  return {Stripes::Kind::uniform, 0, rest == 0};
}

bool gray_bit(int position, int bit) { return (((position ^ (position >> 1)) >> bit) & 1) != 0; }

}  // namespace

void draw_pattern(const GrayCodePattern& pattern, int index, uint32_t white, std::span<uint32_t> pixels,
                  size_t stride) {
  const Stripes shown = stripes(pattern, index);
  const auto width = static_cast<size_t>(pattern.width);
  const auto colour = [&](int position) { return gray_bit(position, shown.bit) == shown.white ? white : 0; };
  for (int y = 0; y < pattern.height; ++y) {
    const auto row = pixels.subspan(static_cast<size_t>(y) * stride, width);
    if (shown.kind == Stripes::Kind::uniform)
      std::fill(row.begin(), row.end(), shown.white ? white : 0);
    else if (shown.kind == Stripes::Kind::rows)
      std::fill(row.begin(), row.end(), colour(y));
    else if (y == 0)
      for (int x = 0; x < pattern.width; ++x) row[static_cast<size_t>(x)] = colour(x);
    else
      std::copy_n(pixels.begin(), width, row.begin());
  }
}

}  // namespace booth
