#include "pipeline/refine/handle_removal.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <vector>

#include "pipeline/geometry/brick_bits.h"

namespace booth {
namespace {

constexpr int side = Field::brick_side;
constexpr int side_bits = std::countr_zero(static_cast<unsigned>(side));

/// The 27 cells around one as bits: (dz + 1) · 9 + (dy + 1) · 3 + dx + 1.
constexpr int middle_bit = 13;
constexpr uint32_t middle = 1U << middle_bit;
constexpr uint32_t all_around = ((1U << 27) - 1) & ~middle;

struct Adjacency {
  std::array<uint32_t, 27> by_face{}, by_corner{};
  uint32_t faces = 0, faces_and_edges = 0;  ///< of the middle
};

constexpr Adjacency make_adjacency() {
  Adjacency made;
  const auto apart = [](int a, int b) {
    int most = 0, sum = 0;
    for (int unit = 1; unit <= 9; unit *= 3) {
      const int difference = a / unit % 3 - b / unit % 3;
      const int distance = difference < 0 ? -difference : difference;
      sum += distance;
      most = distance > most ? distance : most;
    }
    return std::pair{most, sum};
  };
  for (int a = 0; a < 27; ++a)
    for (int b = 0; b < 27; ++b) {
      if (a == b) continue;
      const auto [most, sum] = apart(a, b);
      if (sum == 1) made.by_face[static_cast<size_t>(a)] |= 1U << b;
      if (most == 1) made.by_corner[static_cast<size_t>(a)] |= 1U << b;
      if (a == middle_bit && sum == 1) made.faces |= 1U << b;
      if (a == middle_bit && sum <= 2) made.faces_and_edges |= 1U << b;
    }
  return made;
}
constexpr Adjacency adjacency = make_adjacency();

/// How many parts of `set` hold a cell of `seeds`.
int count_parts(uint32_t set, uint32_t seeds, const std::array<uint32_t, 27>& neighbours) {
  int parts = 0;
  for (seeds &= set; seeds != 0; ++parts) {
    uint32_t part = 0, front = seeds & (~seeds + 1);
    while (front != 0) {
      part |= front;
      uint32_t reached = 0;
      for (; front != 0; front &= front - 1) reached |= neighbours[static_cast<size_t>(std::countr_zero(front))];
      front = reached & set & ~part;
    }
    seeds &= ~part;
  }
  return parts;
}

/// Whether the middle can join or leave the solid (connected by faces; its complement by corners) without a change of
/// topology.
bool is_simple(uint32_t solid) {
  return count_parts(solid & adjacency.faces_and_edges, adjacency.faces, adjacency.by_face) == 1 &&
         count_parts(~solid & all_around, all_around, adjacency.by_corner) == 1;
}

/// is_simple with a memory: of the surroundings that fronts meet, a few make up nearly all.
class SimpleCells {
 public:
  bool operator()(uint32_t solid) {
    Known& known = known_[solid * 2654435761U >> (32 - memory_bits)];  // Knuth's multiplicative hash
    if (known.solid != solid || !known.any) known = {solid, true, is_simple(solid)};
    return known.simple;
  }

 private:
  static constexpr int memory_bits = 12;
  struct Known {
    uint32_t solid = 0;
    bool any = false, simple = false;
  };
  std::array<Known, size_t{1} << memory_bits> known_{};
};

/// A cube of samples, by the brick of its first sample and that sample's number in the brick.
struct Cell {
  uint32_t brick;
  uint16_t sample;
};

/// Which samples of a field are inside, as bits. Bricks are numbered with one more on each side of the grid, where
/// everything is outside, so that each has 26 around it.
class Solid {
 public:
  Solid(const Field& field, const Work& work) : field_(field), bits_(field.blocks()) {
    const auto count = [&](size_t axis) { return static_cast<uint32_t>(field.bricks()[axis] + 2); };
    step_ = {1, count(0), count(0) * count(1)};
    block_.assign(size_t{step_[2]} * count(2), Field::all_outside);
    for_each_brick([&](uint32_t brick, size_t in_field) { block_[brick] = field.brick(in_field); });
    constexpr size_t grain = 64;
    work.parallel_for(bits_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t n = begin; n < end; ++n) bits_[n] = inside_bits(field.block(static_cast<int32_t>(n)));
    });
  }

