#include "pipeline/segmentation/matting.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
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
/// Colours are gathered around the middle of a cell's outline, for pixels that are nearest to any point of it.
constexpr float anchor_slack_px = 1;
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

/// Linear light, 0 … 1, of 8-bit sRGB values.
std::vector<float> linear_light_table() {
  std::vector<float> table(256);
  for (size_t i = 0; i < table.size(); ++i) {
    const double v = static_cast<double>(i) / static_cast<double>(table.size() - 1);
    table[i] = static_cast<float>(v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4));
  }
  return table;
}

/// Pixels that loops along a row take at once: a ring's diameter. Loops of a fixed length are what compilers turn into
/// vector instructions; what lies beyond the ring weighs nothing.
constexpr int lanes = 12;
static_assert(2 * (rings[0].to_px + anchor_slack_px) + 1 <= lanes && rings[1].to_px <= rings[0].to_px);

/// The pixels near the labels' outline. The band's cells are packed cell row by cell row, each as step rows of pixels,
/// so that pixels of one row are neighbours in memory wherever the cells are neighbours.
class Band {
 public:
  struct Row {
    int x, y, count;  ///< pixels (x … x + count − 1, y)
    int32_t place;    ///< of the first
  };

  /// @param reach_px  how far from the labels' outline it reaches at least
  Band(const CellGrid& grid, int width, int height, const CellMask& subject, float reach_px)
      : grid_(grid),
        base_(grid.count(), -1),
        stride_(static_cast<size_t>(grid.height), 0),
        column_(static_cast<size_t>(width)) {
    for (int x = 0; x < width; ++x) column_[x] = {x / grid.step, x % grid.step};
    // The cells beside the outline are a step wide themselves.
    const int reach = std::max(0, static_cast<int>(std::ceil(reach_px / static_cast<float>(grid.step))) - 1);
    const std::vector<uint8_t> near = near_the_outline(subject, reach);
    for (int cell_y = 0; cell_y < grid.height; ++cell_y) {
      const uint8_t* in_band = near.data() + grid.index(0, cell_y);
      int32_t* base = base_.data() + grid.index(0, cell_y);
      const auto first_place = static_cast<int32_t>(pixels_);
      int32_t packed = 0;
      for (int x = 0; x < grid.width; ++x)
        if (in_band[x] != 0) base[x] = first_place + grid.step * packed++;
      stride_[cell_y] = grid.step * packed;
      pixels_ += static_cast<size_t>(stride_[cell_y]) * static_cast<size_t>(grid.step);
      for (int v = 0; v < grid.step && cell_y * grid.step + v < height; ++v) {
        for (int x = 0; x < grid.width;) {
          if (in_band[x] == 0) {
            ++x;
            continue;
          }
          const int begin = x;
          while (x < grid.width && in_band[x] != 0) ++x;
          const int x0 = begin * grid.step;
          rows_.push_back(
              {x0, cell_y * grid.step + v, std::min(x * grid.step, width) - x0, base[begin] + v * stride_[cell_y]});
        }
      }
    }
  }

  /// How long arrays over the band are: room for loops that start in it and take `lanes` pixels.
  size_t size() const { return pixels_ + lanes; }
  const std::vector<Row>& rows() const { return rows_; }
  size_t cell(int x, int y) const { return grid_.index(column_[x].cell, y / grid_.step); }
  /// A pixel's place in arrays over the band, or −1 outside.
  int32_t place(int x, int y) const { return place_in_row(x, y / grid_.step, y % grid_.step); }
  int32_t place_in_row(int x, int cell_y, int v) const {
    const int32_t base = base_[grid_.index(column_[x].cell, cell_y)];
    return base < 0 ? -1 : base + v * stride_[cell_y] + column_[x].rest;
  }

