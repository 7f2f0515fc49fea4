#include "daemon/preview_image.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace booth {
namespace {

Image shrink(const Image& image, int width, int height) {
  if (width == image.width && height == image.height) return image;
  Image small(width, height, image.channels);
  const auto edge = [](int i, int of, int from) { return static_cast<int>(static_cast<int64_t>(i) * from / of); };
  for (int y = 0; y < height; ++y) {
    const int top = edge(y, height, image.height), bottom = edge(y + 1, height, image.height);
    for (int x = 0; x < width; ++x) {
      const int left = edge(x, width, image.width), right = edge(x + 1, width, image.width);
      const int64_t covered = static_cast<int64_t>(bottom - top) * (right - left);
      for (int channel = 0; channel < image.channels; ++channel) {
        int64_t sum = 0;
        for (int v = top; v < bottom; ++v)
          for (int u = left; u < right; ++u) sum += image.at(u, v, channel);
        small.at(x, y, channel) = static_cast<uint8_t>((sum + covered / 2) / covered);
      }
    }
  }
  return small;
}

Image turn(const Image& image, int rotation_deg) {
  if (rotation_deg == 0) return image;
  const bool quarter = rotation_deg == 90 || rotation_deg == 270;
  Image turned(quarter ? image.height : image.width, quarter ? image.width : image.height, image.channels);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      int u = image.width - 1 - x, v = image.height - 1 - y;  // 180°
      if (rotation_deg == 90) u = image.height - 1 - y, v = x;
      if (rotation_deg == 270) u = y, v = image.width - 1 - x;
      std::copy_n(image.pixel(x, y), image.channels, turned.pixel(u, v));
    }
  return turned;
}

/// IEC 61966-2-1, from linear to encoded.
std::array<uint8_t, 256> srgb_table() {
  std::array<uint8_t, 256> table{};
  for (size_t i = 0; i < table.size(); ++i) {
    const double linear = static_cast<double>(i) / 255;
    const double encoded = linear <= 0.0031308 ? 12.92 * linear : 1.055 * std::pow(linear, 1 / 2.4) - 0.055;
    table[i] = static_cast<uint8_t>(std::lround(255 * encoded));
  }
  return table;
}

}  // namespace

Image bin_mosaic(const Image& raw, const Mosaic& mosaic) {
  static const std::array<uint8_t, 256> encoded = srgb_table();
  // Which colour (0 red, 1 green, 2 blue) each pixel of a 2 × 2 block has, in reading order.
  std::array<size_t, 4> colours{0, 1, 1, 2};
  if (mosaic.pattern == BayerPattern::grbg) colours = {1, 0, 2, 1};
  if (mosaic.pattern == BayerPattern::gbrg) colours = {1, 2, 0, 1};
  if (mosaic.pattern == BayerPattern::bggr) colours = {2, 1, 1, 0};
  Image small(raw.width / 2, raw.height / 2, 3);
  for (int y = 0; y < small.height; ++y)
    for (int x = 0; x < small.width; ++x) {
      std::array<int, 3> sums{};
      for (size_t i = 0; i < colours.size(); ++i)
        sums[colours[i]] += raw.at(2 * x + static_cast<int>(i % 2), 2 * y + static_cast<int>(i / 2));
      sums[1] /= 2;
      for (int channel = 0; channel < 3; ++channel) {
        const auto sample = static_cast<uint8_t>(sums[static_cast<size_t>(channel)]);
        small.at(x, y, channel) = mosaic.linear ? encoded[sample] : sample;
      }
    }
  return small;
}

Image make_preview(const Image& image, int rotation_deg, int max_width) {
  const int upright_width = rotation_deg == 90 || rotation_deg == 270 ? image.height : image.width;
  const double scale = std::min(1.0, static_cast<double>(max_width) / upright_width);
  const auto scaled = [&](int length) { return std::max(1, static_cast<int>(length * scale + 0.5)); };
  return turn(shrink(image, scaled(image.width), scaled(image.height)), rotation_deg);
}

}  // namespace booth
