#include "pipeline/atlas/packing.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <deque>
#include <limits>
#include <numbers>
#include <numeric>
#include <optional>
#include <queue>
#include <tuple>
#include <utility>

#include "pipeline/atlas/planar_grid.h"
#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

/// Charts are placed on a lattice of blocks of this many texels a side: coarser packs faster, finer packs tighter.
constexpr int block_texels = 2;

/// Which blocks a chart covers, row by row as runs of neighbouring blocks.
struct Run {
  int row, begin, end;
  int length() const { return end - begin; }
};
struct Footprint {
  int width = 0, height = 0;     ///< blocks
  std::vector<Run> runs;         ///< of spread_out()
  std::vector<int> longest_run;  ///< of each row
};

/// Measures the rows and puts first the longest run, then such as lie far from all before: neighbouring rows fail at
/// the same places, so a place where the piece does not fit is soon found out.
void spread_out(Footprint* footprint) {
  std::vector<Run>& runs = footprint->runs;
  footprint->longest_run.assign(static_cast<size_t>(footprint->height), 0);
  for (const Run& run : runs) {
    int& longest = footprint->longest_run[static_cast<size_t>(run.row)];
    longest = std::max(longest, run.length());
  }
  if (runs.empty()) return;
  const auto order = [](const Run& run) {  // rows by their reversed bits: 0, 1/2, 1/4, 3/4, 1/8 …
    uint32_t row = static_cast<uint32_t>(run.row), reversed = 0;
    for (int bit = 0; bit < 16; ++bit, row >>= 1) reversed = reversed << 1 | (row & 1);
    return reversed;
  };
  std::stable_sort(runs.begin(), runs.end(), [&](const Run& l, const Run& r) { return order(l) < order(r); });
  std::iter_swap(runs.begin(), std::max_element(runs.begin(), runs.end(),
                                                [](const Run& l, const Run& r) { return l.length() < r.length(); }));
}

/// A chart with y downwards, turned so that its bounding box is the smallest, its lowest corner at the origin;
/// metres × density.
struct Piece {
  std::vector<uint32_t> triangles;
  std::vector<FlatCorners> corners;
  Eigen::Vector2d extent = Eigen::Vector2d::Zero();
  double area = 0;
};

/// Moves the piece's lowest corner to the origin and measures it.
void settle(Piece& piece) {
  Eigen::Vector2d low = Eigen::Vector2d::Constant(std::numeric_limits<double>::infinity()), high = -low;
  for (const FlatCorners& triangle : piece.corners)
    for (const Eigen::Vector2d& p : triangle) {
      low = low.cwiseMin(p);
      high = high.cwiseMax(p);
    }
  piece.extent = high - low;
  piece.area = 0;
  for (FlatCorners& triangle : piece.corners) {
    for (Eigen::Vector2d& p : triangle) p -= low;
    const Eigen::Vector2d ab = triangle[1] - triangle[0], ac = triangle[2] - triangle[0];
    piece.area += 0.5 * std::abs(ab.x() * ac.y() - ab.y() * ac.x());
  }
}

