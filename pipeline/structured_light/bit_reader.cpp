#include "pipeline/structured_light/bit_reader.h"

#include <algorithm>
#include <bit>
#include <cmath>

#include "pipeline/structured_light/vector_clones.h"

namespace booth {
namespace {

constexpr int size = TileRow::size;
constexpr int widest = 2;         // radius of the widest window that a dim pixel is averaged over
constexpr float certain_snr = 4;  // above that a pixel is read by itself
using Row16 = TileRow::PerPixel<int16_t>;
using RowFloat = TileRow::PerPixel<float>;
using RowFlag = TileRow::PerPixel<uint8_t>;

/// A bit's difference, summed over the window of `radius` around the pixels from (x, y) on; beyond the images their
/// rims go on. Where one of its images is missing, the pixel's own difference from `sum`, that of lit and unlit.
template <int radius>
[[gnu::always_inline]] inline void window_differences(const PatternImages& s, const BitImages& bit, int x, int y,
                                                      const Row16& sum, Row16* out) {
  constexpr int window = (2 * radius + 1) * (2 * radius + 1);
  if (bit.complete() && radius == 0) {
    const uint8_t *p = bit.pattern.row(y) + x, *q = bit.inverse.row(y) + x;
    for (int i = 0; i < size; ++i) (*out)[i] = static_cast<int16_t>(p[i] - q[i]);
  } else if (bit.complete()) {
    constexpr int columns = size + 8;  // the window's margins, and some to make it vectors of eight
    std::array<int16_t, columns> column_sums{};
    const bool interior = x >= radius && x - radius + columns <= s.width;
    for (int v = -radius; v <= radius; ++v) {
      const int row = std::clamp(y + v, 0, s.height - 1);
      const uint8_t *p = bit.pattern.row(row), *q = bit.inverse.row(row);
      if (interior) {
        for (int i = 0; i < columns; ++i)
          column_sums[i] = static_cast<int16_t>(column_sums[i] + p[x - radius + i] - q[x - radius + i]);
      } else {
        for (int i = 0; i < columns; ++i) {
          const int column = std::clamp(x - radius + i, 0, s.width - 1);
          column_sums[i] = static_cast<int16_t>(column_sums[i] + p[column] - q[column]);
        }
      }
    }
    for (int i = 0; i < size; ++i) {
      int total = 0;
      for (int u = 0; u <= 2 * radius; ++u) total += column_sums[i + u];
      (*out)[i] = static_cast<int16_t>(total);
    }
  } else if (bit.pattern) {
    const uint8_t* p = bit.pattern.row(y) + x;
    for (int i = 0; i < size; ++i) (*out)[i] = static_cast<int16_t>(window * (2 * p[i] - sum[i]));
  } else if (bit.inverse) {
    const uint8_t* q = bit.inverse.row(y) + x;
    for (int i = 0; i < size; ++i) (*out)[i] = static_cast<int16_t>(window * (sum[i] - 2 * q[i]));
  } else {
    out->fill(0);
  }
}

/// Mean of the absolute window differences of the coarse bits.
template <int radius>
[[gnu::always_inline]] inline void mean_strengths(const PatternImages& s, std::span<const BitImages* const> coarse,
                                                  int x, int y, const Row16& sum, RowFloat* mean) {
  std::array<int32_t, size> strength{};
  for (const BitImages* bit : coarse) {
    Row16 d;
    window_differences<radius>(s, *bit, x, y, sum, &d);
    for (int i = 0; i < size; ++i) strength[i] += std::abs(d[i]);
  }
  const float scale = 1.0F / static_cast<float>(std::max<size_t>(coarse.size(), 1));
  for (int i = 0; i < size; ++i) (*mean)[i] = scale * static_cast<float>(strength[i]);
}

/// Reads all bits of the pixels that are chosen, averaged over the window of `radius`.
/// @param contrast  mean strength, summed over the window as the differences are
template <int radius>
[[gnu::always_inline]] inline void read_bits(const PatternImages& s, int x, int y, const Row16& sum,
                                             const RowFloat& contrast, const RowFlag& chosen, TileRow* out) {
  RowFloat scale;
  for (int i = 0; i < size; ++i) scale[i] = static_cast<float>(relative_unit) / std::max(contrast[i], 1e-6F);
  // Beyond the contrast there is noise alone.
  constexpr float most = 1.25F * static_cast<float>(relative_unit);
  for (size_t axis = 0; axis < 2; ++axis) {
    const std::vector<BitImages>& bits = s.bits[axis];
    const size_t count = bits.size();
    TileRow::Axis& to = out->axis[axis];
    std::array<Row16, 16> relative;  // from the finest
    TileRow::PerPixel<uint16_t> code{};
    for (size_t bit = count; bit-- > 0;) {
      Row16 d;
      window_differences<radius>(s, bits[count - 1 - bit], x, y, sum, &d);
      for (int i = 0; i < size; ++i) code[i] = static_cast<uint16_t>(code[i] << 1 | (d[i] > 0 ? 1 : 0));
      for (int i = 0; i < size; ++i)
        relative[bit][i] = static_cast<int16_t>(std::min(std::max(static_cast<float>(d[i]) * scale[i], -most), most));
    }
    for (int i = 0; i < size; ++i) {  // a Gray bit is the binary bit's change from the one before it
      unsigned value = code[i];
      value ^= value >> 8;
      value ^= value >> 4;
      value ^= value >> 2;
      value ^= value >> 1;
      code[i] = static_cast<uint16_t>(value);
    }
    for (int i = 0; i < size; ++i) to.code[i] = chosen[i] != 0 ? code[i] : to.code[i];
    for (size_t bit = 0; bit < std::min<size_t>(fine_bits, count); ++bit)
      for (int i = 0; i < size; ++i) to.relative[bit][i] = chosen[i] != 0 ? relative[bit][i] : to.relative[bit][i];
    for (int i = 0; i < size; ++i) {
      if (chosen[i] == 0) continue;
      to.edge[i] = 0;
      constexpr unsigned coarse = 1U << fine_bits;
      const unsigned edge = (code[i] + 2U) & ~(coarse - 1);  // the only one that can be within two pixels
      if (edge == 0 || edge + 1 < code[i]) continue;
      const auto bit = static_cast<size_t>(std::countr_zero(edge));
      if (bit >= count || bits[count - 1 - bit].missing()) continue;
      const bool rises = ((edge ^ edge >> 1) >> bit & 1U) != 0;
      to.edge[i] = static_cast<uint16_t>(edge);
      to.edge_relative[i] = static_cast<int16_t>(rises ? relative[bit][i] : -relative[bit][i]);
    }
  }
}

/// Averages what is left over the window of `radius` and reads the pixels that this makes sure.
template <int radius>
[[gnu::always_inline]] inline bool read_dim(const PatternImages& s, std::span<const BitImages* const> coarse,
                                            float min_snr, int x, int y, const Row16& sum, const RowFloat& variance,
                                            RowFlag* left, TileRow* out) {
  RowFloat contrast;
  mean_strengths<radius>(s, coarse, x, y, sum, &contrast);
  constexpr float width = 2 * radius + 1, window = width * width;
  RowFlag chosen;
  int found = 0, remaining = 0;
  for (int i = 0; i < size; ++i) {
    const float snr2 = contrast[i] * contrast[i] / (window * window * variance[i]);
    chosen[i] = (*left)[i] != 0 && snr2 * window >= min_snr * min_snr ? 1 : 0;
    if (chosen[i] != 0) out->snr2[i] = snr2;
    found += chosen[i];
    (*left)[i] = static_cast<uint8_t>((*left)[i] - chosen[i]);
    remaining += (*left)[i];
    out->lit[i] = static_cast<uint8_t>(out->lit[i] + chosen[i]);
  }
  if (found > 0) read_bits<radius>(s, x, y, sum, contrast, chosen, out);
  return remaining > 0;
}

BOOTH_VECTOR_CLONES
void read_tile_row(const PatternImages& s, const BitImages& reference, std::span<const BitImages* const> coarse,
                   float min_snr, float overall_variance, int x, int y, TileRow* out) {
  // Sums over the coarse bits, whose stripes are wide: how strong their differences are, and how much the sums of
  // pattern and inverse vary, which would all be the same without noise.
  Row16 sum{}, strength{}, drift{};
  std::array<int32_t, size> drift2{};
  if (reference.complete()) {
    const uint8_t *p = reference.pattern.row(y) + x, *q = reference.inverse.row(y) + x;
    for (int i = 0; i < size; ++i) sum[i] = static_cast<int16_t>(p[i] + q[i]);
  }
  for (const BitImages* bit : coarse) {
    const uint8_t *p = bit->pattern.row(y) + x, *q = bit->inverse.row(y) + x;
    for (int i = 0; i < size; ++i) {
      const int off = p[i] + q[i] - sum[i];
      strength[i] = static_cast<int16_t>(strength[i] + std::abs(p[i] - q[i]));
      drift[i] = static_cast<int16_t>(drift[i] + off);
      drift2[i] += off * off;
    }
  }
  // The variance of a bit's difference at a pixel (a difference and a sum of two images have the same noise), steadied
  // by that of the whole image.
  constexpr float overall_weight = 6;  // as many samples
  const float count = static_cast<float>(std::max<size_t>(coarse.size(), 1));
  RowFloat variance, contrast;
  RowFlag left;
  int certain = 0;
  for (int i = 0; i < size; ++i) {
    const float mean = static_cast<float>(drift[i]) / count;
    const float scatter = static_cast<float>(drift2[i]) - mean * mean * count;
    variance[i] = (overall_weight * overall_variance + scatter) / (overall_weight + count - 1);
    contrast[i] = static_cast<float>(strength[i]) / count;
    out->snr2[i] = contrast[i] * contrast[i] / variance[i];
    out->lit[i] = out->snr2[i] >= certain_snr * certain_snr ? 1 : 0;
    left[i] = static_cast<uint8_t>(1 - out->lit[i]);
    certain += out->lit[i];
  }
  if (certain > 0) read_bits<0>(s, x, y, sum, contrast, out->lit, out);
  if (certain == size) return;
  if (s.lit_and_unlit.complete()) {
    // Nothing around the pixel is lit by half of what is asked for.
    constexpr float share = 0.5F, width = 2 * widest + 1;
    Row16 d;
    window_differences<widest>(s, s.lit_and_unlit, x, y, sum, &d);
    int hopeful = 0;
    for (int i = 0; i < size; ++i) {
      const float mean = std::max(static_cast<float>(d[i]), 0.0F) / (width * width);
      const float least = share * min_snr / width;
      left[i] = left[i] != 0 && mean * mean >= least * least * variance[i] ? 1 : 0;
      hopeful += left[i];
    }
    if (hopeful == 0) return;
  }
  if (read_dim<1>(s, coarse, min_snr, x, y, sum, variance, &left, out))
    read_dim<widest>(s, coarse, min_snr, x, y, sum, variance, &left, out);
}

}  // namespace

BitReader::BitReader(const PatternImages& images, double min_snr)
    : s_(images), reference_(images.lit_and_unlit), min_snr_(static_cast<float>(min_snr)) {
  for (const auto& bits : s_.bits)
    for (size_t bit = 0; bit < bits.size(); ++bit) {
      all_.push_back(&bits[bit]);
      if (!bits[bit].complete()) continue;
      if (!reference_.complete()) reference_ = bits[bit];
      if (bit + fine_bits < bits.size()) coarse_.push_back(&bits[bit]);
    }
  if (s_.lit_and_unlit.complete()) coarse_.push_back(&s_.lit_and_unlit);
  noise_ = measure_noise();
}

Result<void> BitReader::check() const {
  if (!reference_.complete())
    return Error{ErrorCode::no_subject, "neither the lit and the unlit image nor any inverse of a pattern is there"};
  for (size_t axis = 0; axis < 2; ++axis)
    for (size_t bit = 0; bit + 1 < s_.bits[axis].size(); ++bit)
      if (s_.bits[axis][bit].missing())
        return Error{ErrorCode::no_subject, std::string("both images of ") + (axis == 0 ? "column" : "row") + " bit " +
                                                std::to_string(bit) + " are missing"};
  return {};
}

double BitReader::measure_noise() const {
  constexpr double assumed_noise = 2;  // grey levels, where it cannot be measured
  std::vector<const BitImages*> pairs;
  std::copy_if(all_.begin(), all_.end(), std::back_inserter(pairs),
               [](const BitImages* bit) { return bit->complete(); });
  if (pairs.size() < 2) return assumed_noise;
  constexpr int stride = 4;
  std::vector<int> spread;
  for (int y = 0; y < s_.height; y += stride)
    for (int x = 0; x < s_.width; x += stride) {
      if (pairs.front()->contrast(x, y) < clearly_lit) continue;
      for (size_t p = 1; p < pairs.size(); p += 4)
        spread.push_back(std::abs(pairs[p]->sum(x, y) - pairs[0]->sum(x, y)));
    }
  if (spread.size() < fewest_lit) return assumed_noise;
  const auto middle = spread.begin() + static_cast<std::ptrdiff_t>(spread.size() / 2);
  std::nth_element(spread.begin(), middle, spread.end());
  constexpr double normal_mad = 0.6745;
  constexpr double images_in_change = 4;
  return std::max(0.3, (*middle + 0.5) / normal_mad / std::sqrt(images_in_change));
}

void BitReader::read(int x, int y, TileRow* row) const {
  read_tile_row(s_, reference_, coarse_, min_snr_, static_cast<float>(2 * noise_ * noise_), x, y, row);
}

}  // namespace booth
