#include "pipeline/export/animation.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <numbers>
#include <utility>

namespace booth {
namespace {

using Eigen::AngleAxisd;
using Eigen::Isometry3d;
using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double length_s = 4;  // of each clip
constexpr int keys = 61;        // 15 a second

const std::array<const char*, 17> moving{"Hips",      "Spine1",      "Spine2",   "Neck",     "Head",
                                         "LeftArm",   "LeftForeArm", "LeftHand", "RightArm", "RightForeArm",
                                         "RightHand", "LeftUpLeg",   "LeftLeg",  "LeftFoot", "RightUpLeg",
                                         "RightLeg",  "RightFoot"};

/// The shortest rotation from one direction to another.
Matrix3d rotation_between(const Vector3d& from, const Vector3d& to) {
  return Quaterniond::FromTwoVectors(from, to).toRotationMatrix();
}

/// 0 before `begin`, 1 after `end`, smooth between.
double ramp(double t, double begin, double end) {
  const double x = std::clamp((t - begin) / (end - begin), 0.0, 1.0);
  return x * x * (3 - 2 * x);
}

/// A skeleton that can be turned joint by joint.
class Figure {
 public:
  explicit Figure(const Skeleton& skeleton) : skeleton_(skeleton) {}

  size_t index(const std::string& joint) const { return static_cast<size_t>(skeleton_.find(joint)); }
  Isometry3d& local(const std::string& joint) { return skeleton_.joints[index(joint)].parent_from_joint; }

  Isometry3d world(const std::string& joint) const {
    Isometry3d result = Isometry3d::Identity();
    for (int j = skeleton_.find(joint); j >= 0; j = skeleton_.joints[static_cast<size_t>(j)].parent)
      result = skeleton_.joints[static_cast<size_t>(j)].parent_from_joint * result;
    return result;
  }
  Vector3d at(const std::string& joint) const { return world(joint).translation(); }

  /// Turns a joint about its own place; the rotation is given in the world's axes.
  void turn(const std::string& joint, const Matrix3d& rotation) { face(joint, rotation * world(joint).linear()); }

  /// Gives a joint an orientation in the world.
  void face(const std::string& joint, const Matrix3d& orientation) {
    const int parent = skeleton_.joints[index(joint)].parent;
    Matrix3d above = Matrix3d::Identity();
    if (parent >= 0) above = world(skeleton_.joints[static_cast<size_t>(parent)].name).linear();
    local(joint).linear() = Quaterniond(above.transpose() * orientation).normalized().toRotationMatrix();
  }

  /// Turns a joint so that its child comes to lie in that direction.
  void point(const std::string& joint, const std::string& child, const Vector3d& direction) {
    turn(joint, rotation_between(at(child) - at(joint), direction));
  }

