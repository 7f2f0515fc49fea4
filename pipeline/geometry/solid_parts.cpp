#include "pipeline/geometry/solid_parts.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

namespace booth {
namespace {

constexpr int side = Field::brick_side;
constexpr int samples_per_brick = static_cast<int>(Field::samples_per_brick);
constexpr std::array<int, 3> stride{1, side, side* side};

/// The connected parts of one stored block: a part's number for every sample.
struct BlockParts {
  std::array<uint16_t, Field::samples_per_brick> part;
  std::vector<uint16_t> inside_samples;  ///< by part; 0 for one outside
  uint16_t parts = 0;
};

int along(int sample, int axis) { return sample / stride[static_cast<size_t>(axis)] % side; }

void label(const float* values, BlockParts& block) {
  constexpr uint16_t none = 0xFFFF;
  block.part.fill(none);
  std::array<uint16_t, Field::samples_per_brick> waiting;
  for (int seed = 0; seed < samples_per_brick; ++seed) {
    if (block.part[static_cast<size_t>(seed)] != none) continue;
    const bool inside = values[seed] < 0;
    size_t count = 0, labelled = 0;
    waiting[count++] = static_cast<uint16_t>(seed);
    block.part[static_cast<size_t>(seed)] = block.parts;
    while (count > 0) {
      const int sample = waiting[--count];
      ++labelled;
      for (int axis = 0; axis < 3; ++axis)
        for (const int way : {-1, 1}) {
          const int place = along(sample, axis) + way;
          if (place < 0 || place >= side) continue;
          const int next = sample + way * stride[static_cast<size_t>(axis)];
          if ((values[next] < 0) != inside || block.part[static_cast<size_t>(next)] != none) continue;
          block.part[static_cast<size_t>(next)] = block.parts;
          waiting[count++] = static_cast<uint16_t>(next);
        }
    }
    ++block.parts;
    block.inside_samples.push_back(static_cast<uint16_t>(inside ? labelled : 0));
  }
}

/// All parts of all bricks as nodes of one graph: bricks that are not stored have one each.
class Parts {
 public:
  Parts(const Field& field, const Work& work) : field_(field), blocks_(field.blocks()) {
    constexpr size_t grain = 32;
    work.parallel_for(blocks_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t b = begin; b < end; ++b) label(field_.block(static_cast<int32_t>(b)), blocks_[b]);
    });
    const auto bricks = field.bricks();
    const size_t count =
        static_cast<size_t>(bricks[0]) * static_cast<size_t>(bricks[1]) * static_cast<size_t>(bricks[2]);
    first_.resize(count);
    uint32_t nodes = 0;
    for (size_t index = 0; index < count; ++index) {
      first_[index] = nodes;
      nodes += field.brick(index) >= 0 ? blocks_[static_cast<size_t>(field.brick(index))].parts : 1;
    }
    parent_.resize(nodes);
    std::iota(parent_.begin(), parent_.end(), 0U);
    for_each_contact([&](size_t a, int sample_a, size_t b, int sample_b) {
      if (inside(a, sample_a) == inside(b, sample_b)) join(node(a, sample_a), node(b, sample_b));
    });
    measure();
  }

  uint32_t find(uint32_t node) {
    while (parent_[node] != node) node = parent_[node] = parent_[parent_[node]];
    return node;
  }
  /// Joins all that touches, inside or outside, except the part of that root.
  void join_all_but(uint32_t root) {
    const auto join_unless = [&](uint32_t a, uint32_t b) {
      const uint32_t root_a = find(a), root_b = find(b);
      if (root_a != root && root_b != root && root_a != root_b) join(a, b);
    };
    for_each_contact(
        [&](size_t a, int sample_a, size_t b, int sample_b) { join_unless(node(a, sample_a), node(b, sample_b)); });
    for_each_brick([&](const std::array<int, 3>&, size_t brick) {
      // One or two parts cannot both be other than `root` unless a neighbour brought them: look only where they are.
      uint32_t others = 0;
      for (uint32_t part = 0; part < part_nodes(brick); ++part) others += find(first_[brick] + part) != root;
      if (others < 2) return;
      for (int axis = 0; axis < 3; ++axis)
        for (int sample = 0; sample < samples_per_brick; ++sample)
          if (along(sample, axis) + 1 < side)
            join_unless(node(brick, sample), node(brick, sample + stride[static_cast<size_t>(axis)]));
    });
  }
  uint32_t node(size_t brick, int sample) const {
    const int32_t block = field_.brick(brick);
    return first_[brick] + (block >= 0 ? blocks_[static_cast<size_t>(block)].part[static_cast<size_t>(sample)] : 0U);
  }
  bool inside(size_t brick, int sample) const {
    const int32_t block = field_.brick(brick);
    return block >= 0 ? field_.block(block)[sample] < 0 : block == Field::all_inside;
  }
  uint32_t first_node(size_t brick) const { return first_[brick]; }
  uint32_t part_nodes(size_t brick) const {
    const int32_t block = field_.brick(brick);
    return block >= 0 ? blocks_[static_cast<size_t>(block)].parts : 1U;
  }
  /// Samples inside, by root; 0 for parts of the outside.
  const std::vector<size_t>& inside_samples() const { return inside_samples_; }

