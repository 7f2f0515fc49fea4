#include "pipeline/segmentation/background_model.h"

#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>

#include "pipeline/segmentation/smoothing.h"

namespace booth::segmentation {
namespace {

/// Cells the grid should have about: fine enough for fingers, coarse enough to be quick.
constexpr double target_cells = 120000;
/// Beyond this many pixels a cell would swallow fingers, however large the sensor is.
constexpr int max_step = 4;

/// Sums over the pixels of each cell of one cell row; pixels beyond the image repeat its last ones.
class CellRow {
 public:
  CellRow(const CellGrid& grid, int channels)
      : grid_(grid),
        channels_(static_cast<size_t>(channels)),
        columns_(static_cast<size_t>(grid.width * grid.step) * channels_),
        windows_(columns_.size()) {
    for (size_t c = 0; c < channels_; ++c) sums_[c].resize(static_cast<size_t>(grid.width));
  }

  /// @param offset  how far the image has moved: it is read that much to the left of and above the grid
  void add_up(const Image& image, int cell_y, const PixelOffset& offset) {
    const int first = std::clamp(offset.x, 0, image.width - 1);  // column of the grid's pixels that the image has
    const int skipped = std::clamp(-offset.x, 0, image.width - 1);
    const int count = std::min(image.width - skipped, grid_.width * grid_.step - first);
    const size_t begin = static_cast<size_t>(first) * channels_;
    const size_t end = begin + static_cast<size_t>(count) * channels_;
    for (int dy = 0; dy < grid_.step; ++dy) {
      const uint8_t* row = image.pixel(skipped, std::clamp(cell_y * grid_.step + dy - offset.y, 0, image.height - 1));
      uint16_t* columns = columns_.data() + begin;
      if (dy == 0) std::copy(row, row + (end - begin), columns);
      if (dy > 0) add(row, end - begin, columns);
    }
    for (size_t i = end; i < columns_.size(); ++i) columns_[i] = columns_[i - channels_];
    for (size_t i = begin; i-- > 0;) columns_[i] = columns_[i + channels_];
    // The sum of every step neighbouring pixels, though a step-th of them would do: this way it runs in vectors.
    const auto step = static_cast<size_t>(grid_.step);
    std::copy(columns_.begin(), columns_.end(), windows_.begin());
    for (size_t n = 1; n < step; ++n)
      add(columns_.data() + n * channels_, columns_.size() - n * channels_, windows_.data());
    for (size_t c = 0; c < channels_; ++c)
      for (size_t x = 0; x < sums_[c].size(); ++x) sums_[c][x] = windows_[x * step * channels_ + c];
  }

  /// By cell of the row.
  const std::vector<uint16_t>& sums(size_t channel) const { return sums_[channel]; }

 private:
  template <class Value>
  static void add(const Value* in, size_t count, uint16_t* out) {
    for (size_t i = 0; i < count; ++i) out[i] = static_cast<uint16_t>(out[i] + in[i]);
  }

