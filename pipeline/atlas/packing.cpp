#include "pipeline/atlas/packing.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>
#include <numeric>
#include <optional>

namespace booth {
namespace {

/// Charts are placed on a lattice of blocks of this many texels a side: coarser packs faster, finer packs tighter.
constexpr int block_texels = 2;

using Corners = std::array<Eigen::Vector2d, 3>;

/// Which blocks a chart covers, row by row as runs of neighbouring blocks.
struct Run {
  int row, begin, end;
  int length() const { return end - begin; }
};
struct Footprint {
  int width = 0, height = 0;  ///< blocks
  std::vector<Run> runs;      ///< longest first: the least likely to fit is tried first
};

/// A chart with y downwards, turned so that its bounding box is the smallest, its lowest corner at the origin;
/// metres × density.
struct Piece {
  std::vector<Corners> corners;
  Eigen::Vector2d extent = Eigen::Vector2d::Zero();
  double area = 0;
};

Piece turned_to_smallest_box(const Chart& chart, double density) {
  constexpr int steps = 45;  // of a quarter turn
  double best_area = std::numeric_limits<double>::infinity();
  Eigen::Matrix2d best = Eigen::Matrix2d::Identity();
  Eigen::Vector2d best_low = Eigen::Vector2d::Zero(), best_extent = best_low;
  for (int step = 0; step < steps; ++step) {
    const Eigen::Matrix2d turn =
        Eigen::Rotation2Dd(0.5 * std::numbers::pi * step / steps) * Eigen::Vector2d(1, -1).asDiagonal();
    Eigen::Vector2d low = Eigen::Vector2d::Constant(std::numeric_limits<double>::infinity()), high = -low;
    for (const Corners& triangle : chart.corners)
      for (const Eigen::Vector2d& p : triangle) {
        const Eigen::Vector2d q = turn * p;
        low = low.cwiseMin(q);
        high = high.cwiseMax(q);
      }
    if (const double area = (high - low).prod(); area < best_area) {
      best_area = area;
      best = turn;
      best_low = low;
      best_extent = high - low;
    }
  }
  Piece piece;
  piece.extent = density * best_extent;
  for (const Corners& triangle : chart.corners) {
    Corners& placed = piece.corners.emplace_back();
    for (size_t k = 0; k < 3; ++k) placed[k] = density * (best * triangle[k] - best_low);
    const Eigen::Vector2d ab = placed[1] - placed[0], ac = placed[2] - placed[0];
    piece.area += 0.5 * std::abs(ab.x() * ac.y() - ab.y() * ac.x());
  }
  return piece;
}

/// How far a piece's lowest corner lies inside its footprint.
double margin_texels(int gutter_texels) { return 0.5 * gutter_texels; }

/// The blocks that touch the piece grown by half a gutter.
Footprint footprint_of(const Piece& piece, double texels_per_m, int gutter_texels) {
  const double margin = margin_texels(gutter_texels);
  const auto blocks = [&](double extent_m) {
    return static_cast<int>(std::ceil((extent_m * texels_per_m + 2 * margin) / block_texels));
  };
  Footprint footprint;
  footprint.width = blocks(piece.extent.x());
  footprint.height = blocks(piece.extent.y());
  std::vector<uint8_t> covered(static_cast<size_t>(footprint.width) * static_cast<size_t>(footprint.height), 0);
  for (const Corners& triangle : piece.corners) {
    Corners p;
    for (size_t k = 0; k < 3; ++k)
      p[k] = (texels_per_m * triangle[k] + Eigen::Vector2d::Constant(margin)) / block_texels;
    const double grow = margin / block_texels;
    const Eigen::Array2d low = p[0].cwiseMin(p[1]).cwiseMin(p[2]).array() - grow;
    const Eigen::Array2d high = p[0].cwiseMax(p[1]).cwiseMax(p[2]).array() + grow;
    // A block touches the grown triangle where its centre is within reach of all three edges.
    std::array<Eigen::Vector3d, 3> edges;
    for (size_t k = 0; k < 3; ++k) {
      const Eigen::Vector2d edge = p[(k + 1) % 3] - p[k];
      const double length = std::max(edge.norm(), 1e-12);
      const Eigen::Vector2d n(-edge.y() / length, edge.x() / length);  // outwards: with y down corners run clockwise
      edges[k] = {n.x(), n.y(), n.dot(p[k]) + grow + 0.5 * (std::abs(n.x()) + std::abs(n.y()))};
    }
    const int x0 = std::max(0, static_cast<int>(low.x())),
              x1 = std::min(footprint.width, static_cast<int>(high.x()) + 1);
    const int y0 = std::max(0, static_cast<int>(low.y())),
              y1 = std::min(footprint.height, static_cast<int>(high.y()) + 1);
    for (int y = y0; y < y1; ++y)
      for (int x = x0; x < x1; ++x) {
        const double cx = x + 0.5, cy = y + 0.5;
        bool touches = true;
        for (const Eigen::Vector3d& e : edges) touches = touches && e.x() * cx + e.y() * cy <= e.z();
        if (touches)
          covered[static_cast<size_t>(y) * static_cast<size_t>(footprint.width) + static_cast<size_t>(x)] = 1;
      }
  }
  for (int y = 0; y < footprint.height; ++y) {
    const uint8_t* row = covered.data() + static_cast<size_t>(y) * static_cast<size_t>(footprint.width);
    for (int x = 0; x < footprint.width; ++x) {
      if (row[x] == 0) continue;
      const int begin = x;
      while (x < footprint.width && row[x] != 0) ++x;
      footprint.runs.push_back({y, begin, x});
    }
  }
  std::stable_sort(footprint.runs.begin(), footprint.runs.end(),
                   [](const Run& l, const Run& r) { return l.length() > r.length(); });
  return footprint;
}

/// A quarter turn counter-clockwise as seen with y down: (x, y) → (y, width − x).
Footprint quarter_turned(const Footprint& footprint) {
  std::vector<std::vector<uint8_t>> covered(static_cast<size_t>(footprint.width),
                                            std::vector<uint8_t>(static_cast<size_t>(footprint.height), 0));
  for (const Run& run : footprint.runs)
    for (int x = run.begin; x < run.end; ++x)
      covered[static_cast<size_t>(footprint.width - 1 - x)][static_cast<size_t>(run.row)] = 1;
  Footprint turned;
  turned.width = footprint.height;
  turned.height = footprint.width;
  for (int y = 0; y < turned.height; ++y)
    for (int x = 0; x < turned.width; ++x) {
      const auto& row = covered[static_cast<size_t>(y)];
      if (row[static_cast<size_t>(x)] == 0) continue;
      const int begin = x;
      while (x < turned.width && row[static_cast<size_t>(x)] != 0) ++x;
      turned.runs.push_back({y, begin, x});
    }
  std::stable_sort(turned.runs.begin(), turned.runs.end(),
                   [](const Run& l, const Run& r) { return l.length() > r.length(); });
  return turned;
}

/// The occupied blocks of a bin. Beside each row's bits, level k holds them smeared over 2^k places: bit x
/// says that one of x … x + 2^k − 1 is taken, so a run of any length is tested at all places by two look-ups.
class Bin {
 public:
  Bin(int width, int height)
      : width_(width),
        height_(height),
        words_((static_cast<size_t>(width) + 63) / 64),
        levels_(static_cast<size_t>(std::bit_width(static_cast<unsigned>(width)))),
        bits_(static_cast<size_t>(height) * levels_ * words_, 0),
        longest_free_(static_cast<size_t>(height), width) {}

