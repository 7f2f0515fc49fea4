#include "pipeline/refine/handle_removal.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <vector>

namespace booth {
namespace {

constexpr int side = Field::brick_side;

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

/// Grows the inside or the outside of a field without a change of topology, by cells of 8, 4, 2 samples along their
/// side and at last by samples, those farther from the surface first.
class Growth {
 public:
  Growth(const Field& field, bool inside, const Work& work) : field_(field), inside_(inside), work_(work) {
    const auto bricks = field.bricks();
    for (size_t axis = 0; axis < 3; ++axis) samples_[axis] = bricks[axis] * side;
    const size_t count = field.bricks()[0] * static_cast<size_t>(bricks[1]) * static_cast<size_t>(bricks[2]);
    whole_.assign(count, 0);
    detail_of_.assign(count, -1);
  }

  /// The samples that should belong and were left out, in parts.
  std::vector<std::vector<std::array<int, 3>>> run() {
    for (int cell = side; cell >= 1 && !work_.stopped(); cell /= 2) grow(cell);
    return left_out();
  }

 private:
  using Place = std::array<int, 3>;  // of a cell's first sample
  static constexpr size_t depths = 32;

  size_t brick_of(const Place& p) const { return field_.brick_index(p[0] / side, p[1] / side, p[2] / side); }
  static size_t sample_of(const Place& p) {
    return static_cast<size_t>(((p[2] % side) * side + p[1] % side) * side + p[0] % side);
  }
  bool on_grid(const Place& p) const {
    return p[0] >= 0 && p[1] >= 0 && p[2] >= 0 && p[0] < samples_[0] && p[1] < samples_[1] && p[2] < samples_[2];
  }
  /// Beyond the grid everything is outside.
  bool grown(const Place& p) const {
    if (!on_grid(p)) return !inside_;
    const size_t brick = brick_of(p);
    if (whole_[brick] != 0) return true;
    const int32_t detail = detail_of_[brick];
    return detail >= 0 && (details_[static_cast<size_t>(detail)][sample_of(p)] & grown_bit) != 0;
  }
  bool belongs(const Place& p) const {
    const int32_t block = field_.brick(brick_of(p));
    if (block < 0) return (block == Field::all_inside) == inside_;
    return (field_.block(block)[sample_of(p)] < 0) == inside_;
  }
  bool belongs_all(const Place& p, int cell) const {
    if (field_.brick(brick_of(p)) < 0) return belongs(p);
    for (int k = 0; k < cell; ++k)
      for (int j = 0; j < cell; ++j)
        for (int i = 0; i < cell; ++i)
          if (!belongs({p[0] + i, p[1] + j, p[2] + k})) return false;
    return true;
  }

  static constexpr uint8_t grown_bit = 1, waiting_bit = 2, refused_bit = 4;
  uint8_t* state(const Place& p) {
    const size_t brick = brick_of(p);
    if (detail_of_[brick] < 0) {
      detail_of_[brick] = static_cast<int32_t>(details_.size());
      details_.emplace_back().fill(0);
    }
    return &details_[static_cast<size_t>(detail_of_[brick])][sample_of(p)];
  }

  template <class Visitor>
  static void for_each_around(const Place& p, int cell, const Visitor& visit) {
    int bit = 0;
    for (int dz = -cell; dz <= cell; dz += cell)
      for (int dy = -cell; dy <= cell; dy += cell)
        for (int dx = -cell; dx <= cell; dx += cell, ++bit)
          if (bit != middle_bit) visit(bit, Place{p[0] + dx, p[1] + dy, p[2] + dz});
  }

  void grow(int cell) {
    find_front(cell);
    for (size_t depth = 0; depth < depths; ++depth) {
      // Cells that are deeper than those in turn may come up again.
      while (taken_[depth] < queue_[depth].size()) {
        const Place p = queue_[depth][taken_[depth]++];
        uint8_t& own = *state(p);
        own &= static_cast<uint8_t>(~waiting_bit);
        if ((own & grown_bit) != 0) continue;
        uint32_t around = 0;
        for_each_around(p, cell, [&](int bit, const Place& q) { around |= static_cast<uint32_t>(grown(q)) << bit; });
        if (!is_simple(inside_ ? around : ~around & all_around)) {
          own |= refused_bit;
          continue;
        }
        add(p, cell);
        size_t first = depth;
        for_each_around(p, cell, [&](int bit, const Place& q) {
          const bool beside = (adjacency.faces >> bit & 1U) != 0;
          if (on_grid(q) && !grown(q)) first = std::min(first, offer(q, cell, beside));
        });
        if (first < depth) {
          depth = first;
        }
      }
    }
    for (size_t depth = 0; depth < depths; ++depth) {
      queue_[depth].clear();
      taken_[depth] = 0;
    }
    for (auto& detail : details_)
      for (uint8_t& value : detail) value &= grown_bit;
  }

