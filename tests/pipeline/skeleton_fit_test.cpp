#include "pipeline/skeleton/skeleton_fit.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/geometry/interior.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/people.h"

namespace booth {
namespace {

using Eigen::Vector3d;
using synthetic::Body;
using synthetic::Person;
using synthetic::PersonOptions;

constexpr double stature_m = 1.75;

/// The body's surface as a mesh of some 10,000 triangles whatever its size.
Mesh surface_of(const Body& body) {
  return extract_surface(synthetic::sample_field(body, synthetic::bounds(body).sizes().y() / 80));
}

struct Fitted {
  Skeleton skeleton;
  std::vector<std::string> warnings;
  std::map<std::string, Vector3d> joints;  // by name, world frame
};

Fitted fitted(const Mesh& mesh) {
  auto result = fit_skeleton(mesh, {});
  EXPECT_TRUE(result) << result.error().message;
  if (!result) return {};
  Fitted fit{result->skeleton, result->warnings, {}};
  const auto world = world_from_joints(fit.skeleton);
  for (size_t j = 0; j < world.size(); ++j) fit.joints[fit.skeleton.joints[j].name] = world[j].translation();
  return fit;
}

std::string refusal(const Mesh& mesh) {
  const auto result = fit_skeleton(mesh, {});
  if (result) return "";
  EXPECT_EQ(result.error().code, ErrorCode::not_riggable);
  return result.error().message;
}

/// Every joint the person is known to have lies within `tolerance` of the stature.
void expect_joints_near(const Fitted& fit, const Person& person, double tolerance) {
  const double stature = synthetic::bounds(person.body).sizes().y();
  for (const auto& [name, known] : person.joints) {
    // Where the pelvis' joint lies between belly and back is a convention.
    Vector3d off = fit.joints.at(name) - known;
    if (name == "Hips") off.z() = 0;
    EXPECT_LT(off.norm() / stature, tolerance) << name << " is off by " << off.transpose();
  }
}

void expect_inside(const Fitted& fit, const Mesh& mesh) {
  const Interior interior = sample_interior(mesh, 150);
  for (const auto& [name, p] : fit.joints) EXPECT_GT(interior.depth(p), 0) << name << " at " << p.transpose();
}

void expect_person(const Person& person, double tolerance) {
  const Mesh mesh = surface_of(person.body);
  const Fitted fit = fitted(mesh);
  if (fit.joints.empty()) return;
  expect_joints_near(fit, person, tolerance);
  expect_inside(fit, mesh);
}

Vector3d mirrored(const Vector3d& p) { return {-p.x(), p.y(), p.z()}; }

Mesh mirrored(Mesh mesh) {
  for (auto& p : mesh.positions) p.x() = -p.x();
  for (auto& t : mesh.triangles) std::swap(t[1], t[2]);
  return mesh;
}

std::string other_side(const std::string& name) {
  if (name.rfind("Left", 0) == 0) return "Right" + name.substr(4);
  if (name.rfind("Right", 0) == 0) return "Left" + name.substr(5);
  return name;
}

TEST(SkeletonFit, HasTheContractsJointsAndTree) {
  const Fitted fit = fitted(surface_of(synthetic::person().body));
  EXPECT_TRUE(check(fit.skeleton));
  const std::map<std::string, std::string> parents{
      {"Hips", ""},
      {"Spine", "Hips"},
      {"Spine1", "Spine"},
      {"Spine2", "Spine1"},
      {"Neck", "Spine2"},
      {"Head", "Neck"},
      {"HeadTop_End", "Head"},
      {"LeftShoulder", "Spine2"},
      {"LeftArm", "LeftShoulder"},
      {"LeftForeArm", "LeftArm"},
      {"LeftHand", "LeftForeArm"},
      {"RightShoulder", "Spine2"},
      {"RightArm", "RightShoulder"},
      {"RightForeArm", "RightArm"},
      {"RightHand", "RightForeArm"},
      {"LeftUpLeg", "Hips"},
      {"LeftLeg", "LeftUpLeg"},
      {"LeftFoot", "LeftLeg"},
      {"LeftToeBase", "LeftFoot"},
      {"RightUpLeg", "Hips"},
      {"RightLeg", "RightUpLeg"},
      {"RightFoot", "RightLeg"},
      {"RightToeBase", "RightFoot"},
  };
  ASSERT_EQ(fit.skeleton.joints.size(), parents.size());
  for (const Joint& joint : fit.skeleton.joints) {
    ASSERT_TRUE(parents.contains(joint.name)) << joint.name;
    const std::string parent = joint.parent < 0 ? "" : fit.skeleton.joints[static_cast<size_t>(joint.parent)].name;
    EXPECT_EQ(parent, parents.at(joint.name)) << joint.name;
  }
  for (const char* name : {"Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase"})
    EXPECT_GT(fit.joints.at(std::string("Left") + name).x(), fit.joints.at(std::string("Right") + name).x()) << name;
}

TEST(SkeletonFit, JointAxesFollowTheBonesAndMirror) {
  const Fitted fit = fitted(surface_of(synthetic::person().body));
  const auto world = world_from_joints(fit.skeleton);
  const auto of = [&](const std::string& name) { return world[static_cast<size_t>(fit.skeleton.find(name))]; };
  for (const auto& [joint, child] : std::vector<std::pair<std::string, std::string>>{{"Hips", "Spine"},
                                                                                     {"Spine2", "Neck"},
                                                                                     {"Head", "HeadTop_End"},
                                                                                     {"LeftArm", "LeftForeArm"},
                                                                                     {"RightForeArm", "RightHand"},
                                                                                     {"LeftUpLeg", "LeftLeg"},
                                                                                     {"RightFoot", "RightToeBase"}}) {
    const Vector3d bone = (of(child).translation() - of(joint).translation()).normalized();
    EXPECT_GT(bone.dot(of(joint).linear().col(1)), 0.999) << joint;
  }
  for (const std::string name : {"Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase"}) {
    const Eigen::Matrix3d left = of("Left" + name).linear(), right = of("Right" + name).linear();
    EXPECT_GT(left.col(0).dot(-mirrored(right.col(0))), 0.97) << name;
    EXPECT_GT(left.col(1).dot(mirrored(right.col(1))), 0.97) << name;
    EXPECT_GT(left.col(2).dot(mirrored(right.col(2))), 0.97) << name;
  }
}

TEST(SkeletonFit, FindsArmsAtAnyAngle) {
  for (const double angle : {0.26, 0.6, 1.1, 1.57}) {
    SCOPED_TRACE(angle);
    expect_person(synthetic::person({.arm_angle_rad = angle}), 0.035);
  }
}

TEST(SkeletonFit, FindsPeopleOfAllSizes) {
  for (const double height : {0.95, 1.4, 2.1}) {
    SCOPED_TRACE(height);
    expect_person(synthetic::person({.height_m = height}), 0.035);
  }
  for (const double girth : {0.8, 1.3}) {
    SCOPED_TRACE(girth);
    expect_person(synthetic::person({.girth = girth}), 0.045);
  }
}

TEST(SkeletonFit, FindsAStraddleAndClosedLegs) {
  for (const double angle : {0.02, 0.2}) {
    SCOPED_TRACE(angle);
    expect_person(synthetic::person({.leg_angle_rad = angle}), 0.035);
  }
}

TEST(SkeletonFit, FindsChildren) {
  for (const double height : {0.95, 1.1, 1.3}) {
    SCOPED_TRACE(height);
    expect_person(synthetic::child(height), 0.045);
  }
}

TEST(SkeletonFit, APonytailIsNotAHand) {
  Person person = synthetic::person();
  const double h = stature_m;
  person.body.push_back({{0, 0.93 * h, -0.06 * h}, {0, 0.92 * h, -0.12 * h}, 0.02 * h, 0.02 * h});
  person.body.push_back({{0, 0.92 * h, -0.12 * h}, {0, 0.78 * h, -0.15 * h}, 0.02 * h, 0.01 * h});
  expect_person(person, 0.04);
}

TEST(SkeletonFit, ASkirtHidesTheHipsOnly) {
  Person person = synthetic::person();
  const double h = stature_m;
  person.body.push_back({{0, 0.56 * h, 0}, {0, 0.33 * h, 0}, 0.10 * h, 0.15 * h});
  const Fitted fit = fitted(surface_of(person.body));
  expect_joints_near(fit, person, 0.045);
  EXPECT_THAT(fit.warnings, testing::Contains(testing::HasSubstr("skirt")));
}

TEST(SkeletonFit, ABagInTheHandIsNotPartOfTheArm) {
  Person person = synthetic::person();
  Vector3d hand = Vector3d::Zero();
  for (const auto& [name, p] : person.joints)
    if (name == "LeftHand") hand = p;
  person.body.push_back({hand + Vector3d(0.09, -0.17, 0.03), hand + Vector3d(0.09, -0.35, 0.03), 0.09, 0.1});
  const Fitted fit = fitted(surface_of(person.body));
  expect_joints_near(fit, person, 0.045);
  EXPECT_THAT(fit.warnings, testing::ElementsAre(testing::HasSubstr("left arm is too long")));
}

TEST(SkeletonFit, ArmsThatCannotBeSeenHangByProportions) {
  Person person = synthetic::person({.arm_angle_rad = 0.03});
  const double h = stature_m;
  for (const double side : {1.0, -1.0})  // a wide coat around trunk and arms
    person.body.push_back({{side * 0.08 * h, 0.76 * h, 0}, {side * 0.09 * h, 0.36 * h, 0.02 * h}, 0.07 * h, 0.08 * h});
  const Mesh mesh = surface_of(person.body);
  const Fitted fit = fitted(mesh);
  ASSERT_FALSE(fit.joints.empty());
  expect_inside(fit, mesh);
  EXPECT_THAT(fit.warnings, testing::Contains(testing::HasSubstr("left hand cannot be told")));
  for (const std::string side : {"Left", "Right"}) {
    EXPECT_GT(fit.joints.at(side + "Arm").y(), fit.joints.at(side + "ForeArm").y() + 0.1 * h);
    EXPECT_GT(fit.joints.at(side + "ForeArm").y(), fit.joints.at(side + "Hand").y() + 0.08 * h);
  }
}

TEST(SkeletonFit, TheMirroredBodyHasTheMirroredSkeleton) {
  Person person = synthetic::person();
  person.body.push_back({{0.13, 0.9, 0.05}, {0.15, 0.8, 0.05}, 0.08, 0.09});  // a bag makes it asymmetric
  const Mesh mesh = surface_of(person.body);
  const Fitted fit = fitted(mesh), twin = fitted(mirrored(mesh));
  for (const auto& [name, p] : fit.joints)
    EXPECT_LT((mirrored(twin.joints.at(other_side(name))) - p).norm(), 0.01 * stature_m) << name;
}

TEST(SkeletonFit, MovesWithTheBody) {
  Mesh mesh = surface_of(synthetic::person().body);
  const Fitted fit = fitted(mesh);
  const Eigen::Vector3f step(0.31F, 0.12F, -0.27F);
  for (auto& p : mesh.positions) p += step;
  const Fitted moved = fitted(mesh);
  for (const auto& [name, p] : fit.joints)
    EXPECT_LT((moved.joints.at(name) - step.cast<double>() - p).norm(), 0.004 * stature_m) << name;
}

TEST(SkeletonFit, StandsABodyThatIsTurned) {
  for (const double angle : {0.1, -0.5}) {
    SCOPED_TRACE(angle);
    Person person = synthetic::person();
    const Eigen::Matrix3d turn = Eigen::AngleAxisd(angle, Vector3d::UnitY()).toRotationMatrix();
    for (auto& capsule : person.body) {
      capsule.from = turn * capsule.from;
      capsule.to = turn * capsule.to;
    }
    for (auto& [name, p] : person.joints) p = turn * p;
    expect_person(person, 0.04);
  }
}

TEST(SkeletonFit, HandsOnTheHipsLeaveTheElbowsToFollow) {
  const Person person = synthetic::with_hands_on_hips();
  const Mesh mesh = surface_of(person.body);
  const Fitted fit = fitted(mesh);
  expect_joints_near(fit, person, 0.035);
  expect_inside(fit, mesh);
  EXPECT_THAT(fit.warnings, testing::Contains(testing::HasSubstr("left hand cannot be told")));
}

TEST(SkeletonFit, FindsHeavyPeople) { expect_person(synthetic::heavy_person(), 0.04); }

TEST(SkeletonFit, LongHairMovesNeitherHeadNorShoulders) { expect_person(synthetic::with_long_hair(), 0.035); }

TEST(SkeletonFit, AShoulderBagIsNeitherAnArmNorALeg) { expect_person(synthetic::with_shoulder_bag(), 0.045); }

TEST(SkeletonFit, ALongSkirtLeavesTheFeet) {
  const Person person = synthetic::in_long_skirt();
  const Fitted fit = fitted(surface_of(person.body));
  expect_joints_near(fit, person, 0.045);
  EXPECT_THAT(fit.warnings, testing::Contains(testing::HasSubstr("skirt")));
}

TEST(SkeletonFit, ArmsBesideTheBodyAreFoundByTheOutline) {
  for (const double angle : {0.05, 0.12, 0.2}) {
    SCOPED_TRACE(angle);
    expect_person(synthetic::person({.arm_angle_rad = angle}), 0.045);
  }
}

TEST(SkeletonFit, IgnoresCrumbsBesideTheBody) {
  Person person = synthetic::person();
  const Fitted fit = fitted(surface_of(person.body));
  person.body.push_back({{0.6, 1.5, 0.2}, {0.6, 1.5, 0.2}, 0.03, 0.03});
  const Fitted with_crumb = fitted(surface_of(person.body));
  for (const auto& [name, p] : fit.joints) EXPECT_LT((with_crumb.joints.at(name) - p).norm(), 0.02) << name;
}

TEST(SkeletonFit, TheMethodOfReferenceFindsTheLimbsRoughly) {
  for (const double arm_angle : {0.75, 1.5}) {
    SCOPED_TRACE(arm_angle);
    const Person person = synthetic::person({.arm_angle_rad = arm_angle});
    const auto result = fit_skeleton(surface_of(person.body), {.method = SkeletonMethod::embedding});
    ASSERT_TRUE(result) << result.error().message;
    EXPECT_TRUE(check(result->skeleton));
    const auto world = world_from_joints(result->skeleton);
    for (const auto& [name, known] : person.joints) {
      if (name == "Hips" || name == "Neck" || name == "Head") continue;
      const Vector3d found = world[static_cast<size_t>(result->skeleton.find(name))].translation();
      EXPECT_LT((found - known).norm() / stature_m, 0.08) << name << " is off by " << (found - known).transpose();
    }
  }
}

TEST(SkeletonFit, TheMethodOfReferenceSaysWhatItCannotEmbed) {
  const auto result = fit_skeleton(surface_of(synthetic::sphere(0.5)), {.method = SkeletonMethod::embedding});
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::not_riggable);
  EXPECT_THAT(result.error().message, testing::HasSubstr("skeleton: "));
}

TEST(SkeletonFit, RefusesWhatIsNoPerson) {
  EXPECT_THAT(refusal(surface_of(synthetic::sphere(0.5))), testing::HasSubstr("person"));
  EXPECT_THAT(refusal(surface_of({{{0, 0.2, 0}, {0, 1.6, 0}, 0.2, 0.2}})), testing::HasSubstr("neither two arms nor"));
  Body table;
  for (const double x : {-0.2, 0.2})
    for (const double z : {-0.15, 0.15}) table.push_back({{x, 0.03, z}, {x, 0.9, z}, 0.03, 0.03});
  for (const double x : {-0.2, -0.1, 0.0, 0.1, 0.2}) table.push_back({{x, 0.9, -0.15}, {x, 0.9, 0.15}, 0.07, 0.07});
  EXPECT_THAT(refusal(surface_of(table)), testing::HasSubstr("more than two legs"));
}

TEST(SkeletonFit, RefusesABox) {
  Mesh box;
  for (const float x : {-0.25F, 0.25F})
    for (const float y : {0.0F, 1.8F})
      for (const float z : {-0.15F, 0.15F}) box.positions.emplace_back(x, y, z);
  box.triangles = {{0, 1, 3}, {0, 3, 2}, {4, 6, 7}, {4, 7, 5}, {0, 4, 5}, {0, 5, 1},
                   {2, 3, 7}, {2, 7, 6}, {0, 2, 6}, {0, 6, 4}, {1, 5, 7}, {1, 7, 3}};
  EXPECT_NE(refusal(box), "");
}

TEST(SkeletonFit, RefusesEmptyFlatAndBrokenMeshes) {
  EXPECT_NE(refusal({}), "");
  Mesh flat;
  flat.positions = {{0, 0, 0}, {0.5F, 0, 0}, {0, 1.7F, 0}};
  flat.triangles = {{0, 1, 2}};
  EXPECT_NE(refusal(flat), "");
  Mesh broken = flat;
  broken.triangles = {{0, 1, 7}};
  const auto result = fit_skeleton(broken, {});
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::invalid_argument);
}

TEST(SkeletonFit, RefusesOptionsOutOfRange) {
  const auto result = fit_skeleton(surface_of(synthetic::sphere(0.5)), {.cells = 20});
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::invalid_argument);
}

}  // namespace
}  // namespace booth
