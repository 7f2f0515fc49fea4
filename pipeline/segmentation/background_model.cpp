#include "pipeline/segmentation/background_model.h"

#include <cmath>
#include <cstdint>

#include "pipeline/segmentation/smoothing.h"

namespace booth::segmentation {
namespace {

/// Cells the grid should have about: fine enough for fingers, coarse enough to be quick.
constexpr double target_cells = 400000;
/// Beyond this many pixels a cell would swallow fingers, however large the sensor is.
constexpr int max_step = 4;

template <int channels, int step>
void add_columns(const std::vector<uint16_t>& columns, int cells, std::vector<uint32_t>& cell_sums) {
  for (int x = 0; x < cells; ++x) {
    for (int c = 0; c < channels; ++c) {
      uint32_t sum = 0;
      for (int dx = 0; dx < step; ++dx) sum += columns[static_cast<size_t>((x * step + dx) * channels + c)];
      cell_sums[static_cast<size_t>(x * channels + c)] = sum;
    }
  }
}

/// Sums over the pixels of each cell of one cell row, channel by channel interleaved; pixels beyond the image
/// repeat its last ones.
void sum_cell_row(const Image& image, const CellGrid& grid, int cell_y, std::vector<uint16_t>& columns,
                  std::vector<uint32_t>& cell_sums) {
  const auto channels = static_cast<size_t>(image.channels);
  const size_t row_samples = static_cast<size_t>(image.width) * channels;
  const size_t padded_samples = static_cast<size_t>(grid.width * grid.step) * channels;
  columns.assign(padded_samples, 0);
  for (int dy = 0; dy < grid.step; ++dy) {
    const uint8_t* row = image.pixel(0, std::min(cell_y * grid.step + dy, image.height - 1));
    for (size_t i = 0; i < row_samples; ++i) columns[i] = static_cast<uint16_t>(columns[i] + row[i]);
  }
  for (size_t i = row_samples; i < padded_samples; ++i) columns[i] = columns[i - channels];
  static_assert(max_step == 4);
  using Add = void (*)(const std::vector<uint16_t>&, int, std::vector<uint32_t>&);
  constexpr std::array<Add, max_step> grey{add_columns<1, 1>, add_columns<1, 2>, add_columns<1, 3>, add_columns<1, 4>};
  constexpr std::array<Add, max_step> color{add_columns<3, 1>, add_columns<3, 2>, add_columns<3, 3>, add_columns<3, 4>};
  (channels == 1 ? grey : color)[static_cast<size_t>(grid.step - 1)](columns, grid.width, cell_sums);
}

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

/// Whether a cell's difference can be the drift expected there, give or take the slack.
bool agrees_with(const CellPlanes& difference, const CellPlanes& drift, size_t cell, float slack) {
  std::array<float, 3> deviation{};
  for (int c = 0; c < difference.channels; ++c) {
    deviation[c] = difference.values[c][cell] - drift.values[c][cell];
    if (std::abs(deviation[c]) > slack) return false;
  }
  if (difference.channels == 1) return true;
  return std::abs(deviation[0] - deviation[1]) < drift_chroma_slack &&
         std::abs(deviation[2] - deviation[1]) < drift_chroma_slack;
}

/// Block values at every cell of every row_stride-th row, linear between the blocks' centres.
void expand_blocks(const std::vector<float>& blocks, int nx, int ny, const CellGrid& grid, int row_stride,
                   std::vector<float>& out) {
  // Half a block at either end repeats the first or last value: one more block there makes all alike.
  std::vector<float> row(static_cast<size_t>(nx) + 2);
  constexpr int half = drift_block / 2;
  for (int y = 0; y < grid.height; y += row_stride) {
    const int upper = std::clamp((y + half) / drift_block - 1, 0, ny - 1);
    const int lower = std::min((y + half) / drift_block, ny - 1);
    const float down = (static_cast<float>((y + half) % drift_block) + 0.5F) / drift_block;
    const float* a = blocks.data() + static_cast<size_t>(upper) * static_cast<size_t>(nx);
    const float* b = blocks.data() + static_cast<size_t>(lower) * static_cast<size_t>(nx);
    for (int x = 0; x < nx; ++x) row[x + 1] = a[x] + down * (b[x] - a[x]);
    row.front() = row[1];
    row.back() = row[nx];
    float* cells = out.data() + grid.index(0, y);
    for (int n = 0; n <= nx; ++n) {
      const float slope = (row[n + 1] - row[n]) / drift_block;
      const float start = row[n] + 0.5F * slope;
      const int first = n * drift_block - half;
      const int end = std::min(first + drift_block, grid.width);
      for (int x = std::max(first, 0); x < end; ++x) cells[x] = start + slope * static_cast<float>(x - first);
    }
  }
}

/// Replaces a drift by the mean difference, block by block and smoothed over the image, of the cells that agree with
/// it. Where few agree, the neighbourhood's drift carries over.
/// @param row_stride  the new drift is written to every so many rows
/// @return share of the cells that agreed
double refine_drift(const CellPlanes& difference, const CellGrid& grid, float slack, int row_stride,
                    CellPlanes& drift) {
  const int nx = (grid.width + drift_block - 1) / drift_block;
  const int ny = (grid.height + drift_block - 1) / drift_block;
  const size_t blocks = static_cast<size_t>(nx) * static_cast<size_t>(ny);
  CellPlanes sums = make_planes(difference.channels, blocks);
  std::vector<float> weight(blocks, 0);
  size_t agreeing = 0;
  size_t asked = 0;
  for (int y = 0; y < grid.height; y += drift_stride) {
    for (int x = 0; x < grid.width; x += drift_stride, ++asked) {
      const size_t cell = grid.index(x, y);
      const size_t block =
          static_cast<size_t>(y / drift_block) * static_cast<size_t>(nx) + static_cast<size_t>(x / drift_block);
      const bool agrees = agrees_with(difference, drift, cell, slack);
      // A trace of the drift found before keeps the quotient defined where no block of the neighbourhood agrees.
      const float share = agrees ? 1.0F : drift_inertia;
      const CellPlanes& source = agrees ? difference : drift;
      for (int c = 0; c < difference.channels; ++c) sums.values[c][block] += share * source.values[c][cell];
      weight[block] += share;
      agreeing += agrees;
    }
  }
  gaussian_blur(weight, nx, ny, drift_smoothing_blocks);
  for (int c = 0; c < difference.channels; ++c) {
    gaussian_blur(sums.values[c], nx, ny, drift_smoothing_blocks);
    for (size_t i = 0; i < blocks; ++i) sums.values[c][i] /= weight[i];
    expand_blocks(sums.values[c], nx, ny, grid, row_stride, drift.values[c]);
  }
  return static_cast<double>(agreeing) / static_cast<double>(asked);
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
  for (int y0 = 0; y0 + noise_block <= grid.height; y0 += noise_block) {
    for (int x0 = 0; x0 + noise_block <= grid.width; x0 += noise_block) {
      float sum = 0, squares = 0, levels = 0;
      for (int y = y0; y < y0 + noise_block; ++y) {
        for (int x = x0; x < x0 + noise_block; ++x) {
          const size_t i = grid.index(x, y);
          sum += difference[i];
          squares += difference[i] * difference[i];
          levels += level[i];
        }
      }
      constexpr float n = noise_block * noise_block;
      const float scale = levels / n + srgb_offset;
      const float variance = std::max(0.0F, squares - sum * sum / n) / (n - 1) * scale * scale;
      variances[static_cast<size_t>(std::clamp(levels / n / 256 * noise_bins, 0.0F, noise_bins - 1.0F))].push_back(
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

CellFrame average_cells(const Image& image, const CellGrid& grid) {
  const size_t weight = static_cast<size_t>(grid.step) * static_cast<size_t>(grid.step);
  const std::vector<float> table = lightness_table(weight);
  CellFrame frame;
  frame.lightness = make_planes(image.channels, grid.count());
  frame.level = make_planes(image.channels, grid.count());
  std::vector<uint16_t> columns;
  std::vector<uint32_t> cells(static_cast<size_t>(grid.width) * static_cast<size_t>(image.channels));
  for (int y = 0; y < grid.height; ++y) {
    sum_cell_row(image, grid, y, columns, cells);
    for (int c = 0; c < image.channels; ++c) {
      float* lightness = frame.lightness.values[c].data() + grid.index(0, y);
      float* level = frame.level.values[c].data() + grid.index(0, y);
      for (int x = 0; x < grid.width; ++x) {
        const uint32_t sum = cells[static_cast<size_t>(x * image.channels + c)];
        lightness[x] = table[sum];
        level[x] = static_cast<float>(sum) / static_cast<float>(weight);
      }
    }
  }
  return frame;
}

BackgroundModel learn_background(std::span<const Frame> frames) {
  const Image& first = *frames[0].pixels;
  BackgroundModel model;
  model.grid = make_grid(first.width, first.height);
  model.frames = static_cast<int>(frames.size());
  if (frames.size() == 1) {
    CellFrame only = average_cells(first, model.grid);
    model.lightness = std::move(only.lightness);
    model.level = std::move(only.level);
    return model;
  }
  const CellGrid& grid = model.grid;
  const int channels = first.channels;
  const size_t cell_pixels = static_cast<size_t>(grid.step) * static_cast<size_t>(grid.step);
  const std::vector<float> table = lightness_table(cell_pixels * frames.size());
  model.lightness = make_planes(channels, grid.count());
  model.level = make_planes(channels, grid.count());
  model.flicker.assign(grid.count(), 0);
  const size_t row_values = static_cast<size_t>(grid.width) * static_cast<size_t>(channels);
  std::vector<uint16_t> columns;
  std::vector<uint32_t> cells(row_values), total(row_values);
  std::vector<float> squares(row_values);
  const auto n = static_cast<float>(frames.size());
  const float per_cell = 1.0F / static_cast<float>(cell_pixels);
  for (int y = 0; y < grid.height; ++y) {
    std::fill(total.begin(), total.end(), 0U);
    std::fill(squares.begin(), squares.end(), 0.0F);
    for (const Frame& frame : frames) {
      sum_cell_row(*frame.pixels, grid, y, columns, cells);
      for (size_t i = 0; i < row_values; ++i) {
        total[i] += cells[i];
        const float v = static_cast<float>(cells[i]) * per_cell;
        squares[i] += v * v;
      }
    }
    float* flicker = model.flicker.data() + grid.index(0, y);
    for (int c = 0; c < channels; ++c) {
      float* lightness = model.lightness.values[c].data() + grid.index(0, y);
      float* level = model.level.values[c].data() + grid.index(0, y);
      for (int x = 0; x < grid.width; ++x) {
        const size_t i = static_cast<size_t>(x * channels + c);
        lightness[x] = table[total[i]];
        level[x] = static_cast<float>(total[i]) * per_cell / n;
        flicker[x] += std::max(0.0F, squares[i] - n * level[x] * level[x]) / (n - 1) / static_cast<float>(channels);
      }
    }
  }
  box_mean_3x3(model.flicker, grid.width, grid.height);
  return model;
}

Residual compare(const BackgroundModel& background, const CellFrame& body) {
  const CellGrid& grid = background.grid;
  const int channels = background.lightness.channels;
  Residual residual;
  residual.body = body.lightness;
  residual.difference = make_planes(channels, grid.count());
  residual.variance = make_planes(channels, grid.count());
  for (int c = 0; c < channels; ++c) {
    const std::vector<float>& empty = background.lightness.values[c];
    const std::vector<float>& seen = body.lightness.values[c];
    std::vector<float>& difference = residual.difference.values[c];
    for (size_t i = 0; i < difference.size(); ++i) difference[i] = seen[i] - empty[i];
  }
  residual.mean_drift = common_drift(residual.difference, grid);
  residual.drift = make_planes(channels, grid.count());
  for (int c = 0; c < channels; ++c)
    std::fill_n(residual.drift.values[c].begin(), grid.count(), residual.mean_drift[c]);
  std::vector<float> gradients;
  for (size_t n = 0; n < drift_slack.size(); ++n) {
    // In between, the drift is needed only where it is asked about.
    const int row_stride = n + 1 < drift_slack.size() ? drift_stride : 1;
    residual.drift_support = refine_drift(residual.difference, grid, drift_slack[n], row_stride, residual.drift);
  }
  for (int c = 0; c < channels; ++c) {
    std::vector<float>& difference = residual.difference.values[c];
    for (size_t i = 0; i < difference.size(); ++i) difference[i] -= residual.drift.values[c][i];

    const std::vector<float>& level = background.level.values[c];
    const auto curve = noise_curve(difference, level, grid);
    const float shift = vibration_px / static_cast<float>(grid.step);
    // The scatter of the curve holds the body frame's noise and that of the background's mean; between the
    // background's frames there is only their own, so it adds what is special about a cell.
    for (int y = 0; y < grid.height; ++y) {
      squared_gradients(background.lightness.values[c], grid, y, gradients);
      const size_t row = grid.index(0, y);
      const float* seen = body.level.values[c].data() + row;
      float* variance = residual.variance.values[c].data() + row;
      for (int x = 0; x < grid.width; ++x) {
        const float expected = level[row + x];
        float noise = curve[static_cast<size_t>(expected * (noise_bins / 256.0F))];
        if (!background.flicker.empty()) noise = std::max(noise, background.flicker[row + x]);
        const float scale = std::min(expected, seen[x]) + srgb_offset;
        variance[x] = noise / (scale * scale) + shift * shift * gradients[x];
      }
    }
  }
  return residual;
}

}  // namespace booth::segmentation
