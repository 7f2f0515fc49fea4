#pragma once

#include <Eigen/Geometry>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/types/field.h"
#include "pipeline/types/mesh.h"

namespace booth::synthetic {

/// A solid whose signed distance is known: the union of capsules with two radii each, metres, world frame.
struct Capsule {
  Eigen::Vector3d from, to;
  double from_radius_m = 0, to_radius_m = 0;
};
using Body = std::vector<Capsule>;

/// Signed distance to the union, negative inside; exact outside and for equal radii, a close bound otherwise.
double signed_distance(const Body& body, const Eigen::Vector3d& p);

/// The smallest box around the body.
Eigen::AlignedBox3d bounds(const Body& body);

/// A ball that stands on the floor.
Body sphere(double radius_m);

/// How the person stands.
struct PersonOptions {
  double height_m = 1.75;
  double arm_angle_rad = 0.75;  ///< of the arms from straight down
  double leg_angle_rad = 0.08;  ///< of the legs from straight down
  double girth = 1;             ///< scales all radii
};

/// A standing person of about 25 capsules in an A-pose, facing +Z, soles on y = 0, and where its joints are.
struct Person {
  Body body;
  /// Head, Neck, Hips, {Left,Right}{Arm,ForeArm,Hand,UpLeg,Leg,Foot}: positions by Mixamo's names.
  std::vector<std::pair<std::string, Eigen::Vector3d>> joints;
};
Person person(const PersonOptions& options = {});

/// The body's distance sampled on a grid around it, every brick stored; positive on the border.
Field sample_field(const Body& body, double voxel_m);

}  // namespace booth::synthetic
