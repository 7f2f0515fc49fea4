#include "pipeline/structured_light/bit_reader.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <numbers>

#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

constexpr int size = TileRow::size;
constexpr int widest = 2;         // radius of the widest window that a dim pixel is averaged over
constexpr float certain_snr = 4;  // above that a pixel is read by itself

// One value a pixel of a tile's row; compilers make of them what registers the processor has.
using Bytes [[gnu::vector_size(size)]] = uint8_t;
using Shorts [[gnu::vector_size(2 * size)]] = int16_t;
using HalfBytes [[gnu::vector_size(size / 2)]] = uint8_t;
using HalfShorts [[gnu::vector_size(size)]] = int16_t;
using HalfCodes [[gnu::vector_size(size)]] = uint16_t;
using Codes [[gnu::vector_size(2 * size)]] = uint16_t;
// Of half of the pixels: wider ones compilers take apart.
using Ints [[gnu::vector_size(2 * size)]] = int32_t;
using Floats [[gnu::vector_size(2 * size)]] = float;

template <class From, class To>
[[gnu::always_inline]] inline void load(const From* from, To* to) {
  std::memcpy(to, from, sizeof(To));
}
[[gnu::always_inline]] inline void load_bytes(const uint8_t* from, Shorts* to) {
  Bytes bytes;
  load(from, &bytes);
  *to = __builtin_convertvector(bytes, Shorts);
}
template <class Vector, class Value>
[[gnu::always_inline]] inline void store(const Vector& from, Value* to) {
  std::memcpy(to, &from, sizeof(Vector));
}
/// Where `mask` is not 0, `from`.
template <class Vector, class Value>
[[gnu::always_inline]] inline void store_where(const Vector& mask, const Vector& from, Value* to) {
  Vector before;
  load(to, &before);
  store((from & mask) | (before & ~mask), to);
}
using WideFloats = std::array<Floats, 2>;
using WideInts = std::array<Ints, 2>;

template <class Half, class Narrow>
[[gnu::always_inline]] inline void widen(const Narrow& from, WideFloats* to) {
  std::array<Half, 2> halves;
  std::memcpy(halves.data(), &from, sizeof(from));
  for (size_t i = 0; i < 2; ++i) (*to)[i] = __builtin_convertvector(__builtin_convertvector(halves[i], Ints), Floats);
}
[[gnu::always_inline]] inline void narrow(const WideInts& from, Shorts* to) {
  std::array<HalfShorts, 2> halves;
  for (size_t i = 0; i < 2; ++i) halves[i] = __builtin_convertvector(from[i], HalfShorts);
  std::memcpy(to, halves.data(), sizeof(*to));
}
[[gnu::always_inline]] inline bool any(const Shorts& mask) {
  std::array<uint64_t, sizeof(Shorts) / sizeof(uint64_t)> words;
  std::memcpy(words.data(), &mask, sizeof(mask));
  uint64_t all = 0;
  for (const uint64_t word : words) all |= word;
  return all != 0;
}

/// All bits' differences in a tile and around it, beside each other: in the images they lie so far apart that the
/// processor's caches keep few of them. Beyond the images their rims go on.
struct TileDifferences {
  static constexpr int margin = widest;
  static constexpr int columns = size + 8;  ///< with both margins, and some to make it vectors of eight
  static constexpr int rows = size + 2 * margin;
  template <class Value, int width>
  using Row = std::array<Value, static_cast<size_t>(width)>;

  /// Of pattern and inverse. Where one of them is missing, of the other from the mean of lit and unlit, doubled.
  using Bit = std::array<Row<int16_t, columns>, static_cast<size_t>(rows)>;
  std::array<Bit, 2 * most_bits + 1> bits;  ///< columns', rows', lit and unlit
  size_t count = 0;
  /// How much the coarse bits' sums of pattern and inverse differ from the reference's: total, and that of the squares.
  std::array<Row<int16_t, size>, static_cast<size_t>(size)> drift;
  std::array<Row<float, size>, static_cast<size_t>(size)> drift2;
};