  /// From a brick to the next along x, y, z.
  const std::array<uint32_t, 3>& step() const { return step_; }
  size_t bricks() const { return block_.size(); }
  int32_t block(size_t brick) const { return block_[brick]; }
  const BrickBits& bits(size_t brick) const {
    const int32_t block = block_[brick];
    if (block >= 0) return bits_[static_cast<size_t>(block)];
    return block == Field::all_inside ? all : none;
  }
  const Field& field() const { return field_; }

  /// Calls `visit` with the number of each brick of the grid, here and in the field.
  template <class Visitor>
  void for_each_brick(const Visitor& visit) const {
    const auto& bricks = field_.bricks();
    for (int z = 0; z < bricks[2]; ++z)
      for (int y = 0; y < bricks[1]; ++y)
        for (int x = 0; x < bricks[0]; ++x)
          visit(static_cast<uint32_t>(x + 1) * step_[0] + static_cast<uint32_t>(y + 1) * step_[1] +
                    static_cast<uint32_t>(z + 1) * step_[2],
                field_.brick_index(x, y, z));
  }

 private:
  static constexpr BrickBits none{};
  static constexpr BrickBits all = [] {
    BrickBits bits{};
    bits.fill(~uint64_t{0});
    return bits;
  }();

  const Field& field_;
  std::array<uint32_t, 3> step_{};
  std::vector<int32_t> block_;   ///< by brick: as Field::brick
  std::vector<BrickBits> bits_;  ///< by block
};

/// Of the cells of so many samples along their side those that wholly belong to `bits`, as bits of their first samples.
template <int cell>
BrickBits whole_cells(BrickBits bits) {
  for (int step = 1; step < cell; step *= 2) {
    for (uint64_t& plane : bits) {
      plane &= plane >> step;
      plane &= plane >> (step * side);
    }
    for (size_t k = 0; k + static_cast<size_t>(step) < bits.size(); ++k) bits[k] &= bits[k + static_cast<size_t>(step)];
  }
  uint64_t firsts = 0;
  for (int n = 0; n < side * side; ++n)
    if (n % side % cell == 0 && n / side % cell == 0) firsts |= uint64_t{1} << n;
  for (size_t k = 0; k < bits.size(); ++k) bits[k] &= k % cell == 0 ? firsts : 0;
  return bits;
}

/// Calls `visit` with the number of every sample whose bit is set, in their order.
template <class Visitor>
void for_each_sample(const BrickBits& bits, const Visitor& visit) {
  for (size_t k = 0; k < bits.size(); ++k)
    for (uint64_t plane = bits[k]; plane != 0; plane &= plane - 1)
      visit(static_cast<uint16_t>(k * side * side + static_cast<size_t>(std::countr_zero(plane))));
}

/// Grows the inside or the outside of a field without a change of topology, by cells of 8, 4, 2 samples along their
/// side and at last by samples, those farther from the surface first.
class Growth {
 public:
  Growth(const Solid& solid, bool inside, const Work& work)
      : solid_(solid),
        inside_(inside),
        work_(work),
        bricks_(solid.bricks(), inside ? uint8_t{0} : grown_bit),  // beyond the grid everything is outside
        page_of_(solid.bricks(), inside ? empty_page : grown_page),
        any_(!inside) {
    solid.for_each_brick([&](uint32_t brick, size_t) {
      bricks_[brick] = 0;
      page_of_[brick] = empty_page;
    });
    pages_.reserve(solid.field().blocks() + 2);
    pages_.emplace_back().fill(0);
    pages_.emplace_back().fill(grown_bit);
    for (size_t axis = 0; axis < 3; ++axis) brick_step_[axis] = solid.step()[axis];
  }

  /// The samples that should belong and were left out, in parts.
  std::vector<std::vector<Cell>> run() {
    grow<side>();
    solid_.for_each_brick(
        [&](uint32_t brick, size_t) { page_of_[brick] = (bricks_[brick] & grown_bit) != 0 ? grown_page : empty_page; });
    grow<side / 2>();
    grow<side / 4>();
    grow<1>();
    return left_out();
  }

