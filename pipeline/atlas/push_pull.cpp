#include "pipeline/atlas/push_pull.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>
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

/// What happens to the pixels of a picture in 8-bit sRGB.
struct SrgbPixels {
  using Sample = uint8_t;
  static constexpr Sample grey = 128;

  /// The mean light of one to four pixels.
  static void average(std::span<const Sample* const> pixels, Sample* out) {
    std::array<float, colours> sum{};
    for (const Sample* pixel : pixels)
      for (size_t c = 0; c < sum.size(); ++c) sum[c] += linear_from_srgb(pixel[c]);
    for (size_t c = 0; c < sum.size(); ++c) out[c] = srgb_from_linear(sum[c] / static_cast<float>(pixels.size()));
  }
  /// (9 a + 3 b + 3 c + d) / 16.
  static void interpolate(const Sample* a, const Sample* b, const Sample* c, const Sample* d, Sample* out) {
    for (int k = 0; k < colours; ++k) out[k] = static_cast<Sample>((9 * a[k] + 3 * (b[k] + c[k]) + d[k] + 8) / 16);
  }
};

/// The same of a picture in linear light, a pixel of four samples at once.
struct LightPixels {
  using Sample = int16_t;
  static constexpr Sample grey = 3500;  // about as above

  static void average(std::span<const Sample* const> pixels, Sample* out) {
    constexpr int32_t divisible = 12;  // by one, two, three and four
    Integers sum{};
    for (const Sample* pixel : pixels) sum += read(pixel);
    if (pixels.size() == 4) return write((sum + 2) >> 2, out);
    write((sum * (divisible / static_cast<int32_t>(pixels.size())) + divisible / 2) / divisible, out);
  }
  static void interpolate(const Sample* a, const Sample* b, const Sample* c, const Sample* d, Sample* out) {
    write((9 * read(a) + 3 * (read(b) + read(c)) + read(d) + 8) >> 4, out);
  }

 private:
  using Integers = int32_t __attribute__((vector_size(16)));
  using Words = Sample __attribute__((vector_size(8)));

  static Integers read(const Sample* pixel) {
    Words words;
    std::memcpy(&words, pixel, sizeof words);
    return __builtin_convertvector(words, Integers);
  }
  static void write(Integers pixel, Sample* out) {
    const Words words = __builtin_convertvector(pixel, Words);
    std::memcpy(out, &words, sizeof words);
  }
};

/// Rows that one thread works on at once.
constexpr size_t rows_at_once = 64;

/// Each pixel the mean of its valid children, valid if any of them is.
template <class Pixels, class Sample = typename Pixels::Sample>
Level<Sample> halved(const Raster<Sample>& image, const Image& valid, const Work& work) {
  Level<Sample> half{Raster<Sample>((image.width + 1) / 2, (image.height + 1) / 2, image.channels), {}};
  half.valid = Image(half.image.width, half.image.height, 1);
  const auto halve_row = [&](int y) {
    const int rows = std::min(2, image.height - 2 * y);
    for (int x = 0; x < half.image.width; ++x) {
      const int columns = std::min(2, image.width - 2 * x);
      std::array<const Sample*, 4> children;
      size_t count = 0;
      for (int v = 2 * y; v < 2 * y + rows; ++v) {
        const uint8_t* is_valid = valid.pixel(2 * x, v);
        const Sample* pixel = image.pixel(2 * x, v);
        for (int u = 0; u < columns; ++u, pixel += image.channels)
          if (is_valid[u] != 0) children[count++] = pixel;
      }
      if (count == 0) continue;
      half.valid.at(x, y) = 255;
      Pixels::average({children.data(), count}, half.image.pixel(x, y));
    }
  };
  work.parallel_for(static_cast<size_t>(half.image.height), rows_at_once, [&](size_t begin, size_t end) {
    for (size_t y = begin; y < end; ++y) halve_row(static_cast<int>(y));
  });
  return half;
}

/// Where a pixel is not valid, the coarser level interpolated: its four nearest pixels by 9 : 3 : 3 : 1.
template <class Pixels, class Sample = typename Pixels::Sample>
void fill_from_coarser(Raster<Sample>& image, const Image& valid, const Raster<Sample>& coarse, const Work& work) {
  const auto fill_row = [&](int y) {
    const uint8_t* is_valid = valid.pixel(0, y);
    const int v = y / 2, v2 = std::clamp(y % 2 == 0 ? v - 1 : v + 1, 0, coarse.height - 1);
    for (int x = 0; x < image.width; ++x) {
      if (is_valid[x] != 0) continue;
      const int u = x / 2, u2 = std::clamp(x % 2 == 0 ? u - 1 : u + 1, 0, coarse.width - 1);
      Pixels::interpolate(coarse.pixel(u, v), coarse.pixel(u2, v), coarse.pixel(u, v2), coarse.pixel(u2, v2),
                          image.pixel(x, y));
    }
  };
  work.parallel_for(static_cast<size_t>(image.height), rows_at_once, [&](size_t begin, size_t end) {
    for (size_t y = begin; y < end; ++y) fill_row(static_cast<int>(y));
  });
}

template <class Pixels, class Sample = typename Pixels::Sample>
std::vector<Raster<Sample>> filled_pyramid(Raster<Sample> image, Image valid, const Work& work) {
  std::vector<Level<Sample>> levels;
  levels.push_back({std::move(image), std::move(valid)});
  while (levels.back().image.width > 1 || levels.back().image.height > 1)
    levels.push_back(halved<Pixels>(levels.back().image, levels.back().valid, work));
  if (auto& top = levels.back(); top.valid.at(0, 0) == 0) std::fill_n(top.image.pixel(0, 0), colours, Pixels::grey);
  for (size_t k = levels.size() - 1; k-- > 0;)
    fill_from_coarser<Pixels>(levels[k].image, levels[k].valid, levels[k + 1].image, work);
  std::vector<Raster<Sample>> pyramid;
  for (Level<Sample>& level : levels) pyramid.push_back(std::move(level.image));
  return pyramid;
}

}  // namespace

Pyramid push_pull(Image image, Image valid, const Work& work) {
  return filled_pyramid<SrgbPixels>(std::move(image), std::move(valid), work);
}
LightPyramid push_pull(LightImage image, Image valid, const Work& work) {
  return filled_pyramid<LightPixels>(std::move(image), std::move(valid), work);
}

}  // namespace booth
