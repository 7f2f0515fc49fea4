#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "pipeline/structured_light/gray_code.h"

namespace booth {

/// Positions as the bits of each pixel tell them, with a margin all around.
class RawPositions {
 public:
  static constexpr int margin = 16;  ///< pixels
  static constexpr float none = 1e6F;

  RawPositions(int width, int height);
  int width() const { return width_; }
  int height() const { return height_; }
  std::ptrdiff_t stride() const { return stride_; }
  std::ptrdiff_t index(int x, int y) const { return (y + margin) * stride_ + x + margin; }

  std::vector<float> column, row;  ///< projector pixels; none: not placed
  std::vector<float> weight;       ///< 1/variance where placed, 0 where the pixel is dark, -1 where lit but not placed

 private:
  int width_, height_;
  std::ptrdiff_t stride_;
};

/// Averages the noise of positions and drops what no neighbours continue: a plane through the positions around each
/// pixel that continue its own; where they do not (a bit of the pixel was read wrongly), that continue their median.
class PositionFit {
 public:
  /// Measures how many projector pixels a camera pixel covers, which the window follows.
  explicit PositionFit(const RawPositions& raw);
  /// Pixels [first, last) of a row; writes to `out` where there is a position.
  void fit(int y, int first, int last, ProjectorCoordinates* out) const;

 private:
  const RawPositions& raw_;
  float scale_ = 1;
  int radius_ = 2;
};

}  // namespace booth