 private:
  template <class Visitor>
  void for_each_brick(const Visitor& visit) const {
    const auto bricks = field_.bricks();
    for (int z = 0; z < bricks[2]; ++z)
      for (int y = 0; y < bricks[1]; ++y)
        for (int x = 0; x < bricks[0]; ++x) visit(std::array{x, y, z}, field_.brick_index(x, y, z));
  }

  static constexpr uint32_t none = std::numeric_limits<uint32_t>::max();

  /// Calls `visit` with a sample of one brick and the sample beside it of the next, at least once for every two parts
  /// that touch.
  template <class Visitor>
  void for_each_contact(const Visitor& visit) const {
    for_each_brick([&](const std::array<int, 3>& place, size_t brick) {
      for (int axis = 0; axis < 3; ++axis) {
        std::array<int, 3> next = place;
        if (++next[static_cast<size_t>(axis)] == field_.bricks()[static_cast<size_t>(axis)]) continue;
        const size_t other = field_.brick_index(next[0], next[1], next[2]);
        const int step = stride[static_cast<size_t>(axis)];
        if (field_.brick(brick) < 0 && field_.brick(other) < 0) {  // all their samples alike
          visit(brick, (side - 1) * step, other, 0);
          continue;
        }
        const int low = axis == 0 ? side : 1, high = axis == 2 ? side : side * side;  // strides along the face
        uint32_t last_node = none, last_other = none;
        for (int n = 0; n < side * side; ++n) {
          const int sample = n % side * low + n / side * high;
          const int own = sample + (side - 1) * step;
          // Most samples of a face repeat what the one before them told.
          const uint32_t to = node(other, sample), from = node(brick, own);
          if (from == last_node && to == last_other) continue;
          last_node = from;
          last_other = to;
          visit(brick, own, other, sample);
        }
      }
    });
  }

  void join(uint32_t a, uint32_t b) { parent_[find(a)] = find(b); }

  void measure() {
    inside_samples_.assign(parent_.size(), 0);
    for_each_brick([&](const std::array<int, 3>&, size_t brick) {
      if (field_.brick(brick) == Field::all_outside) return;
      if (field_.brick(brick) == Field::all_inside) {
        inside_samples_[find(first_[brick])] += Field::samples_per_brick;
        return;
      }
      const BlockParts& block = blocks_[static_cast<size_t>(field_.brick(brick))];
      for (uint32_t part = 0; part < block.parts; ++part)
        inside_samples_[find(first_[brick] + part)] += block.inside_samples[part];
    });
  }

  const Field& field_;
  std::vector<BlockParts> blocks_;
  std::vector<uint32_t> first_;  ///< a brick's first node
  std::vector<uint32_t> parent_;
  std::vector<size_t> inside_samples_;
};

}  // namespace

SolidParts keep_largest_part(Field& field, const Work& work) {
  SolidParts result;
  if (field.bricks()[0] == 0) return result;
  Parts parts(field, work);
  const auto& sizes = parts.inside_samples();
  const auto largest = static_cast<uint32_t>(std::max_element(sizes.begin(), sizes.end()) - sizes.begin());
  result.kept_samples = sizes[largest];
  if (result.kept_samples == 0) return result;
  for (const size_t size : sizes) result.removed_samples += size;
  result.removed_samples -= result.kept_samples;

  // What is left after taking the largest part away falls into the outside and the cavities, each with the parts that
  // float in it.
  parts.join_all_but(largest);
  const uint32_t outside = parts.find(parts.node(0, 0));
  const auto bricks = field.bricks();
  const size_t count = static_cast<size_t>(bricks[0]) * static_cast<size_t>(bricks[1]) * static_cast<size_t>(bricks[2]);
  std::vector<bool> part_inside;
  for (size_t brick = 0; brick < count; ++brick) {
    if (field.brick(brick) < 0) {
      const bool was_inside = field.brick(brick) == Field::all_inside;
      const bool is_inside = parts.find(parts.node(brick, 0)) != outside;
      if (is_inside && !was_inside) result.filled_samples += Field::samples_per_brick;
      field.set_brick(brick, is_inside ? Field::all_inside : Field::all_outside);
      continue;
    }
    const uint32_t first = parts.first_node(brick);
    part_inside.resize(parts.part_nodes(brick));
    for (uint32_t part = 0; part < part_inside.size(); ++part) part_inside[part] = parts.find(first + part) != outside;
    float* values = field.block(field.brick(brick));
    for (int sample = 0; sample < samples_per_brick; ++sample) {
      float& value = values[sample];
      const bool is_inside = part_inside[parts.node(brick, sample) - first];
      if (is_inside && value >= 0) ++result.filled_samples;
      const float magnitude = std::max(std::abs(value), std::numeric_limits<float>::min());
      value = is_inside ? -magnitude : magnitude;
    }
  }
  return result;
}

}  // namespace booth