Piece turned_to_smallest_box(const Chart& chart, double density) {
  constexpr int steps = 45;  // of a quarter turn
  double best_area = std::numeric_limits<double>::infinity();
  Eigen::Matrix2d best = Eigen::Matrix2d::Identity();
  for (int step = 0; step < steps; ++step) {
    const Eigen::Matrix2d turn =
        Eigen::Rotation2Dd(0.5 * std::numbers::pi * step / steps) * Eigen::Vector2d(1, -1).asDiagonal();
    Eigen::Vector2d low = Eigen::Vector2d::Constant(std::numeric_limits<double>::infinity()), high = -low;
    for (const FlatCorners& triangle : chart.corners)
      for (const Eigen::Vector2d& p : triangle) {
        const Eigen::Vector2d q = turn * p;
        low = low.cwiseMin(q);
        high = high.cwiseMax(q);
      }
    if (const double area = (high - low).prod(); area < best_area) {
      best_area = area;
      best = turn;
    }
  }
  Piece piece{chart.triangles, {}, Eigen::Vector2d::Zero(), 0};
  for (const FlatCorners& triangle : chart.corners) {
    FlatCorners& turned = piece.corners.emplace_back();
    for (size_t k = 0; k < 3; ++k) turned[k] = density * (best * triangle[k]);
  }
  settle(piece);
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
  for (const FlatCorners& triangle : piece.corners) {
    FlatCorners p;
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
    for (int y = y0; y < y1; ++y) {
      double from = x0, to = x1 - 1;
      for (const Eigen::Vector3d& e : edges) {
        const double left = e.z() - e.y() * (y + 0.5);  // of what e.x() (x + 0.5) may be
        if (e.x() > 0)
          to = std::min(to, left / e.x() - 0.5);
        else if (e.x() < 0)
          from = std::max(from, left / e.x() - 0.5);
        else if (left < 0)
          to = -1;
      }
      const int first = static_cast<int>(std::ceil(from)), last = static_cast<int>(std::floor(to));
      if (first > last) continue;
      std::fill_n(covered.begin() + static_cast<ptrdiff_t>(y) * footprint.width + first, last - first + 1, uint8_t{1});
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
  spread_out(&footprint);
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
  spread_out(&turned);
  return turned;
}

Footprint half_turned(const Footprint& footprint) {
  Footprint turned = footprint;
  for (Run& run : turned.runs)
    run = {footprint.height - 1 - run.row, footprint.width - run.end, footprint.width - run.begin};
  std::reverse(turned.longest_run.begin(), turned.longest_run.end());
  return turned;
}

/// The occupied blocks of a bin. Beside each row's bits, level k holds them smeared over 2^k places: bit x
/// says that one of x … x + 2^k − 1 is taken, so a run of any length is tested at all places by two look-ups.
class Bin {
 public:
  Bin(int width, int height)
      : width_(width),
        height_(height),
        words_((static_cast<size_t>(width) + 63) / 64 + words_behind),
        levels_(static_cast<size_t>(std::bit_width(static_cast<unsigned>(width)))),
        bits_(static_cast<size_t>(height) * levels_ * words_, 0),
        longest_free_(static_cast<size_t>(height), width) {}

  struct Place {
    int x, y;
  };

  /// The lowest, then leftmost place whose top does not pass `best_top`.
  std::optional<Place> find(const Footprint& footprint, int best_top) const {
    if (footprint.width > width_) return std::nullopt;
    const int last = std::min(height_, best_top) - footprint.height;
    const int places = width_ - footprint.width + 1;
    std::vector<uint64_t> open((static_cast<size_t>(places) + 63) / 64);
    for (int y = 0; y <= last; ++y) {
      if (!fits_lengthwise(footprint, y)) continue;
      std::fill(open.begin(), open.end(), ~uint64_t{0});
      if (places % 64 != 0) open.back() >>= 64 - places % 64;
      bool any = true;
      for (const Run& run : footprint.runs)
        if (any = close(open, run, y); !any) break;
      if (!any) continue;
      for (size_t w = 0; w < open.size(); ++w)
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
  /// Of each row, never set: so that any word of a shifted row can be read.
  static constexpr size_t words_behind = 2;

  uint64_t* level(int y, size_t k) { return bits_.data() + (static_cast<size_t>(y) * levels_ + k) * words_; }
  const uint64_t* level(int y, size_t k) const {
    return bits_.data() + (static_cast<size_t>(y) * levels_ + k) * words_;
  }

  /// Whether every row has room for the longest run there: the cheapest test, and one that most places fail.
  bool fits_lengthwise(const Footprint& footprint, int y) const {
    if (footprint.runs.empty()) return true;
    const Run& longest = footprint.runs.front();
    const int* free = longest_free_.data() + y;
    return free[longest.row] >= longest.length() && none_longer(footprint.longest_run, free);
  }
  static bool none_longer(std::span<const int> lengths, const int* free);

  /// Removes the places where the run would meet what is taken; false when none is left.
  bool close(std::vector<uint64_t>& open, const Run& run, int y) const {
    const auto k = static_cast<size_t>(std::bit_width(static_cast<unsigned>(run.length())) - 1);
    const uint64_t* smeared = level(y + run.row, k);
    const int first = run.begin, second = run.end - (1 << k);
    return remove_taken(open.data(), open.size(), smeared + first / 64, first % 64, smeared + second / 64,
                        second % 64) != 0;
  }

  /// Word w of the row moved towards lower places by `shift`.
  uint64_t shifted(const uint64_t* row, size_t w, int shift) const {
    const size_t from = w + static_cast<size_t>(shift / 64);
    return from + 1 < words_ ? shifted_word(row + from, shift % 64) : 0;
  }
  static uint64_t shifted_word(const uint64_t* words, int rest) {
    return words[0] >> rest | (words[1] << 1) << (63 - rest);
  }

  static uint64_t remove_taken(uint64_t* open, size_t words, const uint64_t* first, int first_rest,
                               const uint64_t* second, int second_rest);

  void refresh(int y) {
    const size_t used = words_ - words_behind;
    for (size_t k = 1; k < levels_; ++k) {
      const uint64_t* below = level(y, k - 1);
      uint64_t* here = level(y, k);
      for (size_t w = 0; w < used; ++w) here[w] = below[w] | shifted(below, w, 1 << (k - 1));
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

BOOTH_VECTOR_CLONES
bool Bin::none_longer(std::span<const int> lengths, const int* free) {
  const int* length = lengths.data();
  const size_t count = lengths.size();
  int longer = 0;
  for (size_t i = 0; i < count; ++i) longer |= length[i] > free[i] ? 1 : 0;
  return longer == 0;
}

/// Clears the bits of `open` that are set in one of two rows, which are moved; returns all that is left.
BOOTH_VECTOR_CLONES
uint64_t Bin::remove_taken(uint64_t* open, size_t words, const uint64_t* first, int first_rest, const uint64_t* second,
                           int second_rest) {
  uint64_t left = 0;
  for (size_t w = 0; w < words; ++w) {
    open[w] &= ~(shifted_word(first + w, first_rest) | shifted_word(second + w, second_rest));
    left |= open[w];
  }
  return left;
}

struct Placement {
  int quarter_turns = 0;
  Bin::Place place{0, 0};
  int width = 0, height = 0;  ///< of the footprint before turning, blocks
};

/// The piece's two halves, cut across its longer side.
std::array<Piece, 2> halves(const Piece& piece) {
  const Eigen::Index axis = piece.extent.x() >= piece.extent.y() ? 0 : 1;
  std::vector<double> middles;
  for (const FlatCorners& c : piece.corners) middles.push_back(c[0][axis] + c[1][axis] + c[2][axis]);
  auto sorted = middles;
  const auto median = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), median, sorted.end());
  std::array<Piece, 2> parts;
  for (size_t i = 0; i < middles.size(); ++i) {
    Piece& part = parts[middles[i] < *median ? 0 : 1];
    part.triangles.push_back(piece.triangles[i]);
    part.corners.push_back(piece.corners[i]);
  }
  for (Piece& part : parts) settle(part);
  return parts;
}

struct Placed {
  Piece piece;
  Placement placement;
};

/// Places the pieces, largest first, in a square bin. A piece that finds no room is halved, and its halves wait for
/// their turn: so there are small pieces for small gaps when the large gaps are used up.
///
/// @return nothing where it does not work out at this scale
std::optional<std::vector<Placed>> place_all(const std::vector<Piece>& pieces, double texels_per_m, int side,
                                             int gutter_texels, const Work& work) {
  // A piece and its footprint in four turns.
  struct Waiting {
    const Piece* piece;
    std::array<Footprint, 4> turns;
  };
  const auto prepared = [&](const Piece& piece) {
    Waiting waiting{&piece, {}};
    waiting.turns[0] = footprint_of(piece, texels_per_m, gutter_texels);
    waiting.turns[1] = quarter_turned(waiting.turns[0]);
    for (size_t turn = 2; turn < 4; ++turn) waiting.turns[turn] = half_turned(waiting.turns[turn - 2]);
    return waiting;
  };
  std::vector<Waiting> waiting(pieces.size());
  constexpr size_t grain = 16;
  work.parallel_for(pieces.size(), grain, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) waiting[i] = prepared(pieces[i]);
  });
  // Not even an ideal packing would be this tight.
  constexpr double tightest = 0.93;
  double blocks = 0;
  for (const Waiting& one : waiting)
    for (const Run& run : one.turns[0].runs) blocks += run.length();
  if (blocks > tightest * side * side) return std::nullopt;

  std::deque<Piece> parts;  // of halved pieces
  // Largest first; of equal ones the first that came.
  std::priority_queue<std::tuple<double, int64_t>> queue;
  for (size_t i = 0; i < waiting.size(); ++i) queue.emplace(pieces[i].extent.prod(), -static_cast<int64_t>(i));

  const size_t most_pieces = 3 * pieces.size() + 64;
  Bin bin(side, side);
  std::vector<Placed> done;
  while (!queue.empty()) {
    const auto i = static_cast<size_t>(-std::get<1>(queue.top()));
    queue.pop();
    std::optional<Placement> best;
    int best_top = side;
    for (int turn = 0; turn < 4; ++turn) {
      const Footprint& footprint = waiting[i].turns[static_cast<size_t>(turn)];
      const auto place = bin.find(footprint, best ? best_top - 1 : best_top);
      if (!place) continue;
      best_top = place->y + footprint.height;
      best = Placement{turn, *place, waiting[i].turns[0].width, waiting[i].turns[0].height};
    }
    if (best) {
      bin.occupy(waiting[i].turns[static_cast<size_t>(best->quarter_turns)], best->place);
      done.push_back({*waiting[i].piece, *best});
      continue;
    }
    if (waiting[i].piece->triangles.size() < 2 || waiting.size() + 2 > most_pieces) return std::nullopt;
    for (Piece& part : halves(*waiting[i].piece)) {
      if (part.triangles.empty()) return std::nullopt;
      parts.push_back(std::move(part));
      queue.emplace(parts.back().extent.prod(), -static_cast<int64_t>(waiting.size()));
      waiting.push_back(prepared(parts.back()));
    }
  }
  return done;
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
  const double area = std::accumulate(pieces.begin(), pieces.end(), 0.0,
                                      [](double sum, const Piece& piece) { return sum + piece.area; });

  // The largest scale that fits is found by trying smaller and smaller ones, by the share of the atlas they use.
  const int side = size / block_texels;
  const double full = area > 0 ? size / std::sqrt(area) : 1;
  constexpr double first_share = 0.8, least_share = 1e-4;
  constexpr double shrink = 0.97, shrink_below_half = 0.7;
  Packing packing;
  packing.corners.assign(triangles, {Eigen::Vector2d::Zero(), Eigen::Vector2d::Zero(), Eigen::Vector2d::Zero()});
  for (double share = first_share; share > least_share; share *= share > 0.5 ? shrink : shrink_below_half) {
    const double scale = full * std::sqrt(share);
    const auto done = place_all(pieces, scale, side, gutter_texels, work);
    if (!done) continue;
    packing.texels_per_m = scale;
    for (const auto& [piece, placement] : *done)
      for (size_t t = 0; t < piece.triangles.size(); ++t)
        for (size_t k = 0; k < 3; ++k)
          packing.corners[piece.triangles[t]][k] = placed(piece.corners[t][k], placement, scale, gutter_texels);
    break;
  }
  return packing;
}

}  // namespace booth
