#include "pipeline/segmentation/matting.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "pipeline/segmentation/components.h"

namespace booth::segmentation {
namespace {

using Color = std::array<float, 3>;  // linear light; grey uses the first only

/// Lens blur, demosaicing and a label that is off by a pixel reach about this far from the outline: closer in,
/// colours are mixed.
constexpr float mixed_px = 2.5F;
/// Half the width of the band in which coverage is estimated.
constexpr float band_px = 4.0F;
/// From how far colours are gathered.
constexpr float gather_px = 8.0F;
/// Contrast |F − B| in linear light at which colours and the labels' outline are believed alike.
constexpr float doubtful_contrast = 0.015F;

std::array<float, 256> linear_light_table() {
  std::array<float, 256> table{};
  for (size_t i = 0; i < table.size(); ++i) {
    const double v = static_cast<double>(i) / 255;
    table[i] = static_cast<float>(v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4));
  }
  return table;
}

/// Cells' distances to the boundary between the two labels, in cells: 0.5 for those that touch it. Chamfer
/// distance with weights 1 and √2 in two sweeps.
std::vector<float> boundary_distance(const CellMask& subject, const CellGrid& grid) {
  constexpr float far = 1e6F;
  constexpr float root2 = 1.41421356F;
  std::vector<float> distance(grid.count(), far);
  for (int y = 0; y < grid.height; ++y) {
    for (int x = 0; x < grid.width; ++x) {
      const size_t i = grid.index(x, y);
      if (x + 1 < grid.width && subject[i] != subject[i + 1]) distance[i] = distance[i + 1] = 0.5F;
      if (y + 1 < grid.height) {
        const size_t below = grid.index(x, y + 1);
        if (subject[i] != subject[below]) distance[i] = distance[below] = 0.5F;
      }
    }
  }
  const auto lower = [&](size_t i, int x, int y, float step) {
    if (grid.contains(x, y)) distance[i] = std::min(distance[i], distance[grid.index(x, y)] + step);
  };
  for (int y = 0; y < grid.height; ++y) {
    for (int x = 0; x < grid.width; ++x) {
      const size_t i = grid.index(x, y);
      lower(i, x - 1, y, 1);
      lower(i, x - 1, y - 1, root2);
      lower(i, x, y - 1, 1);
      lower(i, x + 1, y - 1, root2);
    }
  }
  for (int y = grid.height - 1; y >= 0; --y) {
    for (int x = grid.width - 1; x >= 0; --x) {
      const size_t i = grid.index(x, y);
      lower(i, x + 1, y, 1);
      lower(i, x + 1, y + 1, root2);
      lower(i, x, y + 1, 1);
      lower(i, x - 1, y + 1, root2);
    }
  }
  return distance;
}

/// What is seen just inside and just outside the outline near a cell.
struct LocalColors {
  Color subject{};    ///< linear light
  Color shadow{};     ///< lightness by which the background differs from the drifted model
  float outline = 0;  ///< the labels' own coverage, smoothed
};

class Gatherer {
 public:
  Gatherer(const CellGrid& grid, const Residual& residual, const CellMask& subject, const std::vector<float>& distance)
      : grid_(grid), residual_(residual), subject_(subject), distance_(distance) {
    const auto step = static_cast<float>(grid.step);
    reach_ = std::max(3, static_cast<int>(std::lround(gather_px / step)));
    clear_ = std::max(1.5F, mixed_px / step);
    const float sigma = static_cast<float>(reach_) / 2;
    for (int dy = -reach_; dy <= reach_; ++dy) {
      for (int dx = -reach_; dx <= reach_; ++dx) {
        near_.push_back(std::exp(-0.5F * static_cast<float>(dx * dx + dy * dy) / (sigma * sigma)));
      }
    }
  }