/// A bit's difference, summed over the window of `radius` around the pixels of a row.
template <int radius>
[[gnu::always_inline]] inline void window_differences(const TileDifferences::Bit& bit, int row, Shorts* out) {
  constexpr int margin = TileDifferences::margin;
  const auto* line = bit.data() + row + margin;
  if (radius == 0) {
    load(line->data() + margin, out);
    return;
  }
  Shorts low{};
  HalfShorts high{};
  for (int v = -radius; v <= radius; ++v) {
    Shorts more_low;
    HalfShorts more_high;
    load(line[v].data(), &more_low);
    load(line[v].data() + size, &more_high);
    low += more_low;
    high += more_high;
  }
  TileDifferences::Row<int16_t, TileDifferences::columns> sums;
  std::memcpy(sums.data(), &low, sizeof(low));
  std::memcpy(sums.data() + size, &high, sizeof(high));
  *out = Shorts{};
  for (int u = -radius; u <= radius; ++u) {
    Shorts shifted;
    load(sums.data() + margin + u, &shifted);
    *out += shifted;
  }
}

/// The differences of a bit around the tile at (x, y).
[[gnu::always_inline]] inline void subtract(const PatternImages& s, const BitImages& reference, const BitImages& bit,
                                            int x, int y, TileDifferences::Bit* to) {
  constexpr int margin = TileDifferences::margin, columns = TileDifferences::columns;
  const bool interior = x >= margin && x - margin + columns <= s.width;
  const PixelView& own = bit.pattern ? bit.pattern : bit.inverse;
  const int16_t sign = bit.pattern ? 1 : -1;
  for (int v = 0; v < TileDifferences::rows; ++v) {
    const int row = std::clamp(y + v - margin, 0, s.height - 1);
    auto& values = (*to)[static_cast<size_t>(v)];
    if (!interior) {
      for (int u = 0; u < columns; ++u) {
        const int column = std::clamp(x + u - margin, 0, s.width - 1);
        values[u] =
            static_cast<int16_t>(bit.complete() ? bit.pattern.at(column, row) - bit.inverse.at(column, row)
                                                : sign * (2 * own.at(column, row) - reference.sum(column, row)));
      }
      continue;
    }
    const auto fill = [&]<class Raw, class Wide>(int first, const Raw&, Wide& wide) __attribute__((always_inline)) {
      const auto get = [&](const PixelView& image, Wide* pixels) __attribute__((always_inline)) {
        Raw bytes;
        load(image.row(row) + x - margin + first, &bytes);
        *pixels = __builtin_convertvector(bytes, Wide);
      };
      Wide lit, unlit;
      if (bit.complete()) {
        get(bit.pattern, &lit);
        get(bit.inverse, &unlit);
        wide = lit - unlit;
      } else {
        get(own, &wide);
        get(reference.pattern, &lit);
        get(reference.inverse, &unlit);
        wide = sign * (wide + wide - lit - unlit);
      }
      store(wide, values.data() + first);
    };
    Shorts low;
    HalfShorts high;
    fill(0, Bytes{}, low);
    fill(size, HalfBytes{}, high);
    constexpr int cache_line = 64;  // the next tiles' pixels: rows lie too far apart for processors to see them coming
    __builtin_prefetch(own.row(row) + x + cache_line);
    if (bit.inverse) __builtin_prefetch(bit.inverse.row(row) + x + cache_line);
  }
}

