#include "pipeline/export/skin_tables.h"

#include <cmath>
#include <numeric>

namespace booth {
namespace {

/// Rounds all but the largest weight, which takes what is left: at most four roundings of half a unit.
WholeInfluences to_whole(const JointInfluences& influences) {
  const float sum = std::accumulate(influences.weight.begin(), influences.weight.end(), 0.0F);
  WholeInfluences whole;
  whole.joint[0] = influences.joint[0];
  whole.weight[0] = WholeInfluences::weight_unit;
  for (size_t k = 1; k < 4; ++k) {
    whole.weight[k] = static_cast<int>(std::lround(WholeInfluences::weight_unit * influences.weight[k] / sum));
    whole.joint[k] = whole.weight[k] > 0 ? influences.joint[k] : uint16_t{0};
    whole.weight[0] -= whole.weight[k];
  }
  return whole;
}

}  // namespace

SkinTables make_skin_tables(const Avatar& avatar) {
  SkinTables tables;
  tables.influences.reserve(avatar.skin.influences.size());
  for (const JointInfluences& influences : avatar.skin.influences) tables.influences.push_back(to_whole(influences));
  for (const Eigen::Isometry3d& world_from_joint : world_from_joints(avatar.skeleton))
    tables.joint_from_world.push_back(world_from_joint.inverse().matrix().cast<float>());
  return tables;
}

}  // namespace booth