  CellGrid grid_;
  size_t channels_;
  std::vector<uint16_t> columns_, windows_;
  std::array<std::vector<uint16_t>, 3> sums_;
};
static_assert(max_step * max_step * 255 <= std::numeric_limits<uint16_t>::max());

CellPlanes make_planes(int channels, size_t count, float fill = 0) {
  CellPlanes planes;
  planes.channels = channels;
  for (int c = 0; c < channels; ++c) planes.values[c].assign(count, fill);
  return planes;
}

/// log(sum / weight + srgb_offset) for every sum that a cell can have.
std::vector<float> lightness_table(size_t weight) {
  std::vector<float> table(weight * 255 + 1);
  for (size_t i = 0; i < table.size(); ++i) {
    table[i] = std::log(static_cast<float>(i) / static_cast<float>(weight) + srgb_offset);
  }
  return table;
}

// ---- drift ----------------------------------------------------------------------------------------------------

/// Differences are sought for drift within ± this: a factor of 10 in linear light.
constexpr float drift_range = 1.0F;
constexpr int drift_bins = 400;
/// Light and gain seldom change more than this between two captures of a session; it settles ties between the
/// background and a large uniform shirt.
constexpr float expected_drift = 0.15F;
/// How far a background cell's difference may lie from the common drift: slow variation over the image, darker or
/// lighter by shadow and bounced light, and in chromaticity.
constexpr std::array<float, 3> drift_slack{0.08F, 0.08F, 0.06F};  // one refinement after the other
constexpr float drift_chroma_slack = 0.025F;
/// Every so many cells, along both axes, are asked about the drift.
constexpr int drift_stride = 2;
/// Cells along the edge of a block that gets one estimate of the drift.
constexpr int drift_block = 16;
/// Over how many blocks the drift is smoothed: shadows are to stay visible as such.
constexpr float drift_smoothing_blocks = 4.0F;
/// What a cell that disagrees weighs beside one that agrees.
constexpr float drift_inertia = 0.01F;

/// The most common value, sought in a histogram and refined by the mean around it.
float most_common(const std::vector<float>& values) {
  std::array<float, drift_bins> histogram{};
  constexpr float bin = 2 * drift_range / drift_bins;
  for (const float v : values) {
    const int i = static_cast<int>((v + drift_range) / bin);
    if (v > -drift_range && i < drift_bins) histogram[i] += 1;
  }
  int best = drift_bins / 2;
  float best_count = 0;
  for (int i = 2; i + 2 < drift_bins; ++i) {
    const float count =
        histogram[i - 2] + 2 * histogram[i - 1] + 3 * histogram[i] + 2 * histogram[i + 1] + histogram[i + 2];
    const float at = (static_cast<float>(i) + 0.5F) * bin - drift_range;
    const float weighted = count * std::exp(-0.5F * at * at / (expected_drift * expected_drift));
    if (weighted > best_count) {
      best_count = weighted;
      best = i;
    }
  }
  const float mode = (static_cast<float>(best) + 0.5F) * bin - drift_range;
  double sum = 0;
  size_t count = 0;
  for (const float v : values) {
    if (std::abs(v - mode) > 3 * bin) continue;
    sum += v;
    ++count;
  }
  return count > 0 ? static_cast<float>(sum / static_cast<double>(count)) : 0;
}

/// The drift that most of the image shares. Brightness may vary over the image and then peaks where it likes, so that
/// the channels need not peak in the same place; white balance hardly varies and is sought in their differences.
std::array<float, 3> common_drift(const CellPlanes& difference, const CellGrid& grid) {
  std::vector<float> lightness, red_green, blue_green;
  for (int y = 0; y < grid.height; y += drift_stride) {
    for (int x = 0; x < grid.width; x += drift_stride) {
      const size_t cell = grid.index(x, y);
      const float first = difference.values[0][cell];
      if (difference.channels == 1) {
        lightness.push_back(first);
        continue;
      }
      const float green = difference.values[1][cell];
      const float blue = difference.values[2][cell];
      lightness.push_back((first + green + blue) / 3);
      red_green.push_back(first - green);
      blue_green.push_back(blue - green);
    }
  }
  if (difference.channels == 1) return {most_common(lightness), 0, 0};
  const float red_shift = most_common(red_green);
  const float blue_shift = most_common(blue_green);
  const float green = most_common(lightness) - (red_shift + blue_shift) / 3;
  return {green + red_shift, green, green + blue_shift};
}

/// A drift that varies slowly over the image: known at the centres of blocks, linear in between.
class Drift {
 public:
  Drift(const CellGrid& grid, int channels, const std::array<float, 3>& everywhere)
      : grid_(grid),
        nx_((grid.width + drift_block - 1) / drift_block),
        ny_((grid.height + drift_block - 1) / drift_block),
        blocks_(make_planes(channels, static_cast<size_t>(nx_) * static_cast<size_t>(ny_))) {
    for (int c = 0; c < channels; ++c) std::fill(blocks_.values[c].begin(), blocks_.values[c].end(), everywhere[c]);
  }

