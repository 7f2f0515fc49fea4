#include "pipeline/atlas/push_pull.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "pipeline/atlas/linear_light.h"

namespace booth {
namespace {

template <class Sample>
struct Level {
  Raster<Sample> image;
  Image valid;
};

constexpr int colours = 3;

/// The mean light of one to four pixels.
class SrgbMean {
 public:
  using Sample = uint8_t;
  static constexpr Sample grey = 128;

  void add(const Sample* pixel) {
    for (size_t c = 0; c < colours; ++c) sum_[c] += linear_from_srgb(pixel[c]);
  }
  void write(int count, Sample* pixel) const {
    for (size_t c = 0; c < colours; ++c) pixel[c] = srgb_from_linear(sum_[c] / static_cast<float>(count));
  }

 private:
  std::array<float, colours> sum_{};
};

class LightMean {
 public:
  using Sample = int16_t;
  static constexpr Sample grey = 3500;  // about as above

  void add(const Sample* pixel) {
    for (size_t c = 0; c < sum_.size(); ++c) sum_[c] += pixel[c];
  }
  void write(int count, Sample* pixel) const {
    constexpr int32_t divisible = 12;  // by one, two, three and four
    const int32_t factor = divisible / count;
    for (size_t c = 0; c < sum_.size(); ++c)
      pixel[c] = static_cast<Sample>((sum_[c] * factor + divisible / 2) / divisible);
  }

 private:
  std::array<int32_t, 4> sum_{};
};

/// Each pixel the mean of its valid children, valid if any of them is.
template <class Mean, class Sample = typename Mean::Sample>
Level<Sample> halved(const Raster<Sample>& image, const Image& valid) {
  Level<Sample> half{Raster<Sample>((image.width + 1) / 2, (image.height + 1) / 2, image.channels), {}};
  half.valid = Image(half.image.width, half.image.height, 1);
  for (int y = 0; y < half.image.height; ++y) {
    const int rows = std::min(2, image.height - 2 * y);
    for (int x = 0; x < half.image.width; ++x) {
      const int columns = std::min(2, image.width - 2 * x);
      Mean mean;
      int count = 0;
      for (int v = 2 * y; v < 2 * y + rows; ++v) {
        const uint8_t* is_valid = valid.pixel(2 * x, v);
        const Sample* pixel = image.pixel(2 * x, v);
        for (int u = 0; u < columns; ++u, pixel += image.channels) {
          if (is_valid[u] == 0) continue;
          mean.add(pixel);
          ++count;
        }
      }
      if (count == 0) continue;
      half.valid.at(x, y) = 255;
      mean.write(count, half.image.pixel(x, y));
    }
  }
  return half;
}

/// Where a pixel is not valid, the coarser level interpolated: its four nearest pixels by 9 : 3 : 3 : 1.
template <class Sample>
void fill_from_coarser(Raster<Sample>& image, const Image& valid, const Raster<Sample>& coarse) {
  for (int y = 0; y < image.height; ++y) {
    const uint8_t* is_valid = valid.pixel(0, y);
    const int v = y / 2, v2 = std::clamp(y % 2 == 0 ? v - 1 : v + 1, 0, coarse.height - 1);
    for (int x = 0; x < image.width; ++x) {
      if (is_valid[x] != 0) continue;
      const int u = x / 2, u2 = std::clamp(x % 2 == 0 ? u - 1 : u + 1, 0, coarse.width - 1);
      const Sample *a = coarse.pixel(u, v), *b = coarse.pixel(u2, v), *c = coarse.pixel(u, v2),
                   *d = coarse.pixel(u2, v2);
      Sample* out = image.pixel(x, y);
      for (int k = 0; k < colours; ++k) out[k] = static_cast<Sample>((9 * a[k] + 3 * b[k] + 3 * c[k] + d[k] + 8) / 16);
    }
  }
}

template <class Mean, class Sample = typename Mean::Sample>
std::vector<Raster<Sample>> filled_pyramid(Raster<Sample> image, const Image& valid) {
  std::vector<Level<Sample>> levels;
  levels.push_back({std::move(image), valid});
  while (levels.back().image.width > 1 || levels.back().image.height > 1)
    levels.push_back(halved<Mean>(levels.back().image, levels.back().valid));
  if (auto& top = levels.back(); top.valid.at(0, 0) == 0) std::fill_n(top.image.pixel(0, 0), colours, Mean::grey);
  for (size_t k = levels.size() - 1; k-- > 0;) fill_from_coarser(levels[k].image, levels[k].valid, levels[k + 1].image);
  std::vector<Raster<Sample>> pyramid;
  for (Level<Sample>& level : levels) pyramid.push_back(std::move(level.image));
  return pyramid;
}

}  // namespace

Pyramid push_pull(Image image, const Image& valid) { return filled_pyramid<SrgbMean>(std::move(image), valid); }
LightPyramid push_pull(LightImage image, const Image& valid) {
  return filled_pyramid<LightMean>(std::move(image), valid);
}

}  // namespace booth
