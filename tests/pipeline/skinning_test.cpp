#include "pipeline/skin/skinning.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

using Eigen::Vector3d;
using synthetic::Person;

/// A skeleton of positions alone, all axes those of the world.
Skeleton skeleton_of(const std::vector<std::pair<std::string, Vector3d>>& joints, const std::vector<int>& parents) {
  Skeleton skeleton;
  for (size_t j = 0; j < joints.size(); ++j) {
    Joint joint{joints[j].first, parents[j], Eigen::Isometry3d::Identity()};
    const Vector3d origin = parents[j] < 0 ? Vector3d::Zero() : joints[static_cast<size_t>(parents[j])].second;
    joint.parent_from_joint.translation() = joints[j].second - origin;
    skeleton.joints.push_back(joint);
  }
  return skeleton;
}

/// The synthetic person's own skeleton; hands and feet end in joints of their own.
Skeleton skeleton_of(const Person& person) {
  const auto at = [&](const std::string& name) {
    for (const auto& [known, p] : person.joints)
      if (known == name) return p;
    return Vector3d(0, 0, 0);
  };
  const Vector3d hips = at("Hips"), neck = at("Neck"), head = at("Head");
  std::vector<std::pair<std::string, Vector3d>> joints{{"Hips", hips},
                                                       {"Spine", hips + 0.2 * (neck - hips)},
                                                       {"Spine1", hips + 0.45 * (neck - hips)},
                                                       {"Spine2", hips + 0.7 * (neck - hips)},
                                                       {"Neck", neck},
                                                       {"Head", head},
                                                       {"HeadTop_End", head + Vector3d(0, 0.18, 0)}};
  std::vector<int> parents{-1, 0, 1, 2, 3, 4, 5};
  const auto add = [&](const std::string& name, const Vector3d& p, int parent) {
    joints.emplace_back(name, p);
    parents.push_back(parent);
    return static_cast<int>(joints.size()) - 1;
  };
  for (const std::string side : {"Left", "Right"}) {
    const Vector3d arm = at(side + "Arm"), elbow = at(side + "ForeArm"), wrist = at(side + "Hand");
    int joint = add(side + "Shoulder", 0.75 * neck + 0.25 * arm, 3);
    joint = add(side + "Arm", arm, joint);
    joint = add(side + "ForeArm", elbow, joint);
    joint = add(side + "Hand", wrist, joint);
    add(side + "Hand_End", wrist + 0.6 * (wrist - elbow), joint);
    joint = add(side + "UpLeg", at(side + "UpLeg"), 0);
    joint = add(side + "Leg", at(side + "Leg"), joint);
    joint = add(side + "Foot", at(side + "Foot"), joint);
    add(side + "Foot_End", at(side + "Foot") + Vector3d(0, -0.04, 0.15), joint);
  }
  return skeleton_of(joints, parents);
}

Mesh surface_of(const synthetic::Body& body) { return extract_surface(synthetic::sample_field(body, 0.015)); }

struct Skinned {
  Person person;
  Mesh mesh;
  Skeleton skeleton;
  Skin skin;

  double weight(size_t vertex, const std::string& joint) const {
    const int index = skeleton.find(joint);
    double sum = 0;
    for (size_t k = 0; k < 4; ++k)
      if (skin.influences[vertex].joint[k] == index) sum += static_cast<double>(skin.influences[vertex].weight[k]);
    return sum;
  }
  /// What all joints of that side together weigh there.
  double side_weight(size_t vertex, const std::string& side) const {
    double sum = 0;
    for (size_t k = 0; k < 4; ++k)
      if (skeleton.joints[skin.influences[vertex].joint[k]].name.rfind(side, 0) == 0)
        sum += static_cast<double>(skin.influences[vertex].weight[k]);
    return sum;
  }
  Vector3d joint(const std::string& name) const {
    return world_from_joints(skeleton)[static_cast<size_t>(skeleton.find(name))].translation();
  }
};

Skinned skinned_person(const synthetic::PersonOptions& options = {}, const SkinningOptions& skinning = {}) {
  Skinned result;
  result.person = synthetic::person(options);
  result.mesh = surface_of(result.person.body);
  result.skeleton = skeleton_of(result.person);
  auto skin = compute_skin(result.mesh, result.skeleton, skinning);
  EXPECT_TRUE(skin) << skin.error().message;
  if (skin) result.skin = std::move(skin).value();
  return result;
}