  /// Of the cells of a row.
  void row(int channel, int y, std::vector<float>& cells) const {
    // Half a block at either end repeats the first or last value: one more block there makes all alike.
    std::vector<float> ends(static_cast<size_t>(nx_) + 2);
    constexpr int half = drift_block / 2;
    const int upper = std::clamp((y + half) / drift_block - 1, 0, ny_ - 1);
    const int lower = std::min((y + half) / drift_block, ny_ - 1);
    const float down = (static_cast<float>((y + half) % drift_block) + 0.5F) / drift_block;
    const float* a = blocks_.values[channel].data() + static_cast<size_t>(upper) * static_cast<size_t>(nx_);
    const float* b = blocks_.values[channel].data() + static_cast<size_t>(lower) * static_cast<size_t>(nx_);
    for (int x = 0; x < nx_; ++x) ends[x + 1] = a[x] + down * (b[x] - a[x]);
    ends.front() = ends[1];
    ends.back() = ends[nx_];
    cells.resize(static_cast<size_t>(grid_.width));
    for (int n = 0; n <= nx_; ++n) {
      const float slope = (ends[n + 1] - ends[n]) / drift_block;
      const float start = ends[n] + 0.5F * slope;
      const int first = n * drift_block - half;
      const int end = std::min(first + drift_block, grid_.width);
      for (int x = std::max(first, 0); x < end; ++x) cells[x] = start + slope * static_cast<float>(x - first);
    }
  }

  /// Replaces the drift by the mean difference, block by block and smoothed over the image, of the cells that agree
  /// with it. Where few agree, the neighbourhood's drift carries over.
  /// @return share of the cells that agreed
  double refine(const CellPlanes& difference, float slack) {
    const int channels = difference.channels;
    CellPlanes sums = make_planes(channels, blocks_.values[0].size());
    std::vector<float> weight(blocks_.values[0].size(), 0);
    std::array<std::vector<float>, 3> expected;
    size_t agreeing = 0;
    size_t asked = 0;
    for (int y = 0; y < grid_.height; y += drift_stride) {
      for (int c = 0; c < channels; ++c) row(c, y, expected[c]);
      for (int x = 0; x < grid_.width; x += drift_stride, ++asked) {
        const size_t cell = grid_.index(x, y);
        const size_t block =
            static_cast<size_t>(y / drift_block) * static_cast<size_t>(nx_) + static_cast<size_t>(x / drift_block);
        std::array<float, 3> deviation{};
        for (int c = 0; c < channels; ++c) deviation[c] = difference.values[c][cell] - expected[c][x];
        const bool agrees = can_be_drift(deviation, channels, slack);
        // A trace of the drift found before keeps the quotient defined where no block of the neighbourhood agrees.
        const float share = agrees ? 1.0F : drift_inertia;
        for (int c = 0; c < channels; ++c)
          sums.values[c][block] += share * (expected[c][x] + (agrees ? deviation[c] : 0.0F));
        weight[block] += share;
        agreeing += agrees;
      }
    }
    gaussian_blur(weight, nx_, ny_, drift_smoothing_blocks);
    for (int c = 0; c < channels; ++c) {
      gaussian_blur(sums.values[c], nx_, ny_, drift_smoothing_blocks);
      for (size_t i = 0; i < weight.size(); ++i) blocks_.values[c][i] = sums.values[c][i] / weight[i];
    }
    return static_cast<double>(agreeing) / static_cast<double>(asked);
  }

 private:
  /// Whether a cell that deviates so much from the drift expected there can be background.
  static bool can_be_drift(const std::array<float, 3>& deviation, int channels, float slack) {
    for (int c = 0; c < channels; ++c)
      if (std::abs(deviation[c]) > slack) return false;
    return channels == 1 || (std::abs(deviation[0] - deviation[1]) < drift_chroma_slack &&
                             std::abs(deviation[2] - deviation[1]) < drift_chroma_slack);
  }