/// @param coarse  whose stripes are wide, of the bits in the order of TileDifferences
BOOTH_VECTOR_CLONES
void subtract_all(const PatternImages& s, const BitImages& reference, std::span<const uint8_t> coarse, int x, int y,
                  TileDifferences* tile) {
  tile->count = 0;
  for (auto& row : tile->drift) row.fill(0);
  for (auto& row : tile->drift2) row.fill(0);
  const auto sum_of = [&](const BitImages& pair, int row, Shorts* sum) __attribute__((always_inline)) {
    Shorts lit, unlit;
    load_bytes(pair.pattern.row(row) + x, &lit);
    load_bytes(pair.inverse.row(row) + x, &unlit);
    *sum = lit + unlit;
  };
  const auto add = [&](const BitImages& bit) __attribute__((always_inline)) {
    const bool is_coarse = coarse[tile->count] != 0;
    TileDifferences::Bit& to = tile->bits[tile->count++];
    if (bit.missing()) {
      for (auto& row : to) row.fill(0);
      return;
    }
    subtract(s, reference, bit, x, y, &to);
    for (int v = 0; v < size && is_coarse; ++v) {
      const int row = std::min(y + v, s.height - 1);
      Shorts sum, own, drift;
      sum_of(reference, row, &sum);
      sum_of(bit, row, &own);
      own -= sum;
      load(tile->drift[v].data(), &drift);
      store(drift + own, tile->drift[v].data());
      WideFloats wide, drift2;
      widen<HalfShorts>(own, &wide);
      load(tile->drift2[v].data(), &drift2);
      for (size_t i = 0; i < 2; ++i) drift2[i] += wide[i] * wide[i];
      store(drift2, tile->drift2[v].data());
    }
  };
  for (const auto& bits : s.bits)
    for (const BitImages& bit : bits) add(bit);
  if (s.lit_and_unlit.complete()) add(s.lit_and_unlit);
}

/// Reads all bits of the pixels that are chosen, averaged over the window of `radius`.
/// @param contrast  mean strength, summed over the window as the differences are
/// @param chosen    -1 where, else 0
template <int radius>
[[gnu::always_inline]] inline void read_bits(const PatternImages& s, const TileDifferences& tile, int row,
                                             const WideFloats& contrast, const Shorts& chosen, TileRow* out) {
  constexpr float unit = relative_unit, most = 1.25F * unit;  // beyond the contrast there is noise alone
  const WideFloats scale{unit / contrast[0], unit / contrast[1]};
  const TileDifferences::Bit* next = tile.bits.data();
  for (size_t axis = 0; axis < 2; ++axis) {
    const std::vector<BitImages>& bits = s.bits[axis];
    const size_t count = bits.size();
    TileRow::Axis& to = out->axis[axis];
    std::array<TileRow::PerPixel<int16_t>, most_bits> differences;  // from the finest
    const auto relative = [&](const Shorts& d, Shorts* to_units) __attribute__((always_inline)) {
      WideFloats wide;
      widen<HalfShorts>(d, &wide);
      WideInts units;
      for (size_t i = 0; i < 2; ++i) {
        wide[i] *= scale[i];
        wide[i] = wide[i] < most ? wide[i] : Floats{} + most;
        wide[i] = wide[i] > -most ? wide[i] : Floats{} - most;
        units[i] = __builtin_convertvector(wide[i], Ints);
      }
      narrow(units, to_units);
    };
    Codes code{};
    for (size_t bit = count; bit-- > 0;) {
      Shorts d;
      window_differences<radius>(*next++, row, &d);
      const Shorts set = d > 0;
      code = code + code - reinterpret_cast<Codes>(set);
      store(d, differences[bit].data());
      if (bit >= static_cast<size_t>(fine_bits)) continue;
      Shorts in_units;
      relative(d, &in_units);
      store_where(chosen, in_units, to.relative[bit].data());
    }
    for (const int shift : {8, 4, 2, 1}) code ^= code >> shift;  // a Gray bit is the binary bit's change
    store_where(reinterpret_cast<Codes>(chosen), code, to.code.data());
    for (int i = 0; i < size; ++i) {
      if (chosen[i] == 0) continue;
      to.edge[i] = 0;
      constexpr unsigned coarse = 1U << fine_bits;
      const unsigned edge = (code[i] + 2U) & ~(coarse - 1);  // the only one that can be within two pixels
      if (edge == 0 || edge + 1 < code[i]) continue;
      const auto bit = static_cast<size_t>(std::countr_zero(edge));
      if (bit >= count || bits[count - 1 - bit].missing()) continue;
      const bool rises = ((edge ^ edge >> 1) >> bit & 1U) != 0;
      const float found = static_cast<float>(differences[bit][i]) * scale[i / (size / 2)][i % (size / 2)];
      to.edge[i] = static_cast<uint16_t>(edge);
      to.edge_relative[i] = static_cast<int16_t>(std::clamp(rises ? found : -found, -most, most));
    }
  }
}

