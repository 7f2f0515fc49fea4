#include "pipeline/types/field.h"

namespace booth {

Field::Field(const Grid& grid) : grid_(grid) {
  size_t count = 1;
  for (size_t axis = 0; axis < 3; ++axis) {
    bricks_[axis] = (grid.size[axis] + brick_side - 1) / brick_side;
    count *= static_cast<size_t>(bricks_[axis]);
  }
  brick_of_.assign(count, all_outside);
}

float Field::at(int i, int j, int k) const {
  const int32_t block_number = brick_of_[brick_index(i / brick_side, j / brick_side, k / brick_side)];
  if (block_number == all_outside) return 1.0F;
  if (block_number == all_inside) return -1.0F;
  const int x = i % brick_side, y = j % brick_side, z = k % brick_side;
  return block(block_number)[(z * brick_side + y) * brick_side + x];
}

}  // namespace booth
