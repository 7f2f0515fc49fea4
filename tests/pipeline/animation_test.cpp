#include "pipeline/export/animation.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/skeleton/skeleton_fit.h"
#include "pipeline/skin/skinning.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

using Eigen::Isometry3d;
using Eigen::Vector3d;

struct Animated {
  Mesh mesh;
  Skeleton skeleton;
  std::vector<AnimationClip> clips;

  /// The skeleton at a key of a clip.
  Skeleton at(const AnimationClip& clip, size_t key) const {
    Skeleton posed = skeleton;
    for (const JointTrack& track : clip.tracks)
      posed.joints[track.joint].parent_from_joint = track.parent_from_joint[key];
    return posed;
  }
  /// A joint's pose in the world at a key.
  Isometry3d joint(const AnimationClip& clip, size_t key, const std::string& name) const {
    return world_from_joints(at(clip, key))[static_cast<size_t>(skeleton.find(name))];
  }
};

Animated animated(const synthetic::PersonOptions& options = {}) {
  Animated result;
  result.mesh = extract_surface(synthetic::sample_field(synthetic::person(options).body, 0.02));
  auto fitted = fit_skeleton(result.mesh, {});
  EXPECT_TRUE(fitted) << fitted.error().message;
  if (fitted) result.skeleton = std::move(fitted->skeleton);
  result.clips = make_clips(result.skeleton);
  return result;
}

TEST(Animation, HasTwoClipsThatFollowEachOther) {
  const Animated body = animated();
  ASSERT_EQ(body.clips.size(), 2U);
  EXPECT_EQ(body.clips[0].name, "idle");
  EXPECT_EQ(body.clips[1].name, "wave");
  for (const AnimationClip& clip : body.clips) {
    EXPECT_EQ(clip.times_s.front(), 0);
    EXPECT_TRUE(std::is_sorted(clip.times_s.begin(), clip.times_s.end()));
    for (size_t t = 0; t < clip.tracks.size(); ++t) {
      const JointTrack& track = clip.tracks[t];
      EXPECT_EQ(track.joint, body.clips[0].tracks[t].joint);
      ASSERT_EQ(track.parent_from_joint.size(), clip.times_s.size());
      EXPECT_TRUE(track.parent_from_joint.front().isApprox(body.clips[0].tracks[t].parent_from_joint.front(), 1e-9));
      EXPECT_TRUE(track.parent_from_joint.back().isApprox(track.parent_from_joint.front(), 1e-9));
    }
  }
}

TEST(Animation, EveryPoseIsASkeletonAndMovesSmoothly) {
  const Animated body = animated({.height_m = 1.2, .arm_angle_rad = 1.5});
  for (const AnimationClip& clip : body.clips)
    for (size_t key = 0; key < clip.times_s.size(); ++key) {
      const auto checked = check(body.at(clip, key));
      EXPECT_TRUE(checked) << checked.error().message;
      if (key == 0) continue;
      for (const JointTrack& track : clip.tracks) {
        const Eigen::Quaterniond before(track.parent_from_joint[key - 1].linear());
        const Eigen::Quaterniond after(track.parent_from_joint[key].linear());
        EXPECT_LT(before.angularDistance(after), 0.3) << body.skeleton.joints[track.joint].name << " at key " << key;
      }
    }
}

TEST(Animation, FeetStayOnTheFloor) {
  for (const double leg_angle : {0.02, 0.2}) {
    SCOPED_TRACE(leg_angle);
    const Animated body = animated({.leg_angle_rad = leg_angle});
    const auto rest = world_from_joints(body.skeleton);
    const auto skin = compute_skin(body.mesh, body.skeleton, {});
    ASSERT_TRUE(skin) << skin.error().message;
    double floor = 1;
    for (const auto& p : body.mesh.positions) floor = std::min(floor, static_cast<double>(p.y()));
    for (const AnimationClip& clip : body.clips)
      for (size_t key = 0; key < clip.times_s.size(); key += 4) {
        const auto world = world_from_joints(body.at(clip, key));
        for (const std::string name : {"LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"}) {
          const auto j = static_cast<size_t>(body.skeleton.find(name));
          EXPECT_TRUE(world[j].isApprox(rest[j], 1e-6)) << name << " at key " << key;
        }
        for (size_t v = 0; v < body.mesh.positions.size(); ++v) {
          const Vector3d p = body.mesh.positions[v].cast<double>();
          Vector3d moved = Vector3d::Zero();
          for (size_t k = 0; k < 4; ++k) {
            const size_t j = skin->influences[v].joint[k];
            moved += static_cast<double>(skin->influences[v].weight[k]) * (world[j] * (rest[j].inverse() * p));
          }
          EXPECT_GT(moved.y(), floor - 5e-4);
          constexpr double sole_m = 0.02;
          if (p.y() < floor + sole_m) {
            EXPECT_LT((moved - p).norm(), 3e-3) << "at " << p.transpose();
          }
        }
      }
  }
}

TEST(Animation, TheRightHandIsLiftedAndWaves) {
  const Animated body = animated();
  const AnimationClip& wave = body.clips.at(1);
  const double head = body.joint(wave, 0, "Neck").translation().y();
  double leftmost = 1, rightmost = -1;
  for (size_t key = 20; key + 20 < wave.times_s.size(); ++key) {
    const Vector3d hand = body.joint(wave, key, "RightHand").translation();
    EXPECT_GT(hand.y(), head);
    EXPECT_LT(hand.x(), -0.2);
    leftmost = std::min(leftmost, hand.x());
    rightmost = std::max(rightmost, hand.x());
    EXPECT_LT(body.joint(wave, key, "LeftHand").translation().y(), head - 0.3);
  }
  EXPECT_GT(rightmost - leftmost, 0.1);
}

TEST(Animation, KneesBendForwardAndBonesKeepTheirLengths) {
  const Animated body = animated();
  const auto rest = world_from_joints(body.skeleton);
  const auto place = [&](const std::string& name) {
    return rest[static_cast<size_t>(body.skeleton.find(name))].translation();
  };
  for (const AnimationClip& clip : body.clips)
    for (size_t key = 0; key < clip.times_s.size(); key += 6)
      for (const std::string side : {"Left", "Right"}) {
        const Vector3d knee = body.joint(clip, key, side + "Leg").translation();
        EXPECT_GT(knee.z(), place(side + "Leg").z() - 0.002);
        EXPECT_NEAR((knee - body.joint(clip, key, side + "Foot").translation()).norm(),
                    (place(side + "Leg") - place(side + "Foot")).norm(), 1e-6);
      }
}

TEST(Animation, ASkeletonWithoutTheContractsJointsHasNone) {
  EXPECT_TRUE(make_clips({}).empty());
  Skeleton one;
  one.joints.push_back({"Hips", -1, Isometry3d::Identity()});
  EXPECT_TRUE(make_clips(one).empty());
}

}  // namespace
}  // namespace booth
