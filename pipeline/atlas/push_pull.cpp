#include "pipeline/atlas/push_pull.h"

#include <algorithm>
#include <utility>

#include "pipeline/atlas/linear_light.h"

namespace booth {
namespace {

struct Level {
  Image image, valid;
};

/// Each pixel the mean of its valid children, valid if any of them is.
Level halved(const Image& image, const Image& valid) {
  Level half{Image((image.width + 1) / 2, (image.height + 1) / 2, 3), {}};
  half.valid = Image(half.image.width, half.image.height, 1);
  for (int y = 0; y < half.image.height; ++y)
    for (int x = 0; x < half.image.width; ++x) {
      float sum[3] = {0, 0, 0};
      int count = 0;
      for (int v = 2 * y; v < std::min(2 * y + 2, image.height); ++v)
        for (int u = 2 * x; u < std::min(2 * x + 2, image.width); ++u) {
          if (valid.at(u, v) == 0) continue;
          const uint8_t* pixel = image.pixel(u, v);
          for (int c = 0; c < 3; ++c) sum[c] += linear_from_srgb(pixel[c]);
          ++count;
        }
      if (count == 0) continue;
      half.valid.at(x, y) = 255;
      for (int c = 0; c < 3; ++c) half.image.at(x, y, c) = srgb_from_linear(sum[c] / static_cast<float>(count));
    }
  return half;
}

/// Where a pixel is not valid, the coarser level interpolated: its four nearest pixels by 9 : 3 : 3 : 1.
void fill_from_coarser(Image& image, const Image& valid, const Image& coarse) {
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      if (valid.at(x, y) != 0) continue;
      const int u = x / 2, v = y / 2;
      const int u2 = std::clamp(x % 2 == 0 ? u - 1 : u + 1, 0, coarse.width - 1);
      const int v2 = std::clamp(y % 2 == 0 ? v - 1 : v + 1, 0, coarse.height - 1);
      const uint8_t *a = coarse.pixel(u, v), *b = coarse.pixel(u2, v), *c = coarse.pixel(u, v2),
                    *d = coarse.pixel(u2, v2);
      uint8_t* out = image.pixel(x, y);
      for (int k = 0; k < 3; ++k) out[k] = static_cast<uint8_t>((9 * a[k] + 3 * b[k] + 3 * c[k] + d[k] + 8) / 16);
    }
}

}  // namespace

Pyramid push_pull(Image image, const Image& valid) {
  std::vector<Level> levels;
  levels.push_back({std::move(image), valid});
  while (levels.back().image.width > 1 || levels.back().image.height > 1)
    levels.push_back(halved(levels.back().image, levels.back().valid));
  constexpr uint8_t grey = 128;
  if (Level& top = levels.back(); top.valid.at(0, 0) == 0) std::fill_n(top.image.pixel(0, 0), 3, grey);
  for (size_t k = levels.size() - 1; k-- > 0;) fill_from_coarser(levels[k].image, levels[k].valid, levels[k + 1].image);
  Pyramid pyramid;
  for (Level& level : levels) pyramid.push_back(std::move(level.image));
  return pyramid;
}

}  // namespace booth
