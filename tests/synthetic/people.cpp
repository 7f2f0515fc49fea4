#include "tests/synthetic/people.h"

#include <cmath>
#include <string>

namespace booth::synthetic {
namespace {

using Eigen::Vector3d;

constexpr double stature_m = 1.75;

}  // namespace

Person child(double height_m) {
  Person result = person({.height_m = height_m});
  const double hips = 0.52 * height_m, neck = 0.875 * height_m, leg_scale = 0.82, head_scale = 1.45;
  const auto lift = [&](Vector3d p) {
    if (p.y() > neck) p = Vector3d(0, neck, 0) + head_scale * (p - Vector3d(0, neck, 0));
    p.y() = p.y() < hips ? leg_scale * p.y() : p.y() - (1 - leg_scale) * hips;
    return p;
  };
  for (Capsule& capsule : result.body) {
    const double scale = capsule.from.y() > neck ? head_scale : 1;
    const double sole = capsule.from.y() < 0.03 * height_m ? (1 - leg_scale) * capsule.from.y() : 0;
    capsule = {lift(capsule.from) + Vector3d(0, sole, 0), lift(capsule.to) + Vector3d(0, sole, 0),
               scale * capsule.from_radius_m, scale * capsule.to_radius_m};
  }
  for (auto& [name, p] : result.joints) p = lift(p);
  return result;
}

Person heavy_person() {
  Person result = person({.arm_angle_rad = 0.9, .leg_angle_rad = 0.12, .girth = 1.2});
  const double h = stature_m;
  result.body.push_back({{0, 0.58 * h, 0.03 * h}, {0, 0.66 * h, 0.02 * h}, 0.105 * h, 0.095 * h});  // the belly
  return result;
}

Person in_long_skirt() {
  Person result = person();
  const double h = stature_m;
  result.body.push_back({{0, 0.56 * h, 0}, {0, 0.38 * h, 0}, 0.09 * h, 0.16 * h});
  result.body.push_back({{0, 0.38 * h, 0}, {0, 0.30 * h, 0}, 0.16 * h, 0.17 * h});
  return result;
}

Person with_long_hair() {
  Person result = person();
  const double h = stature_m;
  result.body.push_back({{0, 0.93 * h, -0.02 * h}, {0, 0.82 * h, -0.035 * h}, 0.062 * h, 0.06 * h});
  result.body.push_back({{0, 0.82 * h, -0.035 * h}, {0, 0.74 * h, -0.05 * h}, 0.06 * h, 0.045 * h});
  return result;
}

Person with_shoulder_bag() {
  Person result = person();
  const double h = stature_m;
  const Vector3d bag(0.12 * h, 0.47 * h, 0.03 * h);
  result.body.push_back({bag, bag - Vector3d(0, 0.05 * h, 0), 0.055 * h, 0.06 * h});
  result.body.push_back({bag, {-0.06 * h, 0.79 * h, 0.03 * h}, 0.015 * h, 0.015 * h});
  return result;
}

Person with_hands_on_hips() {
  Person result = person();
  std::erase_if(result.body, [](const Capsule& c) { return std::abs(c.from.x()) > 0.18; });
  for (const double side : {1.0, -1.0}) {
    const Vector3d shoulder(side * 0.189, 1.374, 0), elbow(side * 0.40, 1.17, -0.06), hand(side * 0.16, 0.97, 0.02);
    result.body.push_back({shoulder, elbow, 0.05, 0.04});
    result.body.push_back({elbow, hand, 0.04, 0.03});
    for (auto& [name, p] : result.joints)
      if (name == (side > 0 ? "LeftForeArm" : "RightForeArm")) p = elbow;
  }
  std::erase_if(result.joints, [](const auto& joint) { return joint.first.find("Hand") != std::string::npos; });
  return result;
}

}  // namespace booth::synthetic
