#include "tests/synthetic/avatar.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <string>

#include "tests/synthetic/scene.h"

namespace booth::synthetic {
namespace {

constexpr int hemisphere_rings = 3;
constexpr int rings = 2 * hemisphere_rings;  // between the poles

/// A capsule's surface by angle around its axis (0 … 1) and way along it (0 … 1, the poles at the ends).
class CapsuleSurface {
 public:
  explicit CapsuleSurface(const Capsule& capsule) : capsule_(capsule) {
    const Eigen::Vector3d axis = capsule.to - capsule.from;
    axis_ = axis.norm() > 0 ? Eigen::Vector3d(axis.normalized()) : Eigen::Vector3d::UnitY();
    across_ = axis_.unitOrthogonal();
    other_ = axis_.cross(across_);
  }

  /// Straight between the rings, as the mesh is.
  Eigen::Vector3d at(double around, double along) const {
    const double place = along * (rings + 1);
    const int ring = std::min(static_cast<int>(place), rings);
    const double share = place - ring;
    return (1 - share) * on_ring(around, ring) + share * on_ring(around, ring + 1);
  }

  /// How far along the ring `ring` (0 the first pole … rings + 1 the last one) lies.
  static double along(int ring) { return static_cast<double>(ring) / (rings + 1); }

 private:
  Eigen::Vector3d on_ring(double around, int ring) const {
    const bool first = 2 * ring <= rings;
    const double latitude = std::numbers::pi * (along(ring) - 0.5), angle = 2 * std::numbers::pi * around;
    const Eigen::Vector3d outwards = std::cos(angle) * across_ + std::sin(angle) * other_;
    return (first ? capsule_.from : capsule_.to) + (first ? capsule_.from_radius_m : capsule_.to_radius_m) *
                                                       (std::cos(latitude) * outwards + std::sin(latitude) * axis_);
  }