 private:
  /// Cells within `reach` cells of one that differs from its neighbour.
  std::vector<uint8_t> near_the_outline(const CellMask& subject, int reach) const {
    const int width = grid_.width, height = grid_.height;
    std::vector<uint8_t> along(grid_.count(), 0), near(grid_.count(), 0);
    std::vector<uint8_t> edge(static_cast<size_t>(width + 2 * reach));
    for (int y = 0; y < height; ++y) {
      const uint8_t* here = subject.data() + grid_.index(0, y);
      const uint8_t* above = subject.data() + grid_.index(0, std::max(y - 1, 0));
      const uint8_t* below = subject.data() + grid_.index(0, std::min(y + 1, height - 1));
      uint8_t* at = edge.data() + reach;
      for (int x = 0; x < width; ++x) at[x] = static_cast<uint8_t>((here[x] ^ above[x]) | (here[x] ^ below[x]));
      for (int x = 0; x + 1 < width; ++x) {
        const auto differs = static_cast<uint8_t>(here[x] ^ here[x + 1]);
        at[x] |= differs;
        at[x + 1] |= differs;
      }
      uint8_t* out = along.data() + grid_.index(0, y);
      for (int d = -reach; d <= reach; ++d)
        for (int x = 0; x < width; ++x) out[x] |= at[x + d];
    }
    for (int y = 0; y < height; ++y) {
      uint8_t* out = near.data() + grid_.index(0, y);
      for (int v = std::max(0, y - reach); v <= std::min(height - 1, y + reach); ++v) {
        const uint8_t* in = along.data() + grid_.index(0, v);
        for (int x = 0; x < width; ++x) out[x] |= in[x];
      }
    }
    return near;
  }

  struct Column {
    int cell, rest;
  };
  CellGrid grid_;
  size_t pixels_ = 0;
  std::vector<int32_t> base_;    ///< place of a cell's first pixel, or −1
  std::vector<int32_t> stride_;  ///< from a place to the one below in the same cell, by cell row
  std::vector<Column> column_;   ///< by x
  std::vector<Row> rows_;
};

/// Where the outline runs between a pixel and its right or lower neighbour.
struct Crossing {
  float x, y;
  int32_t anchor = 0;  ///< whose colours meet there
};

/// The colours that meet along the outline inside a cell.
struct Anchor {
  float x = 0, y = 0;  ///< the mean of its crossings
  int crossings = 0;
  Color subject{};     ///< F in linear light
  Color gain{};        ///< factor from the empty booth's linear light to B
  bool known = false;  ///< both sides were seen near by
};

class Matte {
 public:
  Matte(const Image& empty_booth, const Image& body, const BackgroundModel& model, const Residual& residual,
        const CellMask& subject)
      : body_(body),
        residual_(residual),
        subject_(subject),
        grid_(model.grid),
        channels_(body.channels),
        band_(grid_, body.width, body.height, subject, band_px + rings[0].to_px),
        alpha_(band_.size()),
        square_(band_.size()),
        distance_(band_.size()),
        nearest_(band_.size()) {
    for (int c = 0; c < channels_; ++c) {
      seen_[c].resize(band_.size());
      empty_[c].resize(band_.size());
    }
    const std::vector<float> light = linear_light_table();
    std::vector<uint8_t> moved;
    for (const Band::Row& row : band_.rows()) {
      moved.resize(static_cast<size_t>(row.count * channels_));
      copy_moved(empty_booth, row, model.offset, moved);
      const uint8_t* in = body.pixel(row.x, row.y);
      for (int c = 0; c < channels_; ++c) {
        float* seen = seen_[c].data() + row.place;
        float* empty = empty_[c].data() + row.place;
        for (int i = 0; i < row.count; ++i) {
          seen[i] = light[in[i * channels_ + c]];
          empty[i] = light[moved[static_cast<size_t>(i * channels_ + c)]];
        }
      }
      float* alpha = alpha_.data() + row.place;
      for (int i = 0; i < row.count; ++i) alpha[i] = subject[band_.cell(row.x + i, row.y)];
    }
  }

  void refine(const Ring& ring) {
    find_crossings();
    measure_distances(ring.to_px);
    for (Anchor& anchor : anchors_) gather(ring, &anchor);
    project();
  }