/// Vertices moved by turning one joint of the skeleton about an axis of the world.
std::vector<Vector3d> posed(const Skinned& body, const std::string& joint, const Eigen::AngleAxisd& turn) {
  const auto rest = world_from_joints(body.skeleton);
  Skeleton skeleton = body.skeleton;
  const size_t index = static_cast<size_t>(skeleton.find(joint));
  skeleton.joints[index].parent_from_joint.rotate(turn);
  const auto world = world_from_joints(skeleton);
  std::vector<Vector3d> result;
  for (size_t v = 0; v < body.mesh.positions.size(); ++v) {
    Vector3d p = Vector3d::Zero();
    for (size_t k = 0; k < 4; ++k) {
      const size_t j = body.skin.influences[v].joint[k];
      p += static_cast<double>(body.skin.influences[v].weight[k]) *
           (world[j] * (rest[j].inverse() * body.mesh.positions[v].cast<double>()));
    }
    result.push_back(p);
  }
  return result;
}

double volume(const Mesh& mesh, const std::vector<Vector3d>& positions) {
  double sum = 0;
  for (const auto& t : mesh.triangles) sum += positions[t[0]].dot(positions[t[1]].cross(positions[t[2]])) / 6;
  return sum;
}

TEST(Skinning, HoldsTheContract) {
  const Skinned body = skinned_person();
  ASSERT_EQ(body.skin.influences.size(), body.mesh.positions.size());
  const auto checked = check(body.skin, body.mesh.positions.size(), body.skeleton.joints.size());
  EXPECT_TRUE(checked) << checked.error().message;
}

TEST(Skinning, AtRestNothingMoves) {
  const Skinned body = skinned_person();
  const auto rest = posed(body, "LeftArm", Eigen::AngleAxisd(0, Vector3d::UnitX()));
  for (size_t v = 0; v < rest.size(); ++v) EXPECT_LT((rest[v] - body.mesh.positions[v].cast<double>()).norm(), 1e-6);
}

TEST(Skinning, LimbsFollowTheirOwnJoints) {
  const Skinned body = skinned_person();
  for (const std::string side : {"Left", "Right"}) {
    const std::string other = side == "Left" ? "Right" : "Left";
    const Vector3d elbow = body.joint(side + "ForeArm"), wrist = body.joint(side + "Hand"),
                   knee = body.joint(side + "Leg"), ankle = body.joint(side + "Foot");
    int forearm = 0, shin = 0, hand = 0;
    for (size_t v = 0; v < body.mesh.positions.size(); ++v) {
      const Vector3d p = body.mesh.positions[v].cast<double>();
      const auto share = [&](const Vector3d& a, const Vector3d& b) {
        return (p - a).dot(b - a) / (b - a).squaredNorm();
      };
      const auto aside = [&](const Vector3d& a, const Vector3d& b) { return (p - a - share(a, b) * (b - a)).norm(); };
      if (const double t = share(elbow, wrist); t > 0.3 && t < 0.7 && aside(elbow, wrist) < 0.08) {
        EXPECT_GT(body.weight(v, side + "ForeArm"), 0.8);
        ++forearm;
      }
      if (const double t = share(elbow, wrist); t > 1.2 && aside(elbow, wrist) < 0.08) {
        EXPECT_GT(body.weight(v, side + "Hand"), 0.85);
        EXPECT_LT(body.side_weight(v, other), 1e-6);
        ++hand;
      }
      if (const double t = share(knee, ankle); t > 0.3 && t < 0.7 && aside(knee, ankle) < 0.1) {
        EXPECT_GT(body.weight(v, side + "Leg"), 0.8);
        EXPECT_LT(body.side_weight(v, other), 0.01);
        ++shin;
      }
    }
    EXPECT_GT(forearm, 50);
    EXPECT_GT(hand, 30);
    EXPECT_GT(shin, 50);
  }
}

