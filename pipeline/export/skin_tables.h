#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/types/avatar.h"

namespace booth {

/// A vertex's influences with weights as whole numbers of `weight_unit`-ths that sum to exactly `weight_unit`, so that
/// every format writes weights which sum to 1. Largest first; unused places have joint 0 and weight 0.
struct WholeInfluences {
  static constexpr int weight_unit = 100'000;  ///< moves nothing by more than 10 µm a metre

  std::array<uint16_t, 4> joint{0, 0, 0, 0};
  std::array<int, 4> weight{0, 0, 0, 0};
};

/// Skin and bind pose in the form that all formats share, so that the avatar deforms alike in each of them.
struct SkinTables {
  std::vector<WholeInfluences> influences;        ///< one a vertex of the mesh
  std::vector<Eigen::Matrix4f> joint_from_world;  ///< inverse bind matrices, one a joint
};

/// @pre check(avatar) holds, the avatar has joints
SkinTables make_skin_tables(const Avatar& avatar);

}  // namespace booth
