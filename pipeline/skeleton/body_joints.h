#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>

namespace booth {

enum Side : size_t { left = 0, right = 1 };

/// +1 for the left side, which lies towards +X, −1 for the right one.
inline double sign(size_t side) { return side == left ? 1 : -1; }

// Places of joints and of the ends of bones, world frame, metres.

struct TrunkJoints {
  Eigen::Vector3d pelvis = Eigen::Vector3d::Zero();  ///< between the hip joints; not a joint itself
  Eigen::Vector3d hips = Eigen::Vector3d::Zero(), spine = Eigen::Vector3d::Zero(), spine1 = Eigen::Vector3d::Zero(),
                  spine2 = Eigen::Vector3d::Zero(), neck = Eigen::Vector3d::Zero(), head = Eigen::Vector3d::Zero(),
                  crown = Eigen::Vector3d::Zero();
};
struct ArmJoints {
  Eigen::Vector3d clavicle = Eigen::Vector3d::Zero(), shoulder = Eigen::Vector3d::Zero(),
                  elbow = Eigen::Vector3d::Zero(), wrist = Eigen::Vector3d::Zero(), fingers = Eigen::Vector3d::Zero();
};
struct LegJoints {
  Eigen::Vector3d hip = Eigen::Vector3d::Zero(), knee = Eigen::Vector3d::Zero(), ankle = Eigen::Vector3d::Zero(),
                  ball = Eigen::Vector3d::Zero(), toes = Eigen::Vector3d::Zero();
};

/// Arms and legs by Side.
struct BodyJoints {
  TrunkJoints trunk;
  std::array<ArmJoints, 2> arms;
  std::array<LegJoints, 2> legs;
};

}  // namespace booth
