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

/// How far from an outline that is not known better than this, in pixels, colours are taken to be unmixed, and how
/// far they reach: what is seen just inside and outside, as rims shine and contact shadows deepen within a few pixels.
struct Ring {
  float from_px, to_px;
};
/// First from the labels' outline, which follows cells, then from the outline found before.
constexpr std::array<Ring, 2> rings{{{2.0F, 4.5F}, {1.5F, 3.5F}}};
/// Half the width of the band in which coverage is estimated, and how far the outline may leave the labels'.
constexpr float band_px = 3.5F;
/// Contrast |F − B| in linear light at which colours and the outline found before are believed alike.
constexpr float doubtful_contrast = 0.015F;
/// Deviations, as shares of the background's light, that are half way from noise, bounced light and bleeding colours
/// to a surface of its own.
constexpr float strange_lightness = 0.12F;
constexpr float strange_hue = 0.25F;
/// How many standard deviations of noise weigh as much as the light itself.
constexpr float strange_noise = 10;
/// Keeps quotients of two black surfaces near 1.
constexpr float dark = 2e-3F;

std::array<float, 256> linear_light_table() {
  std::array<float, 256> table{};
  for (size_t i = 0; i < table.size(); ++i) {
    const double v = static_cast<double>(i) / 255;
    table[i] = static_cast<float>(v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4));
  }
  return table;
}

/// The pixels near the labels' outline, stored cell by cell.
class Band {
 public:
  Band(const CellGrid& grid, int width, int height, const CellMask& subject, int reach_px)
      : grid_(grid), width_(width), height_(height), slot_of_(grid.count(), -1) {
    const int reach = (reach_px + grid.step - 1) / grid.step;
    for (int y = 0; y < grid.height; ++y) {
      for (int x = 0; x < grid.width; ++x) {
        const uint8_t here = subject[grid.index(x, y)];
        const bool edge = (x + 1 < grid.width && subject[grid.index(x + 1, y)] != here) ||
                          (y + 1 < grid.height && subject[grid.index(x, y + 1)] != here);
        if (!edge) continue;
        for (int v = std::max(0, y - reach); v <= std::min(grid.height - 1, y + 1 + reach); ++v) {
          for (int u = std::max(0, x - reach); u <= std::min(grid.width - 1, x + 1 + reach); ++u) {
            slot_of_[grid.index(u, v)] = 0;
          }
        }
      }
    }
    int32_t slots = 0;
    for (size_t i = 0; i < slot_of_.size(); ++i) {
      if (slot_of_[i] < 0) continue;
      slot_of_[i] = slots++;
      cells_.push_back(i);
    }
    column_.resize(static_cast<size_t>(width));
    for (int x = 0; x < width; ++x) column_[x] = {x / grid.step, x % grid.step};
    row_.resize(static_cast<size_t>(height));
    for (int y = 0; y < height; ++y) row_[y] = {y / grid.step, y % grid.step};
  }

  size_t pixels() const { return cells_.size() * static_cast<size_t>(grid_.step * grid_.step); }
  size_t cell(int x, int y) const { return grid_.index(column_[x].cell, row_[y].cell); }
  /// A pixel's place in arrays over the band, or −1 outside.
  int32_t place(int x, int y) const {
    const int32_t slot = slot_of_[cell(x, y)];
    return slot < 0 ? -1 : (slot * grid_.step + row_[y].rest) * grid_.step + column_[x].rest;
  }

  /// Calls visit(x, y, place, cell) for each pixel, in a fixed order.
  template <class Visit>
  void for_each(const Visit& visit) const {
    for (size_t s = 0; s < cells_.size(); ++s) {
      const int x0 = static_cast<int>(cells_[s] % static_cast<size_t>(grid_.width)) * grid_.step;
      const int y0 = static_cast<int>(cells_[s] / static_cast<size_t>(grid_.width)) * grid_.step;
      for (int v = 0; v < grid_.step && y0 + v < height_; ++v) {
        for (int u = 0; u < grid_.step && x0 + u < width_; ++u) {
          visit(x0 + u, y0 + v, (static_cast<int32_t>(s) * grid_.step + v) * grid_.step + u, cells_[s]);
        }
      }
    }
  }

 private:
  struct Place {
    int cell, rest;
  };
  CellGrid grid_;
  int width_, height_;
  std::vector<int32_t> slot_of_;
  std::vector<size_t> cells_;
  std::vector<Place> column_, row_;
};

/// Where the outline runs between a pixel and its right or lower neighbour, and the colours that meet there.
struct Crossing {
  float x, y;
  Color subject{};     ///< F in linear light
  Color gain{};        ///< factor from the empty booth's linear light to B
  bool known = false;  ///< both sides were seen near by
};

