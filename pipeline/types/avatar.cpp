#include "pipeline/types/avatar.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace booth {
namespace {

Error invalid(std::string message) { return {ErrorCode::invalid_argument, std::move(message)}; }

}  // namespace

int Skeleton::find(const std::string& name) const {
  for (size_t j = 0; j < joints.size(); ++j)
    if (joints[j].name == name) return static_cast<int>(j);
  return -1;
}

std::vector<Eigen::Isometry3d> world_from_joints(const Skeleton& skeleton) {
  std::vector<Eigen::Isometry3d> world;
  world.reserve(skeleton.joints.size());
  for (const Joint& joint : skeleton.joints)
    world.push_back(joint.parent < 0 ? joint.parent_from_joint
                                     : world[static_cast<size_t>(joint.parent)] * joint.parent_from_joint);
  return world;
}

Result<void> check(const Skeleton& skeleton) {
  std::set<std::string> names;
  for (size_t j = 0; j < skeleton.joints.size(); ++j) {
    const Joint& joint = skeleton.joints[j];
    if (joint.name.empty() || !names.insert(joint.name).second)
      return invalid("skeleton: joint " + std::to_string(j) + " needs a name of its own");
    if ((joint.parent < 0) != (j == 0) || joint.parent >= static_cast<int>(j))
      return invalid("skeleton: " + joint.name + " must follow its parent, and the first joint alone has none");
    const Eigen::Matrix3d rotation = joint.parent_from_joint.linear();
    if (!joint.parent_from_joint.matrix().allFinite() ||
        !(rotation * rotation.transpose()).isApprox(Eigen::Matrix3d::Identity(), 1e-6) || rotation.determinant() < 0)
      return invalid("skeleton: " + joint.name + " does not have a rigid transform");
  }
  return {};
}

Result<void> check(const Skin& skin, size_t vertices, size_t joints) {
  if (skin.influences.size() != vertices)
    return invalid("skin: " + std::to_string(skin.influences.size()) + " entries for " + std::to_string(vertices) +
                   " vertices");
  for (size_t v = 0; v < vertices; ++v) {
    const JointInfluences& entry = skin.influences[v];
    const auto here = [&] { return "skin: vertex " + std::to_string(v); };
    double sum = 0;
    for (size_t k = 0; k < 4; ++k) {
      if (!(entry.weight[k] >= 0 && entry.weight[k] <= 1.0001F)) return invalid(here() + " has a weight outside 0 … 1");
      if (k > 0 && entry.weight[k] > entry.weight[k - 1]) return invalid(here() + " has weights out of order");
      if (entry.joint[k] >= joints) return invalid(here() + " names a joint that is not there");
      for (size_t other = 0; other < k; ++other)
        if (entry.weight[k] > 0 && entry.joint[k] == entry.joint[other]) return invalid(here() + " repeats a joint");
      sum += static_cast<double>(entry.weight[k]);
    }
    if (std::abs(sum - 1) > 1e-4) return invalid(here() + " has weights that do not sum to 1");
  }
  return {};
}

Result<void> check(const std::vector<MorphTarget>& morphs, size_t vertices) {
  for (size_t m = 0; m < morphs.size(); ++m) {
    const MorphTarget& morph = morphs[m];
    const auto same_name = [&](const MorphTarget& other) { return other.name == morph.name; };
    if (morph.name.empty() || std::any_of(morphs.begin(), morphs.begin() + static_cast<std::ptrdiff_t>(m), same_name))
      return invalid("morphs: needs unique names, not \"" + morph.name + "\" again");
    if (morph.offsets.size() != morph.vertices.size())
      return invalid("morphs: " + morph.name + " needs an offset for every vertex");
    for (size_t i = 0; i < morph.vertices.size(); ++i) {
      if (morph.vertices[i] >= vertices || (i > 0 && morph.vertices[i] <= morph.vertices[i - 1]))
        return invalid("morphs: " + morph.name + " needs ascending vertices of the mesh");
      if (!morph.offsets[i].allFinite()) return invalid("morphs: " + morph.name + " has an offset that is not finite");
    }
  }
  return {};
}

Result<void> check(const Avatar& avatar) {
  if (const auto checked = check(avatar.mesh); !checked) return checked;
  if (const auto checked = check(avatar.morphs, avatar.mesh.positions.size()); !checked) return checked;
  if (avatar.atlas.image.channels != 3 || avatar.atlas.image.empty()) return invalid("atlas: needs an RGB image");
  if (avatar.atlas.uv.size() != avatar.mesh.triangles.size()) return invalid("atlas: needs a uv for every corner");
  for (size_t t = 0; t < avatar.atlas.uv.size(); ++t)
    for (const Eigen::Vector2f& uv : avatar.atlas.uv[t])
      if (!((uv.array() >= 0).all() && (uv.array() <= 1).all()))
        return invalid("atlas: triangle " + std::to_string(t) + " has a uv outside 0 … 1");
  if (avatar.skeleton.joints.empty())
    return avatar.skin.influences.empty() ? Result<void>() : invalid("skin: weights without a skeleton");
  if (const auto checked = check(avatar.skeleton); !checked) return checked;
  return check(avatar.skin, avatar.mesh.positions.size(), avatar.skeleton.joints.size());
}

}  // namespace booth