 private:
  static constexpr size_t depths = 32;
  static constexpr uint8_t grown_bit = 1, waiting_bit = 2, refused_bit = 4;
  static constexpr uint8_t belongs_bit = 8;  ///< the whole cell should belong, and has not been grown yet
  /// Pages that many bricks share: nothing of them is grown and nothing can be, or all is.
  static constexpr uint32_t empty_page = 0, grown_page = 1;

  BrickBits belonging(uint32_t brick) const {
    BrickBits bits = solid_.bits(brick);
    if (!inside_)
      for (uint64_t& plane : bits) plane = ~plane;
    return bits;
  }

  uint8_t& state(const Cell& c) { return pages_[page_of_[c.brick]][c.sample]; }
  void give_page(uint32_t brick) {
    if (page_of_[brick] != empty_page) return;
    page_of_[brick] = static_cast<uint32_t>(pages_.size());
    pages_.emplace_back().fill(0);
  }

  /// Where the 27 cells around one lie.
  template <int cell>
  class Around {
   public:
    Around(const Growth& growth, const Cell& c)
        : growth_(growth),
          brick_(c.brick),
          x_(c.sample % side),
          y_(c.sample / side % side),
          z_(c.sample / (side * side)) {}

    Cell at(int dx, int dy, int dz) const {
      const int x = x_ + dx * cell, y = y_ + dy * cell, z = z_ + dz * cell;
      const auto& step = growth_.brick_step_;
      // Shifted arithmetically, −1 lies in the brick before.
      return {static_cast<uint32_t>(brick_ + (x >> side_bits) * step[0] + (y >> side_bits) * step[1] +
                                    (z >> side_bits) * step[2]),
              static_cast<uint16_t>(((z & (side - 1)) * side + (y & (side - 1))) * side + (x & (side - 1)))};
    }
    /// Calls `visit` with the number of each and with the cell, the one in the middle included.
    template <class Visitor>
    void for_each(const Visitor& visit) const {
      int n = 0;
      for (int dz = -1; dz <= 1; ++dz)
        for (int dy = -1; dy <= 1; ++dy)
          for (int dx = -1; dx <= 1; ++dx, ++n) visit(n, at(dx, dy, dz));
    }

   private:
    const Growth& growth_;
    int64_t brick_;
    int x_, y_, z_;
  };

  template <int cell>
  uint8_t& state_of(const Cell& c) {
    if constexpr (cell == side) return bricks_[c.brick];
    return state(c);
  }

  template <int cell>
  void grow() {
    if (work_.stopped()) return;
    find_front<cell>();
    for (size_t depth = 0; depth < depths; ++depth) {
      // Cells that are deeper than those in turn may come up again.
      while (taken_[depth] < queue_[depth].size()) {
        const Cell c = queue_[depth][taken_[depth]++];
        std::array<Cell, 27> around;
        uint32_t grown = 0, open = 0, refused = 0;
        Around<cell>(*this, c).for_each([&](int n, const Cell& q) {
          const uint8_t of = state_of<cell>(q);
          around[static_cast<size_t>(n)] = q;
          grown |= static_cast<uint32_t>(of & grown_bit) << n;
          open |= static_cast<uint32_t>((of & (belongs_bit | waiting_bit)) == belongs_bit) << n;
          refused |= static_cast<uint32_t>((of & refused_bit) != 0) << n;
        });
        uint8_t& own = state_of<cell>(c);
        own &= static_cast<uint8_t>(~waiting_bit);
        if (!simple_((inside_ ? grown : ~grown) & all_around)) {
          own |= refused_bit;
          continue;
        }
        add<cell>(c);
        // New in the queue, or refused before something changed beside them.
        uint32_t offered = open & (adjacency.faces | refused) & all_around;
        for (; offered != 0; offered &= offered - 1)
          depth = std::min(depth, offer<cell>(around[static_cast<size_t>(std::countr_zero(offered))]));
      }
    }
    for (size_t depth = 0; depth < depths; ++depth) {
      queue_[depth].clear();
      taken_[depth] = 0;
    }
    keep_grown();
  }

