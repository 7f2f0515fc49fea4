#include "pipeline/geometry/solid_parts.h"

#include <gtest/gtest.h>

namespace booth {
namespace {

/// 24 × 24 × 24 samples: +1, and −1 in boxes.
class Boxes {
 public:
  Boxes() : field_(Grid{Eigen::Vector3d::Zero(), 0.01, {24, 24, 24}}) {
    field_.allocate_blocks(27);
    for (size_t b = 0; b < 27; ++b) field_.set_brick(b, static_cast<int32_t>(b));
  }
  Boxes& set(const std::array<int, 3>& first, const std::array<int, 3>& last, float value) {
    constexpr int side = Field::brick_side;
    for (int k = first[2]; k <= last[2]; ++k)
      for (int j = first[1]; j <= last[1]; ++j)
        for (int i = first[0]; i <= last[0]; ++i) {
          float* block = field_.block(field_.brick(field_.brick_index(i / side, j / side, k / side)));
          block[((k % side) * side + j % side) * side + i % side] = value;
        }
    return *this;
  }
  Field& field() { return field_; }

 private:
  Field field_;
};

size_t count_inside(const Field& field) {
  size_t inside = 0;
  const auto& size = field.grid().size;
  for (int k = 0; k < size[2]; ++k)
    for (int j = 0; j < size[1]; ++j)
      for (int i = 0; i < size[0]; ++i) inside += field.at(i, j, k) < 0;
  return inside;
}

TEST(SolidParts, TheLargestStaysAndTheOthersGo) {
  Boxes boxes;
  boxes.set({2, 2, 2}, {12, 12, 12}, -1).set({14, 14, 14}, {20, 20, 20}, -1);
  const SolidParts parts = keep_largest_part(boxes.field());
  EXPECT_EQ(parts.kept_samples, 11U * 11 * 11);
  EXPECT_EQ(parts.removed_samples, 7U * 7 * 7);
  EXPECT_EQ(parts.filled_samples, 0U);
  EXPECT_EQ(count_inside(boxes.field()), 11U * 11 * 11);
}

TEST(SolidParts, PartsThatTouchOverACornerOnlyAreTwo) {
  Boxes boxes;
  boxes.set({2, 2, 2}, {12, 12, 12}, -1).set({13, 13, 13}, {16, 16, 16}, -1);
  keep_largest_part(boxes.field());
  EXPECT_EQ(count_inside(boxes.field()), 11U * 11 * 11);
}

TEST(SolidParts, CavitiesAreFilledWithWhatFloatsInThem) {
  Boxes boxes;
  boxes.set({2, 2, 2}, {20, 20, 20}, -1).set({5, 5, 5}, {17, 17, 17}, 1).set({9, 9, 9}, {11, 11, 11}, -1);
  const SolidParts parts = keep_largest_part(boxes.field());
  EXPECT_EQ(count_inside(boxes.field()), 19U * 19 * 19);
  EXPECT_EQ(parts.removed_samples, 27U);
  EXPECT_EQ(parts.filled_samples, 13U * 13 * 13 - 27);
}

TEST(SolidParts, AHollowPartThatGoesLeavesNothing) {
  Boxes boxes;
  boxes.set({1, 1, 1}, {10, 10, 10}, -1);
  boxes.set({13, 13, 13}, {20, 20, 20}, -1).set({15, 15, 15}, {18, 18, 18}, 1);
  keep_largest_part(boxes.field());
  EXPECT_EQ(count_inside(boxes.field()), 1000U);
}

TEST(SolidParts, BricksThatAreNotStoredBelongToParts) {
  Field field(Grid{Eigen::Vector3d::Zero(), 0.01, {40, 40, 40}});
  for (const auto& place : {std::array{1, 1, 1}, std::array{2, 1, 1}, std::array{1, 3, 3}})
    field.set_brick(field.brick_index(place[0], place[1], place[2]), Field::all_inside);
  const SolidParts parts = keep_largest_part(field);
  EXPECT_EQ(parts.kept_samples, 2U * 512);
  EXPECT_EQ(parts.removed_samples, 512U);
  EXPECT_EQ(count_inside(field), 1024U);
}

TEST(SolidParts, NothingInsideIsNoPart) {
  Field field(Grid{Eigen::Vector3d::Zero(), 0.01, {40, 40, 40}});
  EXPECT_EQ(keep_largest_part(field).kept_samples, 0U);
  Field none;
  EXPECT_EQ(keep_largest_part(none).kept_samples, 0U);
}

}  // namespace
}  // namespace booth