  struct Place {
    int x, y;
  };

  /// The lowest, then leftmost place at or above row `first` whose top does not pass `best_top`.
  std::optional<Place> find(const Footprint& footprint, int first, int best_top) const {
    if (footprint.width > width_) return std::nullopt;
    const int last = std::min(height_, best_top) - footprint.height;
    std::vector<uint64_t> open(words_);
    for (int y = first; y <= last; ++y) {
      if (!rows_have_room(footprint, y)) continue;
      set_first(open, width_ - footprint.width + 1);
      bool any = true;
      for (const Run& run : footprint.runs)
        if (any = close(open, run, y); !any) break;
      if (!any) continue;
      for (size_t w = 0; w < words_; ++w)
        if (open[w] != 0) return Place{static_cast<int>(64 * w) + std::countr_zero(open[w]), y};
    }
    return std::nullopt;
  }

  void occupy(const Footprint& footprint, Place place) {
    std::vector<int> touched;
    for (const Run& run : footprint.runs) {
      uint64_t* row = level(place.y + run.row, 0);
      for (int x = place.x + run.begin; x < place.x + run.end; ++x) row[x / 64] |= uint64_t{1} << (x % 64);
      touched.push_back(place.y + run.row);
    }
    std::sort(touched.begin(), touched.end());
    touched.erase(std::unique(touched.begin(), touched.end()), touched.end());
    for (const int y : touched) refresh(y);
  }