/// Mean of the coarse bits' absolute differences, each summed over the window of `radius`.
template <int radius>
[[gnu::always_inline]] inline void mean_strength(const TileDifferences& tile, std::span<const uint8_t> coarse,
                                                 float count, int row, WideFloats* mean) {
  constexpr int16_t shift = radius == widest ? 2 : 0;  // to keep sums of a window and all bits within 16 bits
  constexpr int16_t rounding = (1 << shift) / 2;
  Codes strength{};
  for (size_t bit = 0; bit < tile.count; ++bit) {
    if (coarse[bit] == 0) continue;
    Shorts d;
    window_differences<radius>(tile.bits[bit], row, &d);
    const Shorts negative = -d;
    d = ((d > negative ? d : negative) + rounding) >> shift;
    strength += reinterpret_cast<Codes>(d);
  }
  widen<HalfCodes>(strength, mean);
  for (Floats& values : *mean) values *= (1 << shift) / count;
}

/// Averages what is left over the window of `radius` and reads the pixels that this makes sure.
/// @return whether some are left still
template <int radius>
[[gnu::always_inline]] inline bool read_dim(const PatternImages& s, const TileDifferences& tile,
                                            std::span<const uint8_t> coarse, float count, float min_snr, int row,
                                            const WideFloats& variance, Shorts* left, TileRow* out) {
  WideFloats contrast;
  mean_strength<radius>(tile, coarse, count, row, &contrast);
  constexpr float width = 2 * radius + 1, window = width * width;
  WideFloats snr2;
  WideInts enough;
  for (size_t i = 0; i < 2; ++i) {
    snr2[i] = contrast[i] * contrast[i] / (window * window * variance[i]);
    enough[i] = snr2[i] * window >= min_snr * min_snr;
  }
  Shorts chosen;
  narrow(enough, &chosen);
  chosen &= *left;
  if (any(chosen)) {
    for (int i = 0; i < size; ++i)
      if (chosen[i] != 0) out->snr2[i] = snr2[i / (size / 2)][i % (size / 2)];
    Shorts lit;
    load(out->lit.data(), &lit);
    store(lit | chosen, out->lit.data());
    read_bits<radius>(s, tile, row, contrast, chosen, out);
    *left &= ~chosen;
  }
  return any(*left);
}

