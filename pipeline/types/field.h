#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace booth {

/// Sample points in the world frame: sample (i, j, k) lies at origin + voxel_m · (i, j, k).
struct Grid {
  Eigen::Vector3d origin = Eigen::Vector3d::Zero();
  double voxel_m = 0;
  std::array<int, 3> size{0, 0, 0};  ///< samples along x, y, z

  Eigen::Vector3d point(int i, int j, int k) const { return origin + voxel_m * Eigen::Vector3d(i, j, k); }
};

/// Scalar samples on a grid, negative inside the solid, its surface where they change sign. Only bricks of
/// `brick_side`³ samples that the surface passes near are stored; all others are wholly inside or outside, so
/// memory grows with the surface and not with the volume.
class Field {
 public:
  static constexpr int brick_side = 8;
  static constexpr int32_t all_outside = -1;
  static constexpr int32_t all_inside = -2;

  Field() = default;
  /// Every brick outside.
  explicit Field(const Grid& grid);

  const Grid& grid() const { return grid_; }
  /// Bricks along x, y, z.
  const std::array<int, 3>& bricks() const { return bricks_; }

  /// The value of a sample in 0 ≤ (i, j, k) < grid().size; +1 and −1 in bricks that are not stored.
  float at(int i, int j, int k) const;

  /// A brick's number, from its place along x, y, z.
  size_t brick_index(int bx, int by, int bz) const {
    return (static_cast<size_t>(bz) * static_cast<size_t>(bricks_[1]) + static_cast<size_t>(by)) *
               static_cast<size_t>(bricks_[0]) +
           static_cast<size_t>(bx);
  }
  /// Which block of samples a brick has, or all_outside / all_inside.
  int32_t brick(size_t index) const { return brick_of_[index]; }
  void set_brick(size_t index, int32_t block) { brick_of_[index] = block; }
  /// Room for that many blocks; set_brick refers to them by number.
  void allocate_blocks(size_t count) { samples_.assign(count * samples_per_brick, 1.0F); }
  /// The 8 × 8 × 8 samples of a block, x fastest.
  float* block(int32_t number) { return samples_.data() + static_cast<size_t>(number) * samples_per_brick; }
  const float* block(int32_t number) const { return samples_.data() + static_cast<size_t>(number) * samples_per_brick; }
  size_t blocks() const { return samples_.size() / samples_per_brick; }

  static constexpr size_t samples_per_brick = size_t{brick_side} * brick_side * brick_side;

 private:
  Grid grid_;
  std::array<int, 3> bricks_{0, 0, 0};
  std::vector<int32_t> brick_of_;
  std::vector<float> samples_;
};

}  // namespace booth