 private:
  uint64_t* level(int y, size_t k) { return bits_.data() + (static_cast<size_t>(y) * levels_ + k) * words_; }
  const uint64_t* level(int y, size_t k) const {
    return bits_.data() + (static_cast<size_t>(y) * levels_ + k) * words_;
  }

  bool rows_have_room(const Footprint& footprint, int y) const {
    for (const Run& run : footprint.runs)
      if (longest_free_[static_cast<size_t>(y + run.row)] < run.length()) return false;
    return true;
  }

  static void set_first(std::vector<uint64_t>& open, int count) {
    for (size_t w = 0; w < open.size(); ++w) {
      const int here = std::clamp(count - static_cast<int>(64 * w), 0, 64);
      open[w] = here == 64 ? ~uint64_t{0} : (uint64_t{1} << here) - 1;
    }
  }

  /// Removes the places where the run would meet what is taken; false when none is left.
  bool close(std::vector<uint64_t>& open, const Run& run, int y) const {
    const auto k = static_cast<size_t>(std::bit_width(static_cast<unsigned>(run.length())) - 1);
    const uint64_t* smeared = level(y + run.row, k);
    const int first = run.begin, second = run.end - (1 << k);
    uint64_t left = 0;
    for (size_t w = 0; w < words_; ++w) {
      if (open[w] == 0) continue;
      open[w] &= ~(shifted(smeared, w, first) | shifted(smeared, w, second));
      left |= open[w];
    }
    return left != 0;
  }

  /// Word w of the row moved towards lower places by `shift`.
  uint64_t shifted(const uint64_t* row, size_t w, int shift) const {
    const size_t from = w + static_cast<size_t>(shift / 64);
    const int rest = shift % 64;
    const uint64_t low = from < words_ ? row[from] : 0;
    if (rest == 0) return low;
    const uint64_t high = from + 1 < words_ ? row[from + 1] : 0;
    return low >> rest | high << (64 - rest);
  }

  void refresh(int y) {
    for (size_t k = 1; k < levels_; ++k) {
      const uint64_t* below = level(y, k - 1);
      uint64_t* here = level(y, k);
      for (size_t w = 0; w < words_; ++w) here[w] = below[w] | shifted(below, w, 1 << (k - 1));
    }
    const uint64_t* row = level(y, 0);
    int longest = 0, current = 0;
    for (int x = 0; x < width_; ++x) {
      current = (row[x / 64] >> (x % 64) & 1) != 0 ? 0 : current + 1;
      longest = std::max(longest, current);
    }
    longest_free_[static_cast<size_t>(y)] = longest;
  }

  int width_, height_;
  size_t words_, levels_;
  std::vector<uint64_t> bits_;
  std::vector<int> longest_free_;  ///< by row
};

struct Placement {
  int quarter_turns = 0;
  Bin::Place place{0, 0};
  int width = 0, height = 0;  ///< of the footprint before turning, blocks
};

/// A packing into a strip as wide as the atlas.
struct Strip {
  std::vector<Placement> placements;  ///< fewer than pieces where the strip was too short
  int height = 0;                     ///< blocks
};

/// Places the pieces in their order, largest first.
Strip pack_strip(std::span<const Piece> pieces, double texels_per_m, int width, int most_height, int gutter_texels,
                 const Work& work) {
  std::vector<std::array<Footprint, 4>> footprints(pieces.size());
  constexpr size_t grain = 16;
  work.parallel_for(pieces.size(), grain, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      footprints[i][0] = footprint_of(pieces[i], texels_per_m, gutter_texels);
      for (size_t turn = 1; turn < 4; ++turn) footprints[i][turn] = quarter_turned(footprints[i][turn - 1]);
    }
  });
  Bin bin(width, most_height);
  Strip strip;
  // Where one piece found no room, the next, hardly smaller one will hardly find any: it starts where the last one
  // came to lie. From time to time the search starts again below, where by now smaller gaps will do.
  constexpr double restart_at_share = 0.8;
  double class_size = std::numeric_limits<double>::infinity();
  int first = 0;
  for (const auto& turns : footprints) {
    const double piece_size = std::sqrt(static_cast<double>(turns[0].width) * turns[0].height);
    if (piece_size < restart_at_share * class_size) {
      class_size = piece_size;
      first = 0;
    }
    std::optional<Placement> best;
    int best_top = most_height;
    for (int turn = 0; turn < 4; ++turn) {
      const Footprint& footprint = turns[static_cast<size_t>(turn)];
      const auto place = bin.find(footprint, first, best ? best_top - 1 : best_top);
      if (!place) continue;
      best_top = place->y + footprint.height;
      best = Placement{turn, *place, turns[0].width, turns[0].height};
    }
    if (!best) break;
    bin.occupy(turns[static_cast<size_t>(best->quarter_turns)], best->place);
    first = std::max(first, best->place.y - std::max(turns[0].width, turns[0].height) / 2);
    strip.height = std::max(strip.height, best_top);
    strip.placements.push_back(*best);
  }
  return strip;
}