  Image coverage() const {
    Image out(body_.width, body_.height, 1);
    for (int y = 0; y < body_.height; ++y) {
      const uint8_t* labels = subject_.data() + grid_.index(0, y / grid_.step);
      uint8_t* to = out.pixel(0, y);
      for (int x = 0; x < grid_.width;) {
        if (labels[x] == 0) {
          ++x;
          continue;
        }
        const int begin = x;
        while (x < grid_.width && labels[x] != 0) ++x;
        std::fill(to + begin * grid_.step, to + std::min(x * grid_.step, body_.width), uint8_t{255});
      }
    }
    for (const Band::Row& row : band_.rows()) {
      uint8_t* to = out.pixel(row.x, row.y);
      const float* alpha = alpha_.data() + row.place;
      for (int i = 0; i < row.count; ++i) to[i] = static_cast<uint8_t>(255 * alpha[i] + 0.5F);
    }
    return out;
  }

 private:
  /// The samples that lie under a row of the band when the image is moved by the offset; the border repeats.
  static void copy_moved(const Image& image, const Band::Row& row, const PixelOffset& offset,
                         std::vector<uint8_t>& samples) {
    const int y = std::clamp(row.y - offset.y, 0, image.height - 1);
    const int x = row.x - offset.x;
    if (x >= 0 && x + row.count <= image.width) {
      const uint8_t* in = image.pixel(x, y);
      std::copy(in, in + samples.size(), samples.begin());
      return;
    }
    for (int n = 0; n < row.count; ++n)
      for (int c = 0; c < image.channels; ++c)
        samples[static_cast<size_t>(n * image.channels + c)] = image.at(std::clamp(x + n, 0, image.width - 1), y, c);
  }

  void find_crossings() {
    crossings_.clear();
    for (const Band::Row& row : band_.rows()) {
      const int below = std::min(row.y + 1, body_.height - 1);
      const int cell_below = below / grid_.step, v_below = below % grid_.step;
      for (int n = 0; n < row.count; ++n) {
        const int x = row.x + n;
        const int32_t i = row.place + n;
        const bool inside = alpha_[i] >= 0.5F;
        const auto add_crossing_to = [&](int32_t j, float dx, float dy) {
          if (j < 0 || (alpha_[j] >= 0.5F) == inside) return;
          const float t = (0.5F - alpha_[i]) / (alpha_[j] - alpha_[i]);
          crossings_.push_back({static_cast<float>(x) + t * dx, static_cast<float>(row.y) + t * dy});
        };
        if (n + 1 < row.count) add_crossing_to(i + 1, 1, 0);
        if (below > row.y) add_crossing_to(band_.place_in_row(x, cell_below, v_below), 0, 1);
      }
    }
    anchors_.clear();
    std::vector<int32_t> anchor_of(grid_.count(), -1);
    for (Crossing& crossing : crossings_) {
      int32_t& number = anchor_of[band_.cell(static_cast<int>(crossing.x), static_cast<int>(crossing.y))];
      if (number < 0) {
        number = static_cast<int32_t>(anchors_.size());
        anchors_.emplace_back();
      }
      crossing.anchor = number;
      Anchor& anchor = anchors_[number];
      anchor.x += crossing.x;
      anchor.y += crossing.y;
      ++anchor.crossings;
    }
    for (Anchor& anchor : anchors_) {
      anchor.x /= static_cast<float>(anchor.crossings);
      anchor.y /= static_cast<float>(anchor.crossings);
    }
  }

  /// Signed distances to the nearest crossing, positive inside, for pixels within reach.
  void measure_distances(float reach_px) {
    std::fill(square_.begin(), square_.end(), reach_px * reach_px);
    std::fill(nearest_.begin(), nearest_.end(), -1);
    for (size_t n = 0; n < crossings_.size(); ++n) {
      const Crossing& crossing = crossings_[n];
      const auto number = static_cast<int32_t>(n);
      for_rows_around(crossing.x, crossing.y, reach_px, [&](int32_t place, float dx0, float dy, int count) {
        float* square = square_.data() + place;
        int32_t* nearest = nearest_.data() + place;
        const auto take_nearer = [&](int i) {
          const float dx = dx0 + static_cast<float>(i);
          const float here = dx * dx + dy * dy;
          const bool nearer = here < square[i];
          nearest[i] = nearer ? number : nearest[i];
          square[i] = nearer ? here : square[i];
        };
        if (count == lanes) {
          for (int i = 0; i < lanes; ++i) take_nearer(i);
        } else {
          for (int i = 0; i < count; ++i) take_nearer(i);
        }
      });
    }
    for (size_t i = 0; i < distance_.size(); ++i) {
      const float depth = nearest_[i] < 0 ? far : std::sqrt(square_[i]);
      distance_[i] = alpha_[i] >= 0.5F ? depth : -depth;
    }
  }