  template <int cell>
  size_t offer(const Cell& c) {
    uint8_t& own = state_of<cell>(c);
    own = static_cast<uint8_t>((own | waiting_bit) & ~refused_bit);
    const size_t depth = cell == 1 ? depth_of(c) : 0;
    queue_[depth].push_back(c);
    return depth;
  }

  /// Rank of a sample: 0 for the deepest.
  size_t depth_of(const Cell& c) const {
    const int32_t block = solid_.block(c.brick);
    if (block < 0) return 0;
    const Field& field = solid_.field();
    const double share = std::abs(static_cast<double>(field.block(block)[c.sample])) / (2 * field.grid().voxel_m);
    return static_cast<size_t>((1 - std::min(share, 1.0)) * (depths - 1));
  }

  template <int cell>
  void add(const Cell& c) {
    any_ = true;
    if constexpr (cell == side) {
      bricks_[c.brick] = grown_bit;
      return;
    }
    uint8_t* first = &state(c);
    for (int k = 0; k < cell; ++k)
      for (int j = 0; j < cell; ++j) std::fill_n(first + (k * side + j) * side, cell, grown_bit);
  }

  /// Puts the cells beside what is grown into the queue; where nothing is yet, a cell in the midst of all that belong
  /// is the first.
  template <int cell>
  void find_front() {
    const std::vector<Cell> candidates = find_candidates<cell>();
    if (candidates.empty()) return;
    if (!any_) add<cell>(candidates[candidates.size() / 2]);
    for (const Cell& c : candidates) {
      if ((state_of<cell>(c) & (grown_bit | waiting_bit)) != 0) continue;
      const Around<cell> around(*this, c);
      const auto grown = [&](int dx, int dy, int dz) {
        return (state_of<cell>(around.at(dx, dy, dz)) & grown_bit) != 0;
      };
      if (grown(-1, 0, 0) || grown(1, 0, 0) || grown(0, -1, 0) || grown(0, 1, 0) || grown(0, 0, -1) || grown(0, 0, 1))
        offer<cell>(c);
    }
  }

  /// Marks the cells that should belong and are not grown yet, and returns them.
  template <int cell>
  std::vector<Cell> find_candidates() {
    std::vector<Cell> candidates;
    solid_.for_each_brick([&](uint32_t brick, size_t) {
      if (page_of_[brick] == grown_page) return;
      const BrickBits cells = whole_cells<cell>(belonging(brick));
      if (cells == BrickBits{}) return;
      if constexpr (cell == side) {
        bricks_[brick] = belongs_bit;
        if (solid_.block(brick) < 0) candidates.push_back({brick, 0});
        return;
      }
      give_page(brick);
      for_each_sample(cells, [&](uint16_t sample) {
        const Cell c{brick, sample};
        uint8_t& own = state(c);
        if ((own & grown_bit) != 0) return;
        own |= belongs_bit;
        candidates.push_back(c);
      });
    });
    return candidates;
  }

  void keep_grown() {
    for (uint8_t& value : bricks_) value &= grown_bit;
    for (auto& page : pages_)
      for (uint8_t& value : page) value &= grown_bit;
  }

  std::vector<std::vector<Cell>> left_out() {
    std::vector<std::vector<Cell>> parts;
    for (const Cell& start : find_candidates<1>()) {
      if ((state(start) & belongs_bit) == 0) continue;
      state(start) = 0;
      std::vector<Cell>& part = parts.emplace_back();
      part.push_back(start);
      for (size_t n = 0; n < part.size(); ++n)
        Around<1>(*this, part[n]).for_each([&](int, const Cell& q) {
          if ((state(q) & belongs_bit) == 0) return;
          state(q) = 0;
          part.push_back(q);
        });
    }
    return parts;
  }

