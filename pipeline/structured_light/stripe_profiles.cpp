#include "pipeline/structured_light/stripe_profiles.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

/// Bit k of the Gray code is set in the middle half of every period, from a quarter of it less half a pixel on: the
/// sum of the square wave's harmonics, each damped by the Gaussian blur.
double blurred_bit(int k, double x, double blur_px) {
  const double period = 4 << k;
  const double phase = 2 * std::numbers::pi * (x + 0.5) / period;
  constexpr int harmonics = 41;
  double sum = 0, sign = -1;
  for (int n = 1; n <= harmonics; n += 2, sign = -sign) {
    const double damped = n * 2 * std::numbers::pi * blur_px / period;
    sum += sign * 4 / (std::numbers::pi * n) * std::cos(n * phase) * std::exp(-0.5 * damped * damped);
  }
  return sum;
}

/// Adds the squares, at most `most` each, of what is expected at `count` positions less what was measured.
template <int count>
[[gnu::always_inline]] inline void add_squares(const int16_t* expected, int16_t measured, int16_t most, int16_t* cost) {
  for (int j = 0; j < count; ++j) {
    const auto off = static_cast<int16_t>(measured - expected[j]);
    cost[j] = static_cast<int16_t>(cost[j] + std::min(static_cast<int16_t>(off * off), most));
  }
}

int16_t in_units(double relative) { return static_cast<int16_t>(std::lround(relative * relative_unit)); }

}  // namespace

StripeProfiles::StripeProfiles(double blur_px) {
  for (int k = 0; k < fine_bits; ++k) {
    std::vector<int16_t>& table = tables_[k];
    const size_t period = static_cast<size_t>(period_steps(k));
    table.resize(period + candidates);
    for (size_t i = 0; i < table.size(); ++i)
      table[i] = i < period ? in_units(blurred_bit(k, (static_cast<double>(i) + 0.5) / steps_per_px, blur_px))
                            : table[i - period];
  }
  for (int i = 0; i < 2 * edge_reach; ++i)
    edge_[i] = in_units(std::erf((i - edge_reach + 0.5) / steps_per_px / blur_px / std::numbers::sqrt2));
}

double StripeProfiles::mean_absolute(double blur_px) {
  double sum = 0;
  for (int i = 0; i < period_steps(0); ++i) sum += std::abs(blurred_bit(0, (i + 0.5) / steps_per_px, blur_px));
  return sum / period_steps(0);
}

double StripeProfiles::blur_of(double mean) {
  double low = 0.05, high = 3.0;
  for (int i = 0; i < 20; ++i) {
    const double middle = 0.5 * (low + high);
    (mean_absolute(middle) > mean ? low : high) = middle;
  }
  return 0.5 * (low + high);
}

BOOTH_VECTOR_CLONES
StripeProfiles::Place StripeProfiles::place(const TileRow::Axis& read, size_t pixel,
                                            const std::array<bool, fine_bits>& known) const {
  // Squares of at most 2.25 units, one a bit and one of the edge, stay within 16 bits.
  std::array<int16_t, candidates> cost{};
  const int first = read.code[pixel] * steps_per_px - search_steps;
  for (int k = 0; k < fine_bits; ++k) {
    if (!known[k]) continue;
    constexpr int16_t most =
        relative_unit * relative_unit / 2;  // one bit off is one outlier, not four times its weight
    add_squares<candidates>(tables_[k].data() + (first & (period_steps(k) - 1)), read.relative[k][pixel], most,
                            cost.data());
  }
  if (read.edge[pixel] != 0) {
    const int from_edge = first - (read.edge[pixel] * steps_per_px - steps_per_px / 2);
    add_squares<candidates>(edge_.data() + std::clamp(from_edge + edge_reach, 0, 2 * edge_reach - candidates),
                            read.edge_relative[pixel], std::numeric_limits<int16_t>::max(), cost.data());
  }
  // The cheapest of those that have neighbours.
  int16_t least = cost[1];
  for (int j = 2; j + 1 < candidates; ++j) least = std::min(least, cost[j]);
  int best = 1;
  while (cost[best] != least) ++best;
  constexpr float square = relative_unit * relative_unit;
  const float before = static_cast<float>(cost[best - 1] - least) / square,
              after = static_cast<float>(cost[best + 1] - least) / square;
  const float bend = before + after;
  const float shift = bend > 1e-6F ? std::clamp(0.5F * (before - after) / bend, -0.5F, 0.5F) : 0.0F;
  constexpr float least_bend = 0.002F;  // in the middle of a wide stripe nothing says where
  return {(static_cast<float>(first + best) + 0.5F + shift) / steps_per_px,
          std::max(bend, least_bend) * steps_per_px * steps_per_px * 0.5F};
}

}  // namespace booth