TEST(Skinning, TheHeadIsRigidAndItsEndWeighsNothing) {
  const Skinned body = skinned_person();
  for (size_t v = 0; v < body.mesh.positions.size(); ++v) {
    EXPECT_EQ(body.weight(v, "HeadTop_End"), 0);
    if (static_cast<double>(body.mesh.positions[v].y()) > body.joint("Head").y() + 0.09) {
      EXPECT_GT(body.weight(v, "Head"), 0.9);
    }
  }
}

TEST(Skinning, ArmsBesideTheTrunkDoNotTakeItAlong) {
  const Skinned body = skinned_person({.arm_angle_rad = 0.3});
  const double armpit = body.joint("LeftArm").y() - 0.19;
  int flank = 0;
  for (size_t v = 0; v < body.mesh.positions.size(); ++v) {
    const Vector3d p = body.mesh.positions[v].cast<double>();
    if (p.y() > armpit || p.y() < 1.0 || std::abs(p.x()) > 0.17) continue;
    EXPECT_LT(body.weight(v, "LeftForeArm") + body.weight(v, "RightForeArm"), 0.02) << p.transpose();
    EXPECT_LT(body.weight(v, "LeftArm") + body.weight(v, "RightArm"), 0.25) << p.transpose();
    ++flank;
  }
  EXPECT_GT(flank, 100);
}

void expect_bends_to_keep_volume(const Skinned& body) {
  std::vector<Vector3d> rest;
  for (const auto& p : body.mesh.positions) rest.push_back(p.cast<double>());
  const double whole = volume(body.mesh, rest);
  struct Pose {
    std::string joint;
    Eigen::AngleAxisd turn;
  };
  for (const Pose& pose : {Pose{"LeftForeArm", Eigen::AngleAxisd(-1.05, Vector3d::UnitX())},
                           Pose{"RightLeg", Eigen::AngleAxisd(1.05, Vector3d::UnitX())},
                           Pose{"LeftArm", Eigen::AngleAxisd(0.7, Vector3d::UnitZ())},
                           Pose{"Head", Eigen::AngleAxisd(0.5, Vector3d::UnitY())}}) {
    const auto moved = posed(body, pose.joint, pose.turn);
    EXPECT_NEAR(volume(body.mesh, moved) / whole, 1, 0.03) << pose.joint;
    for (const auto& t : body.mesh.triangles)
      for (size_t c = 0; c < 3; ++c) {
        const double before = (rest[t[c]] - rest[t[(c + 1) % 3]]).norm();
        EXPECT_LT((moved[t[c]] - moved[t[(c + 1) % 3]]).norm(), 2.5 * before + 0.004) << pose.joint;
      }
  }
}

TEST(Skinning, BendsKeepTheirVolumeAndDoNotTear) { expect_bends_to_keep_volume(skinned_person()); }

TEST(SkinningByRegions, HoldsTheContractAndBendsWell) {
  const Skinned body = skinned_person({}, {.method = SkinningMethod::regions});
  const auto checked = check(body.skin, body.mesh.positions.size(), body.skeleton.joints.size());
  EXPECT_TRUE(checked) << checked.error().message;
  expect_bends_to_keep_volume(body);
}

TEST(SkinningByRegions, IsRigidAwayFromJointsAndBlendsAcrossThem) {
  const Skinned body = skinned_person({}, {.method = SkinningMethod::regions});
  const Vector3d elbow = body.joint("LeftForeArm"), wrist = body.joint("LeftHand");
  int middle = 0, blended = 0;
  for (size_t v = 0; v < body.mesh.positions.size(); ++v) {
    const Vector3d p = body.mesh.positions[v].cast<double>();
    const double t = (p - elbow).dot(wrist - elbow) / (wrist - elbow).squaredNorm();
    if ((p - elbow - t * (wrist - elbow)).norm() > 0.08) continue;
    const double forearm = body.weight(v, "LeftForeArm"), arm = body.weight(v, "LeftArm");
    if (t > 0.4 && t < 0.6) {
      EXPECT_EQ(forearm, 1);
      ++middle;
    } else if (std::abs(t) < 0.3) {
      EXPECT_NEAR(forearm + arm, 1, 1e-6);
      if (t < -0.2) {
        EXPECT_LT(forearm, 0.1);
      }
      if (t > 0.2) {
        EXPECT_GT(forearm, 0.9);
      }
      blended += forearm > 0.1 && arm > 0.1 ? 1 : 0;
    }
  }
  EXPECT_GT(middle, 20);
  EXPECT_GT(blended, 20);
}