/// A piece's point, in texels of the atlas.
Eigen::Vector2d placed(const Eigen::Vector2d& p_piece, const Placement& placement, double texels_per_m,
                       int gutter_texels) {
  Eigen::Vector2d p = texels_per_m * p_piece + Eigen::Vector2d::Constant(margin_texels(gutter_texels));
  double width = placement.width * block_texels, height = placement.height * block_texels;
  for (int turn = 0; turn < placement.quarter_turns; ++turn) {
    p = Eigen::Vector2d(p.y(), width - p.x());
    std::swap(width, height);
  }
  return p + block_texels * Eigen::Vector2d(placement.place.x, placement.place.y);
}

}  // namespace

Packing pack_charts(std::span<const Chart> charts, size_t triangles, std::span<const double> density, int size,
                    int gutter_texels, const Work& work) {
  std::vector<Piece> pieces(charts.size());
  constexpr size_t grain = 16;
  work.parallel_for(charts.size(), grain, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) pieces[i] = turned_to_smallest_box(charts[i], density[i]);
  });
  std::vector<size_t> order(charts.size());
  std::iota(order.begin(), order.end(), size_t{0});
  std::stable_sort(order.begin(), order.end(),
                   [&](size_t l, size_t r) { return pieces[l].extent.prod() > pieces[r].extent.prod(); });
  std::vector<Piece> sorted;
  for (const size_t i : order) sorted.push_back(pieces[i]);
  const double area = std::accumulate(pieces.begin(), pieces.end(), 0.0,
                                      [](double sum, const Piece& piece) { return sum + piece.area; });

  // How tall the strip becomes at one scale tells the next one to try; the best that fits the square is kept.
  const int side = size / block_texels;
  const double full = area > 0 ? size / std::sqrt(area) : 1;
  constexpr double first_share = 0.75, shrink = 0.985, tiny = 1e-6;
  constexpr int attempts = 4;
  double share = first_share, best_share = 0;
  std::vector<Placement> best;
  for (int attempt = 0; share > tiny && (attempt < attempts || best.empty()); ++attempt) {
    Strip strip = pack_strip(sorted, full * std::sqrt(share), side, 2 * side, gutter_texels, work);
    const bool complete = strip.placements.size() == sorted.size();
    if (complete && strip.height <= side && share > best_share) {
      best_share = share;
      best = std::move(strip.placements);
    }
    const double fitting = complete ? share * side / std::max(1, strip.height) : 0.5 * share;
    share = best.empty() ? std::min(fitting, shrink * share) : std::max(fitting, best_share / shrink);
    if (attempt + 1 >= attempts && !best.empty()) break;
  }
  const double best_scale = full * std::sqrt(best_share);

  Packing packing;
  packing.texels_per_m = best_scale;
  packing.corners.assign(triangles, {Eigen::Vector2d::Zero(), Eigen::Vector2d::Zero(), Eigen::Vector2d::Zero()});
  for (size_t i = 0; i < best.size(); ++i) {
    const Chart& chart = charts[order[i]];
    for (size_t t = 0; t < chart.triangles.size(); ++t)
      for (size_t k = 0; k < 3; ++k)
        packing.corners[chart.triangles[t]][k] = placed(sorted[i].corners[t][k], best[i], best_scale, gutter_texels);
  }
  return packing;
}

}  // namespace booth