  /// The mean colours of the rings inside and outside near an anchor.
  void gather(const Ring& ring, Anchor* anchor) const {
    using Lanes = std::array<float, lanes>;
    Lanes inside_weight{}, outside_weight{};
    std::array<Lanes, 3> inside{}, outside{}, outside_empty{};
    const float reach = ring.to_px + anchor_slack_px;
    for_rows_around(anchor->x, anchor->y, reach, [&](int32_t place, float dx0, float dy, int count) {
      const float* distance = distance_.data() + place;
      Lanes in, out;
      for (int i = 0; i < lanes; ++i) {
        const float dx = dx0 + static_cast<float>(i);
        const float square = dx * dx + dy * dy;
        // Fading in over a pixel keeps something where the subject, or a gap in it, is too thin for the ring.
        const float unmixed = std::min(1.0F, std::max(0.0F, std::abs(distance[i]) - ring.from_px + 1));
        const float weight = square <= reach * reach && i < count ? unmixed * unmixed * unmixed / (1 + square) : 0.0F;
        in[i] = distance[i] > 0 ? weight : 0.0F;
        out[i] = distance[i] > 0 ? 0.0F : weight;
      }
      for (int i = 0; i < lanes; ++i) inside_weight[i] += in[i];
      for (int i = 0; i < lanes; ++i) outside_weight[i] += out[i];
      for (int c = 0; c < channels_; ++c) {
        const float* seen = seen_[c].data() + place;
        const float* empty = empty_[c].data() + place;
        for (int i = 0; i < lanes; ++i) inside[c][i] += in[i] * seen[i];
        for (int i = 0; i < lanes; ++i) outside[c][i] += out[i] * seen[i];
        for (int i = 0; i < lanes; ++i) outside_empty[c][i] += out[i] * empty[i];
      }
    });
    const auto sum = [](const Lanes& values) { return std::accumulate(values.begin(), values.end(), 0.0F); };
    const float all_inside = sum(inside_weight), all_outside = sum(outside_weight);
    anchor->known = all_inside > 0 && all_outside > 0;
    if (!anchor->known) return;
    for (int c = 0; c < channels_; ++c) {
      anchor->subject[c] = sum(inside[c]) / all_inside;
      anchor->gain[c] = (sum(outside[c]) / all_outside + dark) / (sum(outside_empty[c]) / all_outside + dark);
    }
  }

  void project() {
    constexpr float doubt = doubtful_contrast * doubtful_contrast;
    for (const Band::Row& row : band_.rows()) {
      for (int n = 0; n < row.count; ++n) {
        const int32_t i = row.place + n;
        // Beyond the band the crossing found before decides, within it where its colours are not known.
        const bool known = nearest_[i] >= 0 && std::abs(distance_[i]) <= band_px;
        const Anchor* anchor = known ? &anchors_[crossings_[nearest_[i]].anchor] : nullptr;
        if (anchor == nullptr || !anchor->known) {
          alpha_[i] = distance_[i] > 0 ? 1.0F : 0.0F;
          continue;
        }
        // The outline found before, with the slope that a pixel gives to a sharp edge.
        const float before = std::clamp(distance_[i] + 0.5F, 0.0F, 1.0F);
        float along = 0, contrast = 0;
        for (int c = 0; c < channels_; ++c) {
          const float empty = empty_[c][i] * anchor->gain[c];
          const float range = anchor->subject[c] - empty;
          along += (seen_[c][i] - empty) * range;
          contrast += range * range;
        }
        const float mixed = std::clamp((along + doubt * before) / (contrast + doubt), 0.0F, 1.0F);
        alpha_[i] = mixed < 1 ? std::max(mixed, strangeness(row.x + n, row.y, i, *anchor, mixed)) : mixed;
      }
    }
  }