TEST(SkinningByRegions, AWiderOverlapIsSofter) {
  const auto blended = [](double overlap) {
    const Skinned body = skinned_person({}, {.method = SkinningMethod::regions, .overlap = overlap});
    return std::count_if(body.skin.influences.begin(), body.skin.influences.end(),
                         [](const JointInfluences& of) { return of.weight[1] > 0; });
  };
  const auto narrow = blended(0.2), usual = blended(0.7), wide = blended(1.5);
  EXPECT_GT(narrow, 0);
  EXPECT_GT(usual, 2 * narrow);
  EXPECT_GT(wide, usual);
}

TEST(Skinning, MirrorsWithTheBody) {
  const Skinned body = skinned_person();
  // The synthetic person is symmetric: weights summed over each side's arm must agree.
  const auto total = [&](const std::string& joint) {
    double sum = 0;
    for (size_t v = 0; v < body.mesh.positions.size(); ++v) sum += body.weight(v, joint);
    return sum;
  };
  for (const std::string name : {"Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot"})
    EXPECT_NEAR(total("Left" + name) / total("Right" + name), 1, 0.08) << name;
}

TEST(Skinning, PartsBesideTheBodyGetWeightsToo) {
  Skinned body = skinned_person();
  const size_t before = body.mesh.positions.size();
  const Vector3d hand = body.joint("RightHand");
  const Mesh ball = surface_of(synthetic::sphere(0.05));
  for (const auto& p : ball.positions)
    body.mesh.positions.push_back(p + (hand + Vector3d(-0.25, -0.2, 0)).cast<float>());
  for (auto t : ball.triangles) {
    for (auto& v : t) v += static_cast<uint32_t>(before);
    body.mesh.triangles.push_back(t);
  }
  const auto skin = compute_skin(body.mesh, body.skeleton, {});
  ASSERT_TRUE(skin) << skin.error().message;
  EXPECT_TRUE(check(*skin, body.mesh.positions.size(), body.skeleton.joints.size()));
  body.skin = *skin;
  for (size_t v = before; v < body.mesh.positions.size(); ++v) EXPECT_GT(body.weight(v, "RightHand"), 0.99);
}

TEST(Skinning, SameBytesOnAnyNumberOfThreads) {
  for (const SkinningMethod method : {SkinningMethod::heat, SkinningMethod::regions}) {
    const Skinned body = skinned_person({}, {.method = method});
    ThreadPool pool(4);
    const auto skin = compute_skin(body.mesh, body.skeleton, {.method = method}, pool.work());
    ASSERT_TRUE(skin);
    ASSERT_EQ(skin->influences.size(), body.skin.influences.size());
    for (size_t v = 0; v < skin->influences.size(); ++v) {
      EXPECT_EQ(skin->influences[v].joint, body.skin.influences[v].joint);
      EXPECT_EQ(skin->influences[v].weight, body.skin.influences[v].weight);
    }
  }
}

TEST(Skinning, RefusesWhatItCannotSkin) {
  const Skinned body = skinned_person();
  const auto code = [](const Result<Skin>& result) { return result ? ErrorCode::internal : result.error().code; };
  EXPECT_EQ(code(compute_skin({}, body.skeleton, {})), ErrorCode::invalid_argument);
  EXPECT_EQ(code(compute_skin(body.mesh, {}, {})), ErrorCode::invalid_argument);
  EXPECT_EQ(code(compute_skin(body.mesh, body.skeleton, {.stiffness = 0})), ErrorCode::invalid_argument);
  EXPECT_EQ(code(compute_skin(body.mesh, body.skeleton, {.overlap = 0})), ErrorCode::invalid_argument);
  EXPECT_EQ(code(compute_skin(body.mesh, body.skeleton, {.cells = 5})), ErrorCode::invalid_argument);
  std::stop_source stop;
  stop.request_stop();
  Work work;
  work.stop = stop.get_token();
  EXPECT_EQ(code(compute_skin(body.mesh, body.skeleton, {}, work)), ErrorCode::cancelled);
}

}  // namespace
}  // namespace booth