  LocalColors operator()(int x, int y) const {
    const int channels = residual_.difference.channels;
    // In thin parts no cell is far from the outline: the deeper a cell lies, up to clear of mixing, the more it counts.
    Color inside{}, outside{};
    float inside_weight = 0, outside_weight = 0;
    size_t n = 0;
    for (int dy = -reach_; dy <= reach_; ++dy) {
      for (int dx = -reach_; dx <= reach_; ++dx, ++n) {
        if (!grid_.contains(x + dx, y + dy)) continue;
        const size_t i = grid_.index(x + dx, y + dy);
        const float depth = std::min(distance_[i] / clear_, 1.0F);
        const float depth2 = depth * depth;
        const float weight = near_[n] * depth2 * depth2 * depth2;
        if (subject_[i] != 0) {
          for (int c = 0; c < channels; ++c) inside[c] += weight * residual_.body.values[c][i];
          inside_weight += weight;
        } else {
          for (int c = 0; c < channels; ++c) outside[c] += weight * residual_.difference.values[c][i];
          outside_weight += weight;
        }
      }
    }
    LocalColors colors;
    static const float white = std::log(255.0F + srgb_offset);
    for (int c = 0; c < channels; ++c) {
      colors.subject[c] = inside_weight > 0 ? std::exp(srgb_exponent * (inside[c] / inside_weight - white)) : 0;
      colors.shadow[c] = outside_weight > 0 ? outside[c] / outside_weight : 0;
    }
    float covered = 0, total = 0;
    for (int dy = -1; dy <= 1; ++dy) {
      for (int dx = -1; dx <= 1; ++dx) {
        if (!grid_.contains(x + dx, y + dy)) continue;
        const float weight = static_cast<float>((2 - dx * dx) * (2 - dy * dy));
        covered += weight * static_cast<float>(subject_[grid_.index(x + dx, y + dy)]);
        total += weight;
      }
    }
    colors.outline = covered / total;
    return colors;
  }

 private:
  const CellGrid& grid_;
  const Residual& residual_;
  const CellMask& subject_;
  const std::vector<float>& distance_;
  int reach_ = 0;
  float clear_ = 0;
  std::vector<float> near_;
};

/// Bits of coverage in the band that hang together with nothing: texture of the subject that resembles the
/// background, or noise.
void remove_crumbs(Image& coverage, const CellGrid& grid) {
  // A crumb is smaller than the cells that decided on the labels could have seen.
  const size_t crumb = static_cast<size_t>(6 * grid.step * grid.step);
  std::vector<uint8_t> mask(coverage.samples.size());
  for (size_t i = 0; i < mask.size(); ++i) mask[i] = coverage.samples[i] >= 128;
  const Components parts = connected_components(mask, coverage.width, coverage.height, 1, Connectivity::eight);
  const Components gaps = connected_components(mask, coverage.width, coverage.height, 0, Connectivity::four);
  for (size_t i = 0; i < mask.size(); ++i) {
    if (parts.label[i] >= 0 && parts.areas[parts.label[i]] < crumb) coverage.samples[i] = 0;
    if (gaps.label[i] >= 0 && gaps.areas[gaps.label[i]] < crumb) coverage.samples[i] = 255;
  }
}

}  // namespace

Image matte(std::span<const Frame> background, const Image& body, const CellGrid& grid, const Residual& residual,
            const CellMask& subject) {
  static const std::array<float, 256> linear = linear_light_table();
  const std::vector<float> distance = boundary_distance(subject, grid);
  const Gatherer gather(grid, residual, subject, distance);
  const float band = std::max(1.5F, band_px / static_cast<float>(grid.step));
  const int channels = body.channels;
  const float frames = static_cast<float>(background.size());

  Image coverage(body.width, body.height, 1);
  for (int cell_y = 0; cell_y < grid.height; ++cell_y) {
    const int y_end = std::min((cell_y + 1) * grid.step, body.height);
    for (int cell_x = 0; cell_x < grid.width; ++cell_x) {
      const size_t cell = grid.index(cell_x, cell_y);
      const int x_end = std::min((cell_x + 1) * grid.step, body.width);
      if (distance[cell] > band) {
        if (subject[cell] == 0) continue;
        for (int y = cell_y * grid.step; y < y_end; ++y) {
          std::fill(coverage.pixel(cell_x * grid.step, y), coverage.pixel(0, y) + x_end, uint8_t{255});
        }
        continue;
      }
      const LocalColors colors = gather(cell_x, cell_y);
      Color gain{};
      for (int c = 0; c < channels; ++c) {
        gain[c] = std::exp(srgb_exponent * (residual.drift.values[c][cell] + colors.shadow[c]));
      }
      for (int y = cell_y * grid.step; y < y_end; ++y) {
        for (int x = cell_x * grid.step; x < x_end; ++x) {
          float along = 0, contrast = 0;
          for (int c = 0; c < channels; ++c) {
            float empty = 0;
            for (const Frame& frame : background) empty += linear[frame.pixels->at(x, y, c)];
            empty *= gain[c] / frames;
            const float range = colors.subject[c] - empty;
            along += (linear[body.at(x, y, c)] - empty) * range;
            contrast += range * range;
          }
          constexpr float doubt = doubtful_contrast * doubtful_contrast;
          const float alpha = (along + doubt * colors.outline) / (contrast + doubt);
          coverage.at(x, y) = static_cast<uint8_t>(std::lround(255 * std::clamp(alpha, 0.0F, 1.0F)));
        }
      }
    }
  }
  remove_crumbs(coverage, grid);
  return coverage;
}

}  // namespace booth::segmentation
