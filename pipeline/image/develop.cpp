#include "pipeline/image/develop.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <string>
#include <utility>
#include <vector>

namespace booth {
namespace {

/// The paper's filters have denominators of 8 with halves among the coefficients: sums are kept in 16ths.
constexpr int scale = 16;
constexpr int largest_sum = 255 * scale;
constexpr int smallest_side = 4;

enum Channel { red = 0, green = 1, blue = 2 };

/// The 8-bit output of every sum.
using ToneCurve = std::array<uint8_t, largest_sum + 1>;

ToneCurve make_curve(bool linear) {
  ToneCurve curve{};
  for (int sum = 0; sum <= largest_sum; ++sum) {
    double value = static_cast<double>(sum) / largest_sum;
    if (linear) value = value <= 0.0031308 ? 12.92 * value : 1.055 * std::pow(value, 1 / 2.4) - 0.055;
    curve[static_cast<size_t>(sum)] = static_cast<uint8_t>(std::lround(255 * value));
  }
  return curve;
}

/// The channel that the pixel (x, y) has.
Channel channel_at(BayerPattern pattern, int x, int y) {
  // Red's place within the 2 × 2 cell; blue is diagonally opposite.
  const int red_x = pattern == BayerPattern::grbg || pattern == BayerPattern::bggr ? 1 : 0;
  const int red_y = pattern == BayerPattern::gbrg || pattern == BayerPattern::bggr ? 1 : 0;
  const bool on_red_column = x % 2 == red_x, on_red_row = y % 2 == red_y;
  if (on_red_column != on_red_row) return green;
  return on_red_row ? red : blue;
}

/// The raw image, two pixels wider on each side: mirrored about its edge pixels, which keeps every pixel's colour.
class PaddedMosaic {
 public:
  explicit PaddedMosaic(const Image& raw)
      : stride_(raw.width + 2 * border), samples_(static_cast<size_t>(stride_) * (raw.height + 2 * border)) {
    for (int y = -border; y < raw.height + border; ++y) {
      const uint8_t* from = raw.pixel(0, mirrored(y, raw.height));
      uint8_t* to = samples_.data() + index(0, y);
      std::copy_n(from, raw.width, to);
      for (int x = 1; x <= border; ++x) to[-x] = from[x], to[raw.width - 1 + x] = from[raw.width - 1 - x];
    }
  }
  const uint8_t* pixel(int x, int y) const { return samples_.data() + index(x, y); }
  int stride() const { return stride_; }

 private:
  static constexpr int border = 2;
  static int mirrored(int i, int size) { return i < 0 ? -i : i >= size ? 2 * (size - 1) - i : i; }
  size_t index(int x, int y) const {
    return static_cast<size_t>(y + border) * static_cast<size_t>(stride_) + static_cast<size_t>(x + border);
  }
  int stride_;
  std::vector<uint8_t> samples_;
};

/// The sums of a pixel's neighbours from which each filter of the paper's figure 2 is made.
struct Neighbourhood {
  int centre, horizontal, vertical, diagonal, horizontal2, vertical2;

  Neighbourhood(const uint8_t* p, int stride)
      : centre(p[0]),
        horizontal(p[-1] + p[1]),
        vertical(p[-stride] + p[stride]),
        diagonal(p[-stride - 1] + p[-stride + 1] + p[stride - 1] + p[stride + 1]),
        horizontal2(p[-2] + p[2]),
        vertical2(p[-2 * stride] + p[2 * stride]) {}

  /// Green at a red or blue pixel.
  int green() const { return 8 * centre + 4 * (horizontal + vertical) - 2 * (horizontal2 + vertical2); }
  /// At a green pixel, the colour of its left and right neighbours.
  int from_row() const { return 10 * centre + 8 * horizontal - 2 * (horizontal2 + diagonal) + vertical2; }
  /// At a green pixel, the colour of its upper and lower neighbours.
  int from_column() const { return 10 * centre + 8 * vertical - 2 * (vertical2 + diagonal) + horizontal2; }
  /// Red at a blue pixel, blue at a red one.
  int from_diagonal() const { return 12 * centre + 4 * diagonal - 3 * (horizontal2 + vertical2); }
};

}  // namespace

Result<Image> develop(const Image& raw, const Mosaic& mosaic) {
  if (raw.channels != 1 || raw.width < smallest_side || raw.height < smallest_side ||
      raw.samples.size() != static_cast<size_t>(raw.width) * static_cast<size_t>(raw.height))
    return Error{ErrorCode::invalid_argument, "a raw image of " + std::to_string(raw.width) + " × " +
                                                  std::to_string(raw.height) + " pixels and " +
                                                  std::to_string(raw.channels) + " channels cannot be developed"};
  static const std::array<ToneCurve, 2> curves{make_curve(false), make_curve(true)};
  const ToneCurve& curve = curves[mosaic.linear ? 1 : 0];
  const auto toned = [&](int sum) { return curve[static_cast<size_t>(std::clamp(sum, 0, largest_sum))]; };

  const PaddedMosaic padded(raw);
  Image image(raw.width, raw.height, 3);
  for (int y = 0; y < raw.height; ++y) {
    const std::array<Channel, 2> row{channel_at(mosaic.pattern, 0, y), channel_at(mosaic.pattern, 1, y)};
    const Channel row_colour = row[0] == green ? row[1] : row[0];
    const Channel other_colour = row_colour == red ? blue : red;
    const uint8_t* from = padded.pixel(0, y);
    uint8_t* to = image.pixel(0, y);
    for (int x = 0; x < raw.width; ++x, ++from, to += 3) {
      const Neighbourhood near(from, padded.stride());
      const uint8_t own = toned(scale * near.centre);
      if (row[static_cast<size_t>(x % 2)] == green) {
        to[green] = own;
        to[row_colour] = toned(near.from_row());
        to[other_colour] = toned(near.from_column());
      } else {
        to[row_colour] = own;
        to[green] = toned(near.green());
        to[other_colour] = toned(near.from_diagonal());
      }
    }
  }
  return image;
}

Result<Frame> develop(const Frame& frame) {
  if (!frame.mosaic) return frame;
  if (!frame.pixels) return Error{ErrorCode::invalid_argument, frame.camera + ": has no pixels"};
  auto image = develop(*frame.pixels, *frame.mosaic);
  if (!image) return Error{image.error().code, frame.camera + ": " + image.error().message};
  Frame developed = frame;
  developed.mosaic.reset();
  developed.encoded.reset();
  developed.pixels = std::make_shared<const Image>(*std::move(image));
  return developed;
}

}  // namespace booth