BOOTH_VECTOR_CLONES
void read_row(const PatternImages& s, const TileDifferences& tile, std::span<const uint8_t> coarse, float min_snr,
              float overall_variance, int row, TileRow* out) {
  const auto coarse_bits = std::count_if(coarse.begin(), coarse.end(), [](uint8_t is) { return is != 0; });
  const float count = static_cast<float>(std::max<std::ptrdiff_t>(coarse_bits, 1));
  // The variance of a bit's difference at a pixel (a difference and a sum of two images have the same noise), steadied
  // by that of the whole image.
  constexpr float overall_weight = 6;  // as many samples
  Shorts drift;
  load(tile.drift[row].data(), &drift);
  WideFloats mean, drift2, contrast, variance, snr2;
  widen<HalfShorts>(drift, &mean);
  load(tile.drift2[row].data(), &drift2);
  mean_strength<0>(tile, coarse, count, row, &contrast);
  WideInts sure;
  for (size_t i = 0; i < 2; ++i) {
    mean[i] /= count;
    const Floats scatter = drift2[i] - mean[i] * mean[i] * count;
    variance[i] = (overall_weight * overall_variance + scatter) / (overall_weight + count - 1);
    snr2[i] = contrast[i] * contrast[i] / variance[i];
    sure[i] = snr2[i] >= certain_snr * certain_snr;
  }
  Shorts certain;
  narrow(sure, &certain);
  store(snr2, out->snr2.data());
  store(certain, out->lit.data());
  if (any(certain)) read_bits<0>(s, tile, row, contrast, certain, out);
  Shorts left = ~certain;
  if (s.lit_and_unlit.complete() && any(left)) {
    // Nothing around the pixel is lit by half of what is asked for.
    constexpr float share = 0.5F, width = 2 * widest + 1;
    Shorts d;
    window_differences<widest>(tile.bits[tile.count - 1], row, &d);
    WideFloats around;
    widen<HalfShorts>(d, &around);
    const float least = share * min_snr / width;
    WideInts hopeful;
    for (size_t i = 0; i < 2; ++i) {
      around[i] /= width * width;
      hopeful[i] = (around[i] > 0) & (around[i] * around[i] >= least * least * variance[i]);
    }
    Shorts kept;
    narrow(hopeful, &kept);
    left &= kept;
  }
  if (any(left) && read_dim<1>(s, tile, coarse, count, min_snr, row, variance, &left, out))
    read_dim<widest>(s, tile, coarse, count, min_snr, row, variance, &left, out);
}

}  // namespace

BitReader::BitReader(const PatternImages& images, double min_snr)
    : s_(images), reference_(images.lit_and_unlit), min_snr_(static_cast<float>(min_snr)) {
  for (const auto& bits : s_.bits)
    for (size_t bit = 0; bit < bits.size(); ++bit) {
      if (!reference_.complete()) reference_ = bits[bit];
      coarse_.push_back(bits[bit].complete() && bit + fine_bits < bits.size() ? 1 : 0);
    }
  if (s_.lit_and_unlit.complete()) coarse_.push_back(1);
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
  for (const auto& bits : s_.bits)
    for (const BitImages& bit : bits)
      if (bit.complete()) pairs.push_back(&bit);
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

std::optional<std::array<double, 2>> BitReader::finest_strength() const {
  std::vector<const BitImages*> coarse;
  if (s_.lit_and_unlit.complete()) coarse.push_back(&s_.lit_and_unlit);  // which most often tells that a pixel is dark
  size_t next = 0;
  for (const auto& bits : s_.bits)
    for (const BitImages& bit : bits)
      if (coarse_[next++] != 0) coarse.push_back(&bit);
  const double least = certain_snr * std::numbers::sqrt2 * noise_;
  std::array<double, 2> sum{};
  size_t count = 0;
  constexpr int stride = 4;
  for (int y = 0; y < s_.height && !coarse.empty(); y += stride)
    for (int x = 0; x < s_.width; x += stride) {
      if (coarse.front()->contrast(x, y) < 0.5 * least) continue;
      int total = 0;
      for (const BitImages* bit : coarse) total += bit->contrast(x, y);
      const double contrast = static_cast<double>(total) / static_cast<double>(coarse.size());
      if (contrast < least) continue;
      ++count;
      for (size_t axis = 0; axis < 2; ++axis)
        if (const BitImages& finest = s_.bits[axis].back(); finest.complete())
          sum[axis] += std::min(finest.contrast(x, y) / contrast, 1.25);
    }
  if (count == 0) return std::nullopt;
  for (double& total : sum) total /= static_cast<double>(count);
  return sum;
}

void BitReader::read(int x, int y, TileRead* read) const {
  TileDifferences tile;
  subtract_all(s_, reference_, coarse_, x, y, &tile);
  const float variance = static_cast<float>(2 * noise_ * noise_);
  for (int row = 0; row < std::min(size, s_.height - y); ++row)
    read_row(s_, tile, coarse_, min_snr_, variance, row, &(*read)[static_cast<size_t>(row)]);
}

}  // namespace booth
