#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace booth {

/// A dense image: `height` rows of `width` pixels of `channels` interleaved samples, no padding.
/// Pixel (0,0) is the top-left one and its centre lies at the coordinates (0,0).
template <class Sample>
struct Raster {
  int width = 0;
  int height = 0;
  int channels = 1;
  std::vector<Sample> samples;

  Raster() = default;
  Raster(int width_, int height_, int channels_, Sample fill = Sample{})
      : width(width_),
        height(height_),
        channels(channels_),
        samples(static_cast<size_t>(width_) * static_cast<size_t>(height_) * static_cast<size_t>(channels_), fill) {}

  bool empty() const { return samples.empty(); }
  bool contains(int x, int y) const { return x >= 0 && y >= 0 && x < width && y < height; }

  /// The samples of pixel (x, y); unchecked.
  Sample* pixel(int x, int y) { return samples.data() + index(x, y); }
  const Sample* pixel(int x, int y) const { return samples.data() + index(x, y); }
  Sample& at(int x, int y, int channel = 0) { return samples[index(x, y) + static_cast<size_t>(channel)]; }
  Sample at(int x, int y, int channel = 0) const { return samples[index(x, y) + static_cast<size_t>(channel)]; }

 private:
  size_t index(int x, int y) const {
    return (static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x)) *
           static_cast<size_t>(channels);
  }
};

/// 8 bits a sample: 1 channel grey (or a mask), 3 channels sRGB in the order R, G, B, 4 with alpha last
/// (not premultiplied).
using Image = Raster<uint8_t>;
/// One float a pixel unless said otherwise.
using FloatImage = Raster<float>;

}  // namespace booth