  Capsule capsule_;
  Eigen::Vector3d axis_, across_, other_;
};

/// A square of texels of the atlas.
struct Chart {
  int x = 0, y = 0, side = 0;
};

void add_surface(const CapsuleSurface& surface, int segments, const Chart& chart, Avatar& avatar) {
  Mesh& mesh = avatar.mesh;
  const auto base = static_cast<uint32_t>(mesh.positions.size());
  const auto add_vertex = [&](double around, double along) {
    mesh.positions.push_back(surface.at(around, along).cast<float>());
  };
  add_vertex(0, 0);
  for (int ring = 1; ring <= rings; ++ring)
    for (int s = 0; s < segments; ++s) add_vertex(static_cast<double>(s) / segments, CapsuleSurface::along(ring));
  add_vertex(0, 1);
  const auto vertex = [&](int ring, int s) {
    if (ring == 0) return base;
    if (ring > rings) return base + static_cast<uint32_t>(rings * segments) + 1;
    return base + 1 + static_cast<uint32_t>((ring - 1) * segments + s % segments);
  };
  // The chart's outermost texels are margin, so that bilinear samples stay inside.
  const auto uv = [&](int ring, double s) {
    const double side = avatar.atlas.image.width, inner = chart.side - 2;
    return Eigen::Vector2f(static_cast<float>((chart.x + 1 + inner * s / segments) / side),
                           static_cast<float>((chart.y + 1 + inner * CapsuleSurface::along(ring)) / side));
  };
  const auto add_triangle = [&](std::array<uint32_t, 3> corners, std::array<Eigen::Vector2f, 3> uvs) {
    mesh.triangles.push_back(corners);
    avatar.atlas.uv.push_back(uvs);
  };
  for (int ring = 0; ring <= rings; ++ring)
    for (int s = 0; s < segments; ++s) {
      if (ring > 0)
        add_triangle({vertex(ring, s), vertex(ring, s + 1), vertex(ring + 1, s)},
                     {uv(ring, s), uv(ring, s + 1), uv(ring + 1, ring == rings ? s + 0.5 : s)});
      if (ring < rings)
        add_triangle({vertex(ring, s + 1), vertex(ring + 1, s + 1), vertex(ring + 1, s)},
                     {uv(ring, ring == 0 ? s + 0.5 : s + 1), uv(ring + 1, s + 1), uv(ring + 1, s)});
    }
}

void paint(const CapsuleSurface& surface, const Chart& chart, Image& image) {
  const int inner = chart.side - 2;
  const auto share = [&](int texel) { return std::clamp((texel - 0.5) / inner, 0.0, 1.0); };
  for (int y = 0; y < chart.side; ++y)
    for (int x = 0; x < chart.side; ++x) {
      const Eigen::Vector3d colour = colour_at(surface.at(share(x), share(y)));
      for (int c = 0; c < 3; ++c)
        image.at(chart.x + x, chart.y + y, c) = static_cast<uint8_t>(std::lround(255 * colour[c]));
    }
}

Skeleton make_skeleton(const Person& subject) {
  const std::map<std::string, Eigen::Vector3d> place(subject.joints.begin(), subject.joints.end());
  std::vector<std::pair<std::string, std::string>> child_and_parent{{"Hips", ""}, {"Neck", "Hips"}, {"Head", "Neck"}};
  for (const std::string side : {"Left", "Right"})
    for (const auto& [child, parent] : {std::pair{"Arm", "Neck"},
                                        {"ForeArm", "Arm"},
                                        {"Hand", "ForeArm"},
                                        {"UpLeg", "Hips"},
                                        {"Leg", "UpLeg"},
                                        {"Foot", "Leg"}}) {
      const std::string above = parent;
      child_and_parent.emplace_back(side + child, above == "Neck" || above == "Hips" ? above : side + above);
    }
  Skeleton skeleton;
  std::vector<Eigen::Isometry3d> world;
  for (const auto& [name, parent] : child_and_parent) {
    Eigen::Isometry3d world_from_joint = Eigen::Isometry3d::Identity();
    const double turn_rad = 0.3 * static_cast<double>(world.size());
    world_from_joint.linear() = Eigen::AngleAxisd(turn_rad, Eigen::Vector3d(1, 2, -1).normalized()).toRotationMatrix();
    world_from_joint.translation() = place.at(name);
    Joint joint{.name = name, .parent = skeleton.find(parent), .parent_from_joint = world_from_joint};
    if (joint.parent >= 0)
      joint.parent_from_joint = world[static_cast<size_t>(joint.parent)].inverse() * world_from_joint;
    skeleton.joints.push_back(joint);
    world.push_back(world_from_joint);
  }
  return skeleton;
}

JointInfluences influences_at(const Eigen::Vector3d& p, const std::vector<Eigen::Isometry3d>& world_from_joint) {
  std::vector<std::pair<double, uint16_t>> nearest;
  for (size_t j = 0; j < world_from_joint.size(); ++j)
    nearest.emplace_back((world_from_joint[j].translation() - p).norm(), static_cast<uint16_t>(j));
  std::sort(nearest.begin(), nearest.end());
  constexpr double reach_m = 0.3;
  JointInfluences influences;
  double sum = 0;
  for (size_t k = 0; k < 4; ++k) {
    const double beyond = nearest[k].first - nearest[0].first;
    if (beyond >= reach_m) continue;
    influences.joint[k] = nearest[k].second;
    influences.weight[k] = static_cast<float>(1 - beyond / reach_m);
    sum += static_cast<double>(influences.weight[k]);
  }
  for (float& weight : influences.weight) weight = static_cast<float>(static_cast<double>(weight) / sum);
  return influences;
}

}  // namespace

Avatar make_avatar(const Person& subject, const AvatarOptions& options) {
  Avatar avatar;
  avatar.atlas.image = Image(options.atlas_side, options.atlas_side, 3, 128);
  const int charts_a_row = static_cast<int>(std::ceil(std::sqrt(static_cast<double>(subject.body.size()))));
  const int side = options.atlas_side / charts_a_row;
  for (size_t i = 0; i < subject.body.size(); ++i) {
    const int place = static_cast<int>(i);
    const Chart chart{.x = place % charts_a_row * side, .y = place / charts_a_row * side, .side = side};
    const CapsuleSurface surface(subject.body[i]);
    add_surface(surface, options.segments, chart, avatar);
    paint(surface, chart, avatar.atlas.image);
  }
  if (!options.rigged) return avatar;
  avatar.skeleton = make_skeleton(subject);
  const auto world = world_from_joints(avatar.skeleton);
  for (const Eigen::Vector3f& p : avatar.mesh.positions)
    avatar.skin.influences.push_back(influences_at(p.cast<double>(), world));
  return avatar;
}

}  // namespace booth::synthetic
