#include "tests/synthetic/body.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

namespace booth::synthetic {
namespace {

double signed_distance(const Capsule& c, const Eigen::Vector3d& p) {
  const Eigen::Vector3d axis = c.to - c.from;
  const double length2 = axis.squaredNorm();
  const double t = length2 > 0 ? std::clamp((p - c.from).dot(axis) / length2, 0.0, 1.0) : 0;
  return (p - (c.from + t * axis)).norm() - (c.from_radius_m + t * (c.to_radius_m - c.from_radius_m));
}

}  // namespace

double signed_distance(const Body& body, const Eigen::Vector3d& p) {
  double nearest = std::numeric_limits<double>::infinity();
  for (const Capsule& capsule : body) nearest = std::min(nearest, signed_distance(capsule, p));
  return nearest;
}

Eigen::AlignedBox3d bounds(const Body& body) {
  Eigen::AlignedBox3d box;
  for (const Capsule& c : body) {
    for (const auto& [center, radius] : {std::pair{c.from, c.from_radius_m}, std::pair{c.to, c.to_radius_m}}) {
      box.extend(center - Eigen::Vector3d::Constant(radius));
      box.extend(center + Eigen::Vector3d::Constant(radius));
    }
  }
  return box;
}

Body sphere(double radius_m) {
  const Eigen::Vector3d center(0, radius_m, 0);
  return {{center, center, radius_m, radius_m}};
}

Person person(const PersonOptions& options) {
  // Proportions of an adult, as shares of the height; girths as shares of the height too.
  const double h = options.height_m, g = h * options.girth;
  Person result;
  const auto add = [&](const Eigen::Vector3d& a, const Eigen::Vector3d& b, double ra, double rb) {
    result.body.push_back({a, b, ra * g, rb * g});
  };
  const auto joint = [&](const std::string& name, const Eigen::Vector3d& p) { result.joints.emplace_back(name, p); };

  const Eigen::Vector3d hips(0, 0.53 * h, 0), neck(0, 0.835 * h, -0.005 * h), head(0, 0.875 * h, 0);
  joint("Hips", hips);
  joint("Neck", neck);
  joint("Head", head);
  for (const double x : {-0.045 * h, 0.045 * h}) {  // two columns side by side make a torso wider than deep
    add({x, 0.53 * h, 0}, {x, 0.62 * h, 0}, 0.058, 0.052);
    add({x, 0.62 * h, 0}, {1.1 * x, 0.74 * h, 0}, 0.052, 0.058);
    add({1.1 * x, 0.74 * h, 0}, {x, 0.79 * h, 0}, 0.058, 0.035);
  }
  add({0, 0.78 * h, -0.005 * h}, {0, 0.89 * h, 0.005 * h}, 0.034, 0.032);
  add({0, 0.905 * h, 0.01 * h}, {0, 0.94 * h, 0}, 0.046, 0.056);
  add({0, 0.915 * h, 0.045 * h}, {0, 0.905 * h, 0.06 * h}, 0.012, 0.008);  // nose, so that it faces +Z
  for (const double side : {1.0, -1.0}) {
    const std::string name = side > 0 ? "Left" : "Right";
    const double sa = std::sin(options.arm_angle_rad), ca = std::cos(options.arm_angle_rad);
    const Eigen::Vector3d arm(side * sa, -ca, 0);
    const Eigen::Vector3d shoulder(side * 0.108 * h, 0.785 * h, 0);
    const Eigen::Vector3d elbow = shoulder + 0.172 * h * arm;
    const Eigen::Vector3d wrist = elbow + 0.148 * h * (arm + Eigen::Vector3d(0, 0, 0.12)).normalized();
    const Eigen::Vector3d fingertip = wrist + 0.10 * h * (arm + Eigen::Vector3d(0, 0, 0.15)).normalized();
    add({side * 0.03 * h, 0.79 * h, 0}, shoulder, 0.04, 0.034);
    add(shoulder, elbow, 0.032, 0.025);
    add(elbow, wrist, 0.025, 0.016);
    add(wrist, fingertip, 0.017, 0.011);
    joint(name + "Arm", shoulder);
    joint(name + "ForeArm", elbow);
    joint(name + "Hand", wrist);
    const double sl = std::sin(options.leg_angle_rad), cl = std::cos(options.leg_angle_rad);
    const Eigen::Vector3d hip(side * 0.055 * h, 0.52 * h, 0);
    const double shin_end = 0.045 * h;
    const double leg_length = (hip.y() - shin_end) / cl;
    const Eigen::Vector3d leg(side * sl, -cl, 0);
    const Eigen::Vector3d knee = hip + 0.5 * leg_length * leg, ankle = hip + leg_length * leg;
    add(hip, knee, 0.05, 0.036);
    add(knee, ankle, 0.034, 0.022);
    const double sole = 0.02 / options.girth;  // radius of the foot, so that it ends on the floor
    add({ankle.x(), sole * g, -0.02 * h}, {ankle.x() + side * 0.02 * h, sole * g, 0.10 * h}, sole, sole);
    joint(name + "UpLeg", hip);
    joint(name + "Leg", knee);
    joint(name + "Foot", ankle);
  }
  return result;
}

Field sample_field(const Body& body, double voxel_m) {
  const Eigen::AlignedBox3d box = bounds(body);
  Grid grid;
  grid.voxel_m = voxel_m;
  constexpr int margin = 2;
  grid.origin = box.min() - Eigen::Vector3d::Constant(margin * voxel_m);
  for (int axis = 0; axis < 3; ++axis)
    grid.size[static_cast<size_t>(axis)] = static_cast<int>(std::ceil(box.sizes()[axis] / voxel_m)) + 2 * margin + 1;
  Field field(grid);
  const auto [bricks_x, bricks_y, bricks_z] = field.bricks();
  const size_t count = static_cast<size_t>(bricks_x) * static_cast<size_t>(bricks_y) * static_cast<size_t>(bricks_z);
  field.allocate_blocks(count);
  constexpr int side = Field::brick_side;
  for (int bz = 0; bz < bricks_z; ++bz)
    for (int by = 0; by < bricks_y; ++by)
      for (int bx = 0; bx < bricks_x; ++bx) {
        const size_t index = field.brick_index(bx, by, bz);
        field.set_brick(index, static_cast<int32_t>(index));
        float* sample = field.block(static_cast<int32_t>(index));
        for (int k = 0; k < side; ++k)
          for (int j = 0; j < side; ++j)
            for (int i = 0; i < side; ++i)
              *sample++ =
                  static_cast<float>(signed_distance(body, grid.point(bx * side + i, by * side + j, bz * side + k)));
      }
  return field;
}

}  // namespace booth::synthetic
