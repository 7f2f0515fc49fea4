#include "drivers/v4l2/yuyv.h"

#include <algorithm>
#include <cmath>

namespace booth {
namespace {

/// Fixed point: 16 bits behind the point.
constexpr int shift = 16;
constexpr int half = 1 << (shift - 1);
int fixed(double value) { return static_cast<int>(std::lround(value * (1 << shift))); }
uint8_t sample(int value) { return static_cast<uint8_t>(std::clamp(value >> shift, 0, 255)); }

}  // namespace

Image rgb_from_yuyv(std::span<const uint8_t> bytes, size_t bytes_per_line, int width, int height,
                    YuvEncoding encoding) {
  const double red = encoding.bt709 ? 0.2126 : 0.299;
  const double blue = encoding.bt709 ? 0.0722 : 0.114;
  const double green = 1 - red - blue;
  const double luma_scale = encoding.full_range ? 1 : 255.0 / 219;
  const double chroma_scale = encoding.full_range ? 1 : 255.0 / 224;
  const int luma_offset = encoding.full_range ? 0 : 16;
  const int y_gain = fixed(luma_scale);
  const int r_of_v = fixed(2 * (1 - red) * chroma_scale);
  const int b_of_u = fixed(2 * (1 - blue) * chroma_scale);
  const int g_of_v = fixed(2 * (1 - red) * red / green * chroma_scale);
  const int g_of_u = fixed(2 * (1 - blue) * blue / green * chroma_scale);

  Image rgb(width, height, 3);
  for (int y = 0; y < height; ++y) {
    const uint8_t* from = bytes.data() + static_cast<size_t>(y) * bytes_per_line;
    uint8_t* to = rgb.pixel(0, y);
    for (int x = 0; x + 1 < width; x += 2, from += 4) {
      const int u = from[1] - 128;
      const int v = from[3] - 128;
      for (const int luma : {from[0], from[2]}) {
        const int grey = (luma - luma_offset) * y_gain + half;
        *to++ = sample(grey + r_of_v * v);
        *to++ = sample(grey - g_of_u * u - g_of_v * v);
        *to++ = sample(grey + b_of_u * u);
      }
    }
  }
  return rgb;
}

}  // namespace booth