  /// Puts a cell in the queue that is new there, or that was refused before something changed beside it.
  size_t offer(const Place& p, int cell, bool is_new) {
    if (field_.brick(brick_of(p)) >= 0 || cell < side) {
      if (!belongs_all(p, cell)) return depths;
    } else if (!belongs(p)) {
      return depths;
    }
    uint8_t& own = *state(p);
    if ((own & waiting_bit) != 0 || (!is_new && (own & refused_bit) == 0)) return depths;
    own = static_cast<uint8_t>((own | waiting_bit) & ~refused_bit);
    const size_t depth = depth_of(p, cell);
    queue_[depth].push_back(p);
    return depth;
  }

  /// Rank of a cell: 0 for the deepest.
  size_t depth_of(const Place& p, int cell) const {
    const int32_t block = field_.brick(brick_of(p));
    if (cell > 1 || block < 0) return 0;
    const double share = std::abs(static_cast<double>(field_.block(block)[sample_of(p)])) / (2 * field_.grid().voxel_m);
    return static_cast<size_t>((1 - std::min(share, 1.0)) * (depths - 1));
  }

  void add(const Place& p, int cell) {
    if (cell == side) {
      whole_[brick_of(p)] = 1;
      return;
    }
    for (int k = 0; k < cell; ++k)
      for (int j = 0; j < cell; ++j)
        for (int i = 0; i < cell; ++i) *state({p[0] + i, p[1] + j, p[2] + k}) |= grown_bit;
  }

  /// The cells beside what is grown; where nothing is yet, a cell in the midst of all that belong is the first.
  void find_front(int cell) {
    std::vector<Place> candidates;
    bool any = !inside_;
    const auto bricks = field_.bricks();
    for (int z = 0; z < bricks[2]; ++z)
      for (int y = 0; y < bricks[1]; ++y)
        for (int x = 0; x < bricks[0]; ++x) {
          const size_t brick = field_.brick_index(x, y, z);
          if (whole_[brick] != 0) {
            any = true;
            continue;
          }
          const int32_t block = field_.brick(brick);
          if (block == (inside_ ? Field::all_outside : Field::all_inside) || (block >= 0 && cell == side)) continue;
          for (int k = 0; k < side; k += cell)
            for (int j = 0; j < side; j += cell)
              for (int i = 0; i < side; i += cell) {
                const Place p{x * side + i, y * side + j, z * side + k};
                if (grown(p))
                  any = true;
                else if (belongs_all(p, cell))
                  candidates.push_back(p);
              }
        }
    if (candidates.empty()) return;
    if (!any) {
      const Place seed = candidates[candidates.size() / 2];
      add(seed, cell);
    }
    for (const Place& p : candidates) {
      bool beside = false;
      for_each_around(p, cell, [&](int bit, const Place& q) {
        beside = beside || ((adjacency.faces >> bit & 1U) != 0 && grown(q));
      });
      if (beside && !grown(p)) offer(p, cell, true);
    }
  }

  std::vector<std::vector<Place>> left_out() {
    std::vector<std::vector<Place>> parts;
    const auto bricks = field_.bricks();
    const auto wanted = [&](const Place& p) {
      return on_grid(p) && belongs(p) && !grown(p) && (*state(p) & waiting_bit) == 0;
    };
    for (int z = 0; z < bricks[2]; ++z)
      for (int y = 0; y < bricks[1]; ++y)
        for (int x = 0; x < bricks[0]; ++x) {
          const size_t brick = field_.brick_index(x, y, z);
          const int32_t block = field_.brick(brick);
          if (whole_[brick] != 0 || block == (inside_ ? Field::all_outside : Field::all_inside)) continue;
          for (int s = 0; s < static_cast<int>(Field::samples_per_brick); ++s) {
            const Place start{x * side + s % side, y * side + s / side % side, z * side + s / (side * side)};
            if (!wanted(start)) continue;
            std::vector<Place>& part = parts.emplace_back();
            part.push_back(start);
            *state(start) |= waiting_bit;
            for (size_t n = 0; n < part.size(); ++n)
              for_each_around(Place(part[n]), 1, [&](int, const Place& q) {
                if (!wanted(q)) return;
                *state(q) |= waiting_bit;
                part.push_back(q);
              });
          }
        }
    return parts;
  }