  /// How sure it is, 0 … 1, that a pixel is neither background nor a mixture with the colour inside: lighter than
  /// both by more than bounced light makes, or of another hue. So are highlights along the rim of skin and hair.
  float strangeness(int x, int y, int32_t i, const Anchor& anchor, float mixed) const {
    Color excess{};
    float lighter = 0, light = 0, noise = 0;
    const size_t cell = band_.cell(x, y);
    for (int c = 0; c < channels_; ++c) {
      const float empty = empty_[c][i] * anchor.gain[c];
      const float expected = empty + mixed * (anchor.subject[c] - empty);
      excess[c] = seen_[c][i] - expected;
      lighter += excess[c] / static_cast<float>(channels_);
      light += empty / static_cast<float>(channels_);
      noise = std::max(noise, residual_.variance.values[c][cell]);
    }
    float hue = 0;
    for (int c = 0; c < channels_; ++c) hue = std::max(hue, std::abs(excess[c] - lighter));
    const float strange = std::max(lighter / strange_lightness, hue / strange_hue);
    if (strange <= 0.5F * (light + dark)) return 0;
    // Noise of lightness as a share of linear light, for a pixel: a cell averages step² of them.
    const float noisy = srgb_exponent * std::sqrt(noise) * static_cast<float>(grid_.step);
    const float unit = light * (1 + strange_noise * noisy) + dark;
    return std::clamp(strange / unit - 0.5F, 0.0F, 1.0F);
  }

  /// Calls visit(place, dx, dy, count) for the pixels within reach, and some more of their square: those from `place`
  /// on lie at dx, dx + 1, … beside the point and dy below it. With a count of `lanes` that many may be touched;
  /// beyond the band or the reach they have no meaning.
  template <class Visit>
  void for_rows_around(float x, float y, float reach, const Visit& visit) const {
    const int x0 = std::max(0, static_cast<int>(std::ceil(x - reach)));
    const int x1 = std::min(body_.width - 1, static_cast<int>(std::floor(x + reach)));
    const int y0 = std::max(0, static_cast<int>(std::ceil(y - reach)));
    const int y1 = std::min(body_.height - 1, static_cast<int>(std::floor(y + reach)));
    for (int v = y0; v <= y1; ++v) {
      const float dy = static_cast<float>(v) - y;
      const int32_t first = band_.place(x0, v);
      if (first >= 0 && band_.place(x1, v) == first + x1 - x0) {
        visit(first, static_cast<float>(x0) - x, dy, x1 == body_.width - 1 ? x1 - x0 + 1 : lanes);
        continue;
      }
      for (int u = x0; u <= x1; ++u) {
        const int32_t place = band_.place(u, v);
        if (place >= 0) visit(place, static_cast<float>(u) - x, dy, 1);
      }
    }
  }

  static constexpr float far = 1e6F;

  const Image& body_;
  const Residual& residual_;
  const CellMask& subject_;
  const CellGrid& grid_;
  int channels_;
  Band band_;
  std::array<std::vector<float>, 3> seen_, empty_;  ///< by channel, the body frame and the empty booth, linear light
  std::vector<float> alpha_;
  std::vector<float> square_;    ///< of the distance, cut off at the ring
  std::vector<float> distance_;  ///< signed
  std::vector<int32_t> nearest_;
  std::vector<Crossing> crossings_;
  std::vector<Anchor> anchors_;
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

Image matte(const Image& empty_booth, const Image& body, const BackgroundModel& model, const Residual& residual,
            const CellMask& subject) {
  Matte matte(empty_booth, body, model, residual, subject);
  for (const Ring& ring : rings) matte.refine(ring);
  Image coverage = matte.coverage();
  remove_crumbs(coverage, model.grid);
  return coverage;
}

}  // namespace booth::segmentation