class Matte {
 public:
  Matte(std::span<const Frame> background, const Image& body, const CellGrid& grid, const Residual& residual,
        const CellMask& subject)
      : body_(body),
        residual_(residual),
        subject_(subject),
        linear_(linear_light_table()),
        channels_(body.channels),
        step_(grid.step),
        band_(grid, body.width, body.height, subject, static_cast<int>(std::ceil(band_px)) + grid.step),
        empty_(band_.pixels()),
        alpha_(band_.pixels()),
        distance_(band_.pixels()),
        nearest_(band_.pixels()) {
    const float share = 1.0F / static_cast<float>(background.size());
    band_.for_each([&](int x, int y, int32_t i, size_t cell) {
      for (int c = 0; c < channels_; ++c) {
        float sum = 0;
        for (const Frame& frame : background) sum += linear_[frame.pixels->at(x, y, c)];
        empty_[i][c] = sum * share;
      }
      alpha_[i] = subject_[cell] != 0 ? 1.0F : 0.0F;
    });
  }

  void refine(const Ring& ring) {
    find_crossings();
    measure_distances(ring.to_px);
    for (Crossing& crossing : crossings_) gather(ring, &crossing);
    project();
  }

  Image coverage() const {
    Image out(body_.width, body_.height, 1);
    for (int cell_y = 0; cell_y * step_ < body_.height; ++cell_y) {
      const int y0 = cell_y * step_;
      uint8_t* first = out.pixel(0, y0);
      for (int x = 0; x < body_.width; x += step_) {
        if (subject_[band_.cell(x, y0)] == 0) continue;
        std::fill(first + x, first + std::min(x + step_, body_.width), uint8_t{255});
      }
      for (int y = y0 + 1; y < std::min(y0 + step_, body_.height); ++y) {
        std::copy(first, first + body_.width, out.pixel(0, y));
      }
    }
    band_.for_each([&](int x, int y, int32_t i, size_t) {
      out.at(x, y) = static_cast<uint8_t>(255 * std::clamp(alpha_[i], 0.0F, 1.0F) + 0.5F);
    });
    return out;
  }

 private:
  void find_crossings() {
    crossings_.clear();
    band_.for_each([&](int x, int y, int32_t i, size_t) {
      const bool inside = alpha_[i] >= 0.5F;
      for (const auto& [dx, dy] : {std::pair{1, 0}, std::pair{0, 1}}) {
        if (x + dx >= body_.width || y + dy >= body_.height) continue;
        const int32_t j = band_.place(x + dx, y + dy);
        if (j < 0 || (alpha_[j] >= 0.5F) == inside) continue;
        const float t = (0.5F - alpha_[i]) / (alpha_[j] - alpha_[i]);
        Crossing crossing;
        crossing.x = static_cast<float>(x) + t * static_cast<float>(dx);
        crossing.y = static_cast<float>(y) + t * static_cast<float>(dy);
        crossings_.push_back(crossing);
      }
    });
  }

  /// Signed distances to the nearest crossing, positive inside, for pixels within reach.
  void measure_distances(float reach_px) {
    std::fill(distance_.begin(), distance_.end(), far);
    std::fill(nearest_.begin(), nearest_.end(), -1);
    for (size_t n = 0; n < crossings_.size(); ++n) {
      for_pixels_around(crossings_[n], reach_px, [&](int x, int y, float square) {
        const int32_t i = band_.place(x, y);
        if (i < 0 || square >= distance_[i]) return;
        distance_[i] = square;
        nearest_[i] = static_cast<int32_t>(n);
      });
    }
    for (size_t i = 0; i < distance_.size(); ++i) {
      distance_[i] = std::copysign(std::sqrt(distance_[i]), alpha_[i] - 0.5F);
    }
  }

  /// The mean colours of the rings inside and outside near a crossing.
  void gather(const Ring& ring, Crossing* crossing) const {
    Color inside{}, outside{}, outside_empty{};
    float inside_weight = 0, outside_weight = 0;
    const float reach = ring.to_px + 0.5F;
    for_pixels_around(*crossing, reach, [&](int x, int y, float square) {
      const int32_t i = band_.place(x, y);
      if (i < 0) return;
      const float depth = std::abs(distance_[i]);
      if (depth < ring.from_px - 1) return;
      // Fading in over a pixel keeps something where the subject, or a gap in it, is too thin for the ring.
      const float unmixed = std::min(1.0F, depth - ring.from_px + 1);
      const float weight = unmixed * unmixed * unmixed / (1 + square);
      if (distance_[i] > 0) {
        for (int c = 0; c < channels_; ++c) inside[c] += weight * linear_[body_.at(x, y, c)];
        inside_weight += weight;
      } else {
        for (int c = 0; c < channels_; ++c) {
          outside[c] += weight * linear_[body_.at(x, y, c)];
          outside_empty[c] += weight * empty_[i][c];
        }
        outside_weight += weight;
      }
    });
    crossing->known = inside_weight > 0 && outside_weight > 0;
    if (!crossing->known) return;
    for (int c = 0; c < channels_; ++c) {
      crossing->subject[c] = inside[c] / inside_weight;
      crossing->gain[c] = (outside[c] / outside_weight + dark) / (outside_empty[c] / outside_weight + dark);
    }
  }