  const Solid& solid_;
  bool inside_;
  const Work& work_;
  std::array<int64_t, 3> brick_step_{};                               ///< from a brick to the next along x, y, z
  std::vector<uint8_t> bricks_;                                       ///< states of whole bricks, while cells are these
  std::vector<uint32_t> page_of_;                                     ///< by brick
  std::vector<std::array<uint8_t, Field::samples_per_brick>> pages_;  ///< states of samples, or of cells at their first
  bool any_;                                                          ///< whether anything is grown
  SimpleCells simple_;
  std::array<std::vector<Cell>, depths> queue_;
  std::array<size_t, depths> taken_{};
};

/// Parts minus rings, plus cavities, of the inside as marching cubes joins it: samples that are neighbours along an
/// axis hang together. Counted as in a complex whose cells are samples, and pairs, squares and cubes of samples.
long euler_number(const Solid& solid) {
  // A plane of 8 × 8 samples, and for each of them the next along x, along y and along both.
  struct Plane {
    uint64_t own, x, y, xy;
  };
  constexpr uint64_t first_column = 0x0101010101010101U;
  const auto next_x = [](uint64_t plane, uint64_t beside) {
    return (plane >> 1 & ~(first_column << (side - 1))) | (beside & first_column) << (side - 1);
  };
  const auto next_y = [](uint64_t plane, uint64_t below) { return plane >> side | below << (side * side - side); };
  const auto plane_of = [&](size_t brick, size_t k) {
    const auto [dx, dy, dz] = solid.step();
    const uint64_t own = solid.bits(brick)[k], x = solid.bits(brick + dx)[k];
    const uint64_t y = solid.bits(brick + dy)[k], xy = solid.bits(brick + dx + dy)[k];
    return Plane{own, next_x(own, x), next_y(own, y), next_y(next_x(own, x), next_x(y, xy))};
  };
  long number = 0;
  solid.for_each_brick([&](uint32_t brick, size_t) {
    if (solid.block(brick) == Field::all_outside) return;
    Plane near = plane_of(brick, 0);
    for (size_t k = 0; k < side; ++k) {
      const Plane far = k + 1 < side ? plane_of(brick, k + 1) : plane_of(brick + solid.step()[2], 0);
      const uint64_t pair_x = near.own & near.x, pair_y = near.own & near.y, pair_z = near.own & far.own;
      const uint64_t square_xy = pair_x & near.y & near.xy, square_xz = pair_x & far.own & far.x;
      const uint64_t square_yz = pair_y & far.own & far.y, cube = square_xy & square_xz & square_yz & far.xy;
      number += std::popcount(near.own) - std::popcount(pair_x) - std::popcount(pair_y) - std::popcount(pair_z) +
                std::popcount(square_xy) + std::popcount(square_xz) + std::popcount(square_yz) - std::popcount(cube);
      near = far;
    }
  });
  return number;
}

size_t flip_small_layers(Field& field, const Solid& solid, bool inside, double area_m2, const Work& work) {
  const auto parts = Growth(solid, inside, work).run();
  const double sample_m2 = field.grid().voxel_m * field.grid().voxel_m;
  // Half a voxel from the surface: nearer, opposite sides of a cut would touch once they are smoothed.
  const auto flipped_m = static_cast<float>(0.5 * field.grid().voxel_m);
  size_t flipped = 0;
  for (const auto& part : parts) {
    if (static_cast<double>(part.size()) * sample_m2 > area_m2) continue;
    for (const auto& [brick, sample] : part) {
      const int32_t block = solid.block(brick);
      if (block < 0) continue;
      field.block(block)[sample] = inside ? flipped_m : -flipped_m;
      ++flipped;
    }
  }
  return flipped;
}

}  // namespace

RemovedHandles remove_small_handles(Field& field, const HandleRemovalOptions& options, const Work& work) {
  RemovedHandles removed;
  if (field.bricks()[0] == 0) return removed;
  constexpr long without_handles = 1;
  {
    const Solid solid(field, work);
    if (euler_number(solid) == without_handles) return removed;
    removed.filled_samples = flip_small_layers(field, solid, false, options.area_m2, work);
  }
  const Solid filled(field, work);
  if (euler_number(filled) == without_handles) return removed;
  removed.cut_samples = flip_small_layers(field, filled, true, options.area_m2, work);
  return removed;
}

}  // namespace booth