  CellGrid grid_;
  int nx_, ny_;  ///< blocks
  CellPlanes blocks_;
};

// ---- movement -------------------------------------------------------------------------------------------------

/// Steps of lightness from cell to cell below this tell nothing about a movement.
constexpr float telling_gradient = 0.02F;
/// Cells that the movement explains to within this decide on it, round by round: all that the subject does not stand
/// before at first, as no movement is known yet.
constexpr std::array<float, 6> movement_slack{0.4F, 0.3F, 0.2F, 0.1F, 0.06F, 0.06F};
/// Fewer telling cells than this share of the image are too few, as are such whose edges all run one way.
constexpr double fewest_telling = 0.002;
constexpr double least_condition = 0.02;

/// How far, in cells, the image has moved: the shift that explains most of the difference at the background's edges,
/// by Gauss–Newton on a robust sum of squares. Nothing where the background has too few edges to tell.
std::array<float, 2> find_movement(const CellPlanes& lightness, const CellPlanes& difference, const CellGrid& grid) {
  struct Telling {
    float gx, gy, d;
  };
  std::vector<Telling> cells;
  const int channels = lightness.channels;
  for (int y = 1; y + 1 < grid.height; y += 2) {
    for (int x = 1; x + 1 < grid.width; ++x) {
      const size_t i = grid.index(x, y);
      Telling cell{0, 0, 0};
      for (int c = 0; c < channels; ++c) {
        const float* v = lightness.values[c].data() + i;
        cell.gx += v[1] - v[-1];
        cell.gy += v[grid.width] - v[-grid.width];
        cell.d += difference.values[c][i];
      }
      const float scale = 1 / static_cast<float>(channels);
      cell = {0.5F * scale * cell.gx, 0.5F * scale * cell.gy, scale * cell.d};
      if (std::abs(cell.gx) + std::abs(cell.gy) > telling_gradient) cells.push_back(cell);
    }
  }
  std::array<float, 2> shift{0, 0};
  if (static_cast<double>(cells.size()) < fewest_telling * static_cast<double>(grid.count())) return shift;
  for (const float slack : movement_slack) {
    double xx = 0, xy = 0, yy = 0, xd = 0, yd = 0;
    for (const Telling& cell : cells) {
      const float left = cell.d + cell.gx * shift[0] + cell.gy * shift[1];
      // Geman and McClure's weight: who stands before the background has next to no say.
      const float ratio = left / slack;
      const double weight = 1 / ((1 + ratio * ratio) * (1 + ratio * ratio));
      xx += weight * cell.gx * cell.gx;
      xy += weight * cell.gx * cell.gy;
      yy += weight * cell.gy * cell.gy;
      xd += weight * cell.gx * cell.d;
      yd += weight * cell.gy * cell.d;
    }
    const double determinant = xx * yy - xy * xy;
    if (determinant < least_condition * (xx + yy) * (xx + yy) / 4) return {0, 0};
    shift = {static_cast<float>((xy * yd - yy * xd) / determinant),
             static_cast<float>((xy * xd - xx * yd) / determinant)};
  }
  return shift;
}

// ---- noise ----------------------------------------------------------------------------------------------------

constexpr int noise_block = 8;
constexpr int noise_bins = 16;
/// A bin with fewer blocks says nothing.
constexpr size_t min_blocks = 12;
/// The share of quiet blocks that is taken for background even when the subject fills most of the image.
constexpr double quiet_share = 0.3;
/// Standard deviation in levels of the least noise that eight bits can show after averaging.
constexpr float least_noise = 0.35F;
/// How far, in pixels, the image may have moved between the captures beyond what nobody notices.
constexpr float vibration_px = 0.15F;

/// Noise variance in level² at 16 brightnesses, of one channel. Blocks of 8 × 8 cells compare what they scatter
/// about their own mean; the quieter ones of a brightness are the background's.
std::array<float, noise_bins> noise_curve(const std::vector<float>& difference, const std::vector<float>& level,
                                          const CellGrid& grid) {
  std::array<std::vector<float>, noise_bins> variances;
  const auto width = static_cast<size_t>(grid.width);
  std::vector<float> sums(width), squares(width), levels(width);  // over the rows of a block, by column
  for (int y0 = 0; y0 + noise_block <= grid.height; y0 += noise_block) {
    for (std::vector<float>* columns : {&sums, &squares, &levels}) std::fill(columns->begin(), columns->end(), 0.0F);
    for (int y = y0; y < y0 + noise_block; ++y) {
      const float* d = difference.data() + grid.index(0, y);
      const float* l = level.data() + grid.index(0, y);
      for (size_t x = 0; x < width; ++x) {
        sums[x] += d[x];
        squares[x] += d[x] * d[x];
        levels[x] += l[x];
      }
    }
    for (size_t x0 = 0; x0 + noise_block <= width; x0 += noise_block) {
      const auto block_sum = [x0](const std::vector<float>& columns) {
        return std::accumulate(columns.begin() + static_cast<long>(x0),
                               columns.begin() + static_cast<long>(x0 + noise_block), 0.0F);
      };
      constexpr float n = noise_block * noise_block;
      const float sum = block_sum(sums), mean_level = block_sum(levels) / n;
      const float scale = mean_level + srgb_offset;
      const float variance = std::max(0.0F, block_sum(squares) - sum * sum / n) / (n - 1) * scale * scale;
      variances[static_cast<size_t>(std::clamp(mean_level / 256 * noise_bins, 0.0F, noise_bins - 1.0F))].push_back(
          variance);
    }
  }
  std::array<float, noise_bins> curve{};
  std::array<bool, noise_bins> known{};
  for (int b = 0; b < noise_bins; ++b) {
    std::vector<float>& v = variances[b];
    if (v.size() < min_blocks) continue;
    const auto quantile = v.begin() + static_cast<long>(quiet_share * static_cast<double>(v.size()));
    std::nth_element(v.begin(), quantile, v.end());
    curve[b] = *quantile;
    known[b] = true;
  }
  for (int b = 0; b < noise_bins; ++b) {
    if (known[b]) continue;
    for (int reach = 1; reach < noise_bins; ++reach) {
      const bool below = b - reach >= 0 && known[b - reach];
      const bool above = b + reach < noise_bins && known[b + reach];
      if (!below && !above) continue;
      curve[b] = std::max(below ? curve[b - reach] : 0.0F, above ? curve[b + reach] : 0.0F);
      break;
    }
  }
  for (float& v : curve) v = std::max(v, least_noise * least_noise);
  return curve;
}

/// Takes from the difference what a movement by a fraction of a cell makes at the background's edges.
void undo_movement(const std::vector<float>& lightness, const CellGrid& grid, float x_cells, float y_cells,
                   std::vector<float>& difference) {
  for (int y = 1; y + 1 < grid.height; ++y) {
    const float* v = lightness.data() + grid.index(0, y);
    float* d = difference.data() + grid.index(0, y);
    for (int x = 1; x + 1 < grid.width; ++x)
      d[x] += 0.5F * (x_cells * (v[x + 1] - v[x - 1]) + y_cells * (v[x + grid.width] - v[x - grid.width]));
  }
}

/// Of each cell of a row, the larger of the steps to the left and right, and up and down, squared and added.
void squared_gradients(const std::vector<float>& values, const CellGrid& grid, int y, std::vector<float>& out) {
  const float* here = values.data() + grid.index(0, y);
  const float* above = values.data() + grid.index(0, std::max(y - 1, 0));
  const float* below = values.data() + grid.index(0, std::min(y + 1, grid.height - 1));
  const auto square = [](float v) { return v * v; };
  out.resize(static_cast<size_t>(grid.width));
  for (int x = 0; x < grid.width; ++x) out[x] = std::max(square(above[x] - here[x]), square(below[x] - here[x]));
  const int last = grid.width - 1;
  for (int x = 1; x < last; ++x) out[x] += std::max(square(here[x - 1] - here[x]), square(here[x + 1] - here[x]));
  if (last > 0) {
    out[0] += square(here[1] - here[0]);
    out[last] += square(here[last - 1] - here[last]);
  }
}

}  // namespace

CellGrid make_grid(int image_width, int image_height) {
  const double pixels = static_cast<double>(image_width) * image_height;
  CellGrid grid;
  grid.step = std::clamp(static_cast<int>(std::lround(std::sqrt(pixels / target_cells))), 1, max_step);
  grid.width = (image_width + grid.step - 1) / grid.step;
  grid.height = (image_height + grid.step - 1) / grid.step;
  return grid;
}

CellFrame average_cells(const Image& image, const CellGrid& grid, const PixelOffset& offset) {
  const size_t weight = static_cast<size_t>(grid.step) * static_cast<size_t>(grid.step);
  const std::vector<float> table = lightness_table(weight);
  const float per_sum = 1.0F / static_cast<float>(weight);
  CellFrame frame;
  frame.lightness = make_planes(image.channels, grid.count());
  frame.level = make_planes(image.channels, grid.count());
  CellRow row(grid, image.channels);
  for (int y = 0; y < grid.height; ++y) {
    row.add_up(image, y, offset);
    for (int c = 0; c < image.channels; ++c) {
      const std::vector<uint16_t>& sums = row.sums(static_cast<size_t>(c));
      float* lightness = frame.lightness.values[c].data() + grid.index(0, y);
      float* level = frame.level.values[c].data() + grid.index(0, y);
      for (size_t x = 0; x < sums.size(); ++x) lightness[x] = table[sums[x]];
      for (size_t x = 0; x < sums.size(); ++x) level[x] = static_cast<float>(sums[x]) * per_sum;
    }
  }
  return frame;
}

EmptyView learn_view(std::span<const Frame> frames) {
  const Image& first = *frames[0].pixels;
  EmptyView view{frames[0].camera, first, {}};
  if (frames.size() == 1) return view;

  const auto count = static_cast<uint32_t>(frames.size());
  std::vector<uint16_t> total(static_cast<size_t>(first.width) * static_cast<size_t>(first.channels));
  for (int y = 0; y < first.height; ++y) {
    std::fill(total.begin(), total.end(), uint16_t{0});
    for (const Frame& frame : frames) {
      const uint8_t* row = frame.pixels->pixel(0, y);
      for (size_t i = 0; i < total.size(); ++i) total[i] = static_cast<uint16_t>(total[i] + row[i]);
    }
    uint8_t* mean = view.mean.pixel(0, y);
    for (size_t i = 0; i < total.size(); ++i) mean[i] = static_cast<uint8_t>((total[i] + count / 2) / count);
  }

  const CellGrid grid = make_grid(first.width, first.height);
  view.flicker.assign(grid.count(), 0);
  const auto n = static_cast<float>(count);
  const float per_cell = 1.0F / static_cast<float>(grid.step * grid.step);
  const float spread_scale = per_cell * per_cell / (n - 1) / static_cast<float>(first.channels);
  std::vector<CellRow> rows(frames.size(), CellRow(grid, first.channels));
  std::vector<float> shift(static_cast<size_t>(grid.width)), squares(shift.size());
  for (int y = 0; y < grid.height; ++y) {
    for (size_t f = 0; f < frames.size(); ++f) rows[f].add_up(*frames[f].pixels, y, {});
    float* flicker = view.flicker.data() + grid.index(0, y);
    for (int c = 0; c < first.channels; ++c) {
      // Differences to the first frame are small, so that little is lost in the variance's difference of squares.
      const std::vector<uint16_t>& reference = rows[0].sums(static_cast<size_t>(c));
      std::fill(shift.begin(), shift.end(), 0.0F);
      std::fill(squares.begin(), squares.end(), 0.0F);
      for (size_t f = 1; f < frames.size(); ++f) {
        const std::vector<uint16_t>& sums = rows[f].sums(static_cast<size_t>(c));
        for (size_t x = 0; x < shift.size(); ++x) {
          const auto difference = static_cast<float>(int{sums[x]} - int{reference[x]});
          shift[x] += difference;
          squares[x] += difference * difference;
        }
      }
      for (size_t x = 0; x < shift.size(); ++x)
        flicker[x] += std::max(0.0F, squares[x] - shift[x] * shift[x] / n) * spread_scale;
    }
  }
  box_mean_3x3(view.flicker, grid.width, grid.height);
  return view;
}

BackgroundModel model_background(const EmptyView& empty, const PixelOffset& offset) {
  BackgroundModel model;
  model.grid = make_grid(empty.mean.width, empty.mean.height);
  model.offset = offset;
  CellFrame cells = average_cells(empty.mean, model.grid, offset);
  model.lightness = std::move(cells.lightness);
  model.level = std::move(cells.level);
  if (empty.flicker.size() != model.grid.count()) return model;
  const auto whole_cells = [&](int px) {
    return static_cast<int>(std::lround(static_cast<double>(px) / model.grid.step));
  };
  const int dx = whole_cells(offset.x), dy = whole_cells(offset.y);
  model.flicker.resize(model.grid.count());
  for (int y = 0; y < model.grid.height; ++y)
    for (int x = 0; x < model.grid.width; ++x)
      model.flicker[model.grid.index(x, y)] = empty.flicker[model.grid.index(
          std::clamp(x - dx, 0, model.grid.width - 1), std::clamp(y - dy, 0, model.grid.height - 1))];
  return model;
}

Residual compare(const BackgroundModel& background, const CellFrame& body) {
  const CellGrid& grid = background.grid;
  const int channels = background.lightness.channels;
  Residual residual;
  residual.difference = make_planes(channels, grid.count());
  residual.variance = make_planes(channels, grid.count());
  for (int c = 0; c < channels; ++c) {
    const std::vector<float>& empty = background.lightness.values[c];
    const std::vector<float>& seen = body.lightness.values[c];
    std::vector<float>& difference = residual.difference.values[c];
    for (size_t i = 0; i < difference.size(); ++i) difference[i] = seen[i] - empty[i];
  }
  residual.mean_drift = common_drift(residual.difference, grid);
  Drift drift(grid, channels, residual.mean_drift);
  for (const float slack : drift_slack) residual.drift_support = drift.refine(residual.difference, slack);
  std::vector<float> drift_row, gradients;
  for (int c = 0; c < channels; ++c) {
    for (int y = 0; y < grid.height; ++y) {
      drift.row(c, y, drift_row);
      float* difference = residual.difference.values[c].data() + grid.index(0, y);
      for (int x = 0; x < grid.width; ++x) difference[x] -= drift_row[x];
    }
  }
  const auto [left_x, left_y] = find_movement(background.lightness, residual.difference, grid);
  const auto step = static_cast<float>(grid.step);
  residual.movement_px = {static_cast<float>(background.offset.x) + step * left_x,
                          static_cast<float>(background.offset.y) + step * left_y};
  for (int c = 0; c < channels; ++c) {
    std::vector<float>& difference = residual.difference.values[c];
    undo_movement(background.lightness.values[c], grid, left_x, left_y, difference);

    const std::vector<float>& level = background.level.values[c];
    const auto curve = noise_curve(difference, level, grid);
    const float shift = vibration_px / static_cast<float>(grid.step);
    // The scatter of the curve holds the body frame's noise and that of the background's mean; between the
    // background's frames there is only their own, so it adds what is special about a cell.
    for (int y = 0; y < grid.height; ++y) {
      squared_gradients(background.lightness.values[c], grid, y, gradients);
      const size_t row = grid.index(0, y);
      const float* expected = level.data() + row;
      const float* seen = body.level.values[c].data() + row;
      float* variance = residual.variance.values[c].data() + row;
      for (int x = 0; x < grid.width; ++x)
        variance[x] = curve[static_cast<size_t>(static_cast<int>(expected[x] * (noise_bins / 256.0F)))];
      if (!background.flicker.empty()) {
        const float* flicker = background.flicker.data() + row;
        for (int x = 0; x < grid.width; ++x) variance[x] = std::max(variance[x], flicker[x]);
      }
      for (int x = 0; x < grid.width; ++x) {
        const float scale = std::min(expected[x], seen[x]) + srgb_offset;
        variance[x] = variance[x] / (scale * scale) + shift * shift * gradients[x];
      }
    }
  }
  return residual;
}

}  // namespace booth::segmentation