  void project() {
    constexpr float doubt = doubtful_contrast * doubtful_contrast;
    band_.for_each([&](int x, int y, int32_t i, size_t) {
      // The outline found before, with the slope that a pixel gives to a sharp edge.
      const float before = std::clamp(distance_[i] + 0.5F, 0.0F, 1.0F);
      if (nearest_[i] < 0 || !crossings_[nearest_[i]].known || std::abs(distance_[i]) > band_px) {
        alpha_[i] = distance_[i] > 0 ? 1.0F : 0.0F;
        return;
      }
      const Crossing& crossing = crossings_[nearest_[i]];
      float along = 0, contrast = 0;
      for (int c = 0; c < channels_; ++c) {
        const float empty = empty_[i][c] * crossing.gain[c];
        const float range = crossing.subject[c] - empty;
        along += (linear_[body_.at(x, y, c)] - empty) * range;
        contrast += range * range;
      }
      const float mixed = std::clamp((along + doubt * before) / (contrast + doubt), 0.0F, 1.0F);
      alpha_[i] = std::max(mixed, strangeness(x, y, i, crossing, mixed));
    });
  }

  /// How sure it is, 0 … 1, that a pixel is neither background nor a mixture with the colour inside: lighter than
  /// both by more than bounced light makes, or of another hue. So are highlights along the rim of skin and hair.
  float strangeness(int x, int y, int32_t i, const Crossing& crossing, float mixed) const {
    Color excess{};
    float lighter = 0, light = 0, noise = 0;
    const size_t cell = band_.cell(x, y);
    for (int c = 0; c < channels_; ++c) {
      const float empty = empty_[i][c] * crossing.gain[c];
      const float expected = empty + mixed * (crossing.subject[c] - empty);
      excess[c] = linear_[body_.at(x, y, c)] - expected;
      lighter += excess[c] / static_cast<float>(channels_);
      light += empty / static_cast<float>(channels_);
      noise = std::max(noise, residual_.variance.values[c][cell]);
    }
    // Noise of lightness as a share of linear light, for a pixel: a cell averages step² of them.
    const float noisy = srgb_exponent * std::sqrt(noise) * static_cast<float>(step_);
    const float unit = light * (1 + strange_noise * noisy) + dark;
    float hue = 0;
    for (int c = 0; c < channels_; ++c) hue = std::max(hue, std::abs(excess[c] - lighter));
    const float strange = std::max(lighter / strange_lightness, hue / strange_hue) / unit;
    return std::clamp(strange - 0.5F, 0.0F, 1.0F);
  }

  template <class Visit>
  void for_pixels_around(const Crossing& crossing, float reach, const Visit& visit) const {
    const int x0 = std::max(0, static_cast<int>(std::ceil(crossing.x - reach)));
    const int x1 = std::min(body_.width - 1, static_cast<int>(std::floor(crossing.x + reach)));
    const int y0 = std::max(0, static_cast<int>(std::ceil(crossing.y - reach)));
    const int y1 = std::min(body_.height - 1, static_cast<int>(std::floor(crossing.y + reach)));
    for (int y = y0; y <= y1; ++y) {
      for (int x = x0; x <= x1; ++x) {
        const float dx = static_cast<float>(x) - crossing.x;
        const float dy = static_cast<float>(y) - crossing.y;
        const float square = dx * dx + dy * dy;
        if (square <= reach * reach) visit(x, y, square);
      }
    }
  }

  static constexpr float far = 1e6F;

  const Image& body_;
  const Residual& residual_;
  const CellMask& subject_;
  std::array<float, 256> linear_;
  int channels_;
  int step_;
  Band band_;
  std::vector<Color> empty_;  ///< the empty booth in linear light
  std::vector<float> alpha_;
  std::vector<float> distance_;
  std::vector<int32_t> nearest_;
  std::vector<Crossing> crossings_;
};

/// Bits of coverage in the band that hang together with nothing: texture of the subject that resembles the
/// background, or noise.
void remove_crumbs(Image& coverage, const CellGrid& grid) {
  // A crumb is smaller than the cells that decided on the labels could have seen.
  const auto crumb = static_cast<size_t>(6 * grid.step * grid.step);
  const auto repaint = [&](uint8_t low, uint8_t high, Connectivity connectivity, uint8_t value) {
    const Components parts =
        connected_components(coverage.samples, coverage.width, coverage.height, low, high, connectivity);
    for (const Components::Run& run : parts.runs) {
      if (parts.areas[run.part] >= crumb) continue;
      std::fill(coverage.pixel(run.begin, run.row), coverage.pixel(run.begin, run.row) + (run.end - run.begin), value);
    }
  };
  repaint(128, 255, Connectivity::eight, 0);
  repaint(0, 127, Connectivity::four, 255);
}

}  // namespace

Image matte(std::span<const Frame> background, const Image& body, const CellGrid& grid, const Residual& residual,
            const CellMask& subject) {
  Matte matte(background, body, grid, residual, subject);
  for (const Ring& ring : rings) matte.refine(ring);
  Image coverage = matte.coverage();
  remove_crumbs(coverage, grid);
  return coverage;
}

}  // namespace booth::segmentation
