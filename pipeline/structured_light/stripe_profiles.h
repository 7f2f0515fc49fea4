#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/structured_light/bit_reader.h"

namespace booth {

/// The finest bits' differences relative to the contrast, by position: square waves that the optics blur.
class StripeProfiles {
 public:
  /// @param blur_px  standard deviation of the blur, projector pixels
  explicit StripeProfiles(double blur_px);

  /// Mean of the finest bit's absolute value, 1 without blur.
  static double mean_absolute(double blur_px);
  /// The blur at which that is `mean`.
  static double blur_of(double mean);

  struct Place {
    float position;     ///< projector pixels
    float information;  ///< what a unit of relative difference² says about it, 1/pixel²
  };
  /// The position within a pixel and a half of the code at which the profiles explain a pixel's differences best.
  /// @param known  the finest bits that have images, from the finest
  Place place(const TileRow::Axis& read, size_t pixel, const std::array<bool, fine_bits>& known) const;

 private:
  static constexpr int steps_per_px = 8;   // of the search
  static constexpr int search_steps = 12;  // to each side of the code: a bit read wrongly at an edge moves it by one
  static constexpr int candidates = 2 * search_steps;  // at the middles of the steps
  static constexpr int edge_reach = 4 * candidates;
  static int period_steps(int k) { return (4 << k) * steps_per_px; }

  std::array<std::vector<int16_t>, fine_bits> tables_;
  std::array<int16_t, 2 * edge_reach> edge_{};
};

}  // namespace booth