 private:
  Skeleton skeleton_;
};

/// Where a leg's ankle has to stay.
struct PlantedLeg {
  std::string side;
  Isometry3d foot;  // world_from_joint
};

/// Bends hip and knee so that the foot is where it was, the knee to the front.
/// Source: the law of cosines, as in any two-bone inverse kinematics.
void plant(const PlantedLeg& leg, Figure& figure) {
  const std::string hip = leg.side + "UpLeg", knee = leg.side + "Leg", foot = leg.side + "Foot";
  const Vector3d from = figure.at(hip), to = leg.foot.translation();
  const double thigh = (figure.at(knee) - from).norm(), shin = (figure.at(foot) - figure.at(knee)).norm();
  const double way = std::min((to - from).norm(), thigh + shin);
  const Vector3d along = (to - from).normalized();
  const double share = (thigh * thigh - shin * shin + way * way) / (2 * way);
  const double bow = std::sqrt(std::max(0.0, thigh * thigh - share * share));
  // To the side to which the knee was bent when captured, if it was, and to the front.
  constexpr double forward_m = 0.05;
  Vector3d aside = figure.at(knee) - from + forward_m * Vector3d::UnitZ();
  aside = (aside - aside.dot(along) * along).normalized();
  figure.point(hip, knee, share * along + bow * aside);
  figure.point(knee, foot, to - figure.at(knee));
  figure.face(foot, leg.foot.linear());
}

/// Pose of the waving arm, `raised` of the way up (0 … 1), the forearm swung aside by an angle.
void lift_arm(const std::string& side, double raised, double swing_rad, Figure& figure) {
  const double out = side == "Left" ? 1 : -1;
  const std::string arm = side + "Arm", elbow = side + "ForeArm", hand = side + "Hand";
  std::map<std::string, Quaterniond> down;
  for (const std::string& joint : {arm, elbow, hand}) down[joint] = Quaterniond(figure.local(joint).linear());
  figure.point(arm, elbow, {out * 0.80, -0.20, 0.30});
  figure.point(elbow, hand, AngleAxisd(-out * swing_rad, Vector3d::UnitZ()) * Vector3d(out * 0.15, 0.95, 0.15));
  // The palm to the front: as far as the forearm turns, the rest at the wrist.
  constexpr double forearm_twist_rad = 0.5, wrist_twist_rad = 0.7;
  const Vector3d along = (figure.at(hand) - figure.at(elbow)).normalized();
  figure.turn(elbow, AngleAxisd(-out * forearm_twist_rad, along).toRotationMatrix());
  figure.turn(hand, AngleAxisd(-out * wrist_twist_rad, along).toRotationMatrix());
  for (const std::string& joint : {arm, elbow, hand}) {
    const Quaterniond up(figure.local(joint).linear());
    figure.local(joint).linear() = down[joint].slerp(raised, up).toRotationMatrix();
  }
}

/// Everything but the wave: breath, weight and arms that hang, at a phase of 0 … 2π.
void idle(double phase, const std::array<PlantedLeg, 2>& legs, Figure& figure) {
  const double leg_m = (figure.at("LeftUpLeg") - figure.at("LeftFoot")).norm();
  // The hips stay a little lower than captured, so that straight legs can follow them sideways.
  const double aside = 0.010 * leg_m * std::sin(phase);
  const double down = 0.003 * leg_m + 0.001 * leg_m * (1 - std::cos(2 * phase));
  figure.local("Hips").translation() += Vector3d(aside, -down, 0);
  const auto pitch = [&](const char* joint, double angle_rad) {
    figure.turn(joint, AngleAxisd(angle_rad, Vector3d::UnitX()).toRotationMatrix());
  };
  const double breath = std::sin(2 * phase);
  pitch("Spine1", -0.008 * breath);
  pitch("Spine2", -0.010 * breath);
  pitch("Neck", 0.010 * breath);
  figure.turn("Head", AngleAxisd(0.06 * std::sin(phase), Vector3d::UnitY()).toRotationMatrix());
  for (const PlantedLeg& leg : legs) plant(leg, figure);
  for (const std::string side : {"Left", "Right"}) {
    // Arms held out hang down, yet clear of hips and clothes; those already lower stay.
    constexpr double hanging_rad = 0.38;
    const Vector3d arm = figure.at(side + "ForeArm") - figure.at(side + "Arm");
    const double angle = std::atan2(std::abs(arm.x()), -arm.y());
    const double lowered = std::max(0.0, angle - hanging_rad) + 0.012 * breath;
    figure.turn(side + "Arm", AngleAxisd(arm.x() > 0 ? -lowered : lowered, Vector3d::UnitZ()).toRotationMatrix());
  }
}

}  // namespace

std::vector<AnimationClip> make_clips(const Skeleton& skeleton) {
  for (const char* joint : moving)
    if (skeleton.find(joint) < 0) return {};
  const Figure rest(skeleton);
  const std::array<PlantedLeg, 2> legs{PlantedLeg{"Left", rest.world("LeftFoot")},
                                       PlantedLeg{"Right", rest.world("RightFoot")}};
  std::vector<size_t> joints;
  for (const char* joint : moving) joints.push_back(rest.index(joint));
  std::sort(joints.begin(), joints.end());

  std::vector<AnimationClip> clips;
  for (const std::string name : {"idle", "wave"}) {
    AnimationClip& clip = clips.emplace_back();
    clip.name = name;
    for (const size_t joint : joints) clip.tracks.push_back({joint, {}});
    for (int key = 0; key < keys; ++key) {
      const double t = length_s * key / (keys - 1);
      Figure figure(skeleton);
      idle(2 * std::numbers::pi * t / length_s, legs, figure);
      if (name == "wave") {
        const double raised = ramp(t, 0, 0.9) - ramp(t, length_s - 0.9, length_s);
        constexpr double swing_rad = 0.35, swings_per_s = 1.25;
        lift_arm("Right", raised, raised * swing_rad * std::sin(2 * std::numbers::pi * swings_per_s * t), figure);
      }
      clip.times_s.push_back(t);
      for (JointTrack& track : clip.tracks)
        track.parent_from_joint.push_back(figure.local(skeleton.joints[track.joint].name));
    }
  }
  return clips;
}

}  // namespace booth