  const Field& field_;
  bool inside_;
  const Work& work_;
  std::array<int, 3> samples_{};
  std::vector<uint8_t> whole_;  ///< by brick: grown as a whole
  std::vector<int32_t> detail_of_;
  std::vector<std::array<uint8_t, Field::samples_per_brick>> details_;
  std::array<std::vector<Place>, depths> queue_;
  std::array<size_t, depths> taken_{};
};

/// Parts minus rings, plus cavities, of the inside as marching cubes joins it: samples that are neighbours along an
/// axis hang together. Counted as in a complex whose cells are samples, and pairs, squares and cubes of samples.
long euler_number(const Field& field) {
  const auto bricks = field.bricks();
  long number = 0;
  constexpr int reach = side + 1;
  std::array<uint8_t, static_cast<size_t>(reach) * reach * reach> solid{};  // a brick and its next samples
  for (int z = 0; z < bricks[2]; ++z)
    for (int y = 0; y < bricks[1]; ++y)
      for (int x = 0; x < bricks[0]; ++x) {
        if (field.brick(field.brick_index(x, y, z)) == Field::all_outside) continue;
        bool all_solid = true;
        for (int part = 0; part < 8; ++part) {
          const int i0 = (part & 1) * side, j0 = (part >> 1 & 1) * side, k0 = (part >> 2) * side;
          const std::array<int, 3> at{x + (part & 1), y + (part >> 1 & 1), z + (part >> 2)};
          const bool exists = at[0] < bricks[0] && at[1] < bricks[1] && at[2] < bricks[2];
          const int32_t block = exists ? field.brick(field.brick_index(at[0], at[1], at[2])) : Field::all_outside;
          all_solid = all_solid && block == Field::all_inside;
          for (int k = k0; k < std::min(k0 + side, reach); ++k)
            for (int j = j0; j < std::min(j0 + side, reach); ++j)
              for (int i = i0; i < std::min(i0 + side, reach); ++i)
                solid[static_cast<size_t>((k * reach + j) * reach + i)] =
                    block < 0 ? block == Field::all_inside
                              : field.block(block)[((k - k0) * side + j - j0) * side + i - i0] < 0;
        }
        if (all_solid) continue;  // each of its samples adds 1 - 3 + 3 - 1
        for (int k = 0; k < side; ++k)
          for (int j = 0; j < side; ++j)
            for (int i = 0; i < side; ++i) {
              const uint8_t* s = &solid[static_cast<size_t>((k * reach + j) * reach + i)];
              if (s[0] == 0) continue;
              constexpr int up = reach, far = reach * reach;
              const int xy = s[1] & s[up], xz = s[1] & s[far], yz = s[up] & s[far];
              const int square_xy = xy & s[1 + up], square_xz = xz & s[1 + far], square_yz = yz & s[up + far];
              number += 1 - (s[1] + s[up] + s[far]) + (square_xy + square_xz + square_yz) -
                        (square_xy & square_xz & square_yz & s[1 + up + far]);
            }
      }
  return number;
}

size_t flip_small_layers(Field& field, bool inside, double area_m2, const Work& work) {
  const auto parts = Growth(field, inside, work).run();
  const double sample_m2 = field.grid().voxel_m * field.grid().voxel_m;
  // Half a voxel from the surface: nearer, opposite sides of a cut would touch once they are smoothed.
  const auto flipped_m = static_cast<float>(0.5 * field.grid().voxel_m);
  size_t flipped = 0;
  for (const auto& part : parts) {
    if (static_cast<double>(part.size()) * sample_m2 > area_m2) continue;
    for (const auto& [i, j, k] : part) {
      const int32_t block = field.brick(field.brick_index(i / side, j / side, k / side));
      if (block < 0) continue;
      float& value = field.block(block)[((k % side) * side + j % side) * side + i % side];
      value = inside ? flipped_m : -flipped_m;
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
  if (euler_number(field) == without_handles) return removed;
  removed.filled_samples = flip_small_layers(field, false, options.area_m2, work);
  if (euler_number(field) == without_handles) return removed;
  removed.cut_samples = flip_small_layers(field, true, options.area_m2, work);
  return removed;
}

}  // namespace booth
