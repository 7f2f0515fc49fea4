#include "pipeline/types/field.h"

#include <gtest/gtest.h>

namespace booth {
namespace {

TEST(Field, SamplesLieWhereTheGridSays) {
  const Grid grid{Eigen::Vector3d(1, 2, 3), 0.5, {10, 9, 17}};
  EXPECT_EQ(grid.point(2, 4, 6), Eigen::Vector3d(2, 4, 6));
  const Field field(grid);
  EXPECT_EQ(field.bricks(), (std::array<int, 3>{2, 2, 3}));
  EXPECT_EQ(field.blocks(), 0U);
}

TEST(Field, BricksThatAreNotStoredHaveOneValue) {
  Field field(Grid{Eigen::Vector3d::Zero(), 1, {16, 16, 16}});
  EXPECT_EQ(field.at(3, 12, 15), 1.0F);
  field.set_brick(field.brick_index(0, 1, 1), Field::all_inside);
  EXPECT_EQ(field.at(3, 12, 15), -1.0F);
  EXPECT_EQ(field.at(8, 12, 15), 1.0F);
}

TEST(Field, AStoredSampleIsFoundAtItsPlace) {
  Field field(Grid{Eigen::Vector3d::Zero(), 1, {24, 24, 24}});
  field.allocate_blocks(2);
  field.set_brick(field.brick_index(1, 2, 0), 1);
  field.block(1)[(5 * Field::brick_side + 1) * Field::brick_side + 3] = -0.25F;
  EXPECT_EQ(field.at(11, 17, 5), -0.25F);
  EXPECT_EQ(field.at(11, 17, 6), 1.0F);
}

}  // namespace
}  // namespace booth
