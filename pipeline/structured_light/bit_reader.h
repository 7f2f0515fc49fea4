#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "pipeline/structured_light/pattern_images.h"

namespace booth {

inline constexpr int fine_bits = 4;       ///< whose differences place a pixel between the stripes' edges
inline constexpr int relative_unit = 64;  ///< of differences relative to the contrast

/// What a row of a tile's pixels reads.
struct TileRow {
  static constexpr int size = SearchTiles::size_px;
  template <class T>
  using PerPixel = std::array<T, static_cast<size_t>(size)>;

  PerPixel<int16_t> lit;  ///< 0: too dim, the rest is meaningless; -1 otherwise
  PerPixel<float> snr2;   ///< square of the contrast by the standard deviation of a bit's difference at that pixel
  struct Axis {
    PerPixel<uint16_t> code;                                                 ///< projector pixel by all bits' signs
    std::array<PerPixel<int16_t>, static_cast<size_t>(fine_bits)> relative;  ///< the finest bits' differences
    /// Where a coarser bit has an edge beside `code` the finest are mirrored and cannot tell its sides: the pixel that
    /// the edge lies before, and its bit's difference, positive behind it. 0: there is none.
    PerPixel<uint16_t> edge;
    PerPixel<int16_t> edge_relative;
  };
  std::array<Axis, 2> axis;
};

using TileRead = std::array<TileRow, static_cast<size_t>(TileRow::size)>;

/// Reads the bits of pixels and how sure they are. What is too dim by itself (dark skin and hair, grazing light) is
/// averaged with its surroundings as far as the noise asks for.
class BitReader {
 public:
  /// @param images   must outlive the reader
  /// @param min_snr  as GrayCodeOptions
  BitReader(const PatternImages& images, double min_snr);

  /// @error no_subject  images of a bit that cannot be done without are missing
  Result<void> check() const;
  /// The standard deviation of one image, grey levels, from how much the sums of pattern and inverse differ.
  double noise() const { return noise_; }
  /// Mean of the finest bits' absolute difference relative to the contrast, columns' and rows', over some of the pixels
  /// that are sure; nothing where there are none. 0 for a bit that is not complete.
  std::optional<std::array<double, 2>> finest_strength() const;
  /// The tile whose first pixel is (x, y): all its columns and those of its rows that lie in the images.
  void read(int x, int y, TileRead* read) const;

 private:
  double measure_noise() const;

  const PatternImages& s_;
  std::vector<uint8_t> coarse_;  ///< 1 for complete bits whose stripes are wide: columns', rows', lit and unlit
  BitImages reference_;          ///< what a pattern alone is compared with: lit and unlit, or another pair
  float min_snr_;
  double noise_;
};

}  // namespace booth
