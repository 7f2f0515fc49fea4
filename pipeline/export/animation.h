#pragma once

#include <Eigen/Geometry>
#include <cstddef>
#include <string>
#include <vector>

#include "pipeline/types/avatar.h"

namespace booth {

/// What one joint does during a clip: its pose against its parent, one a key.
struct JointTrack {
  size_t joint = 0;
  std::vector<Eigen::Isometry3d> parent_from_joint;
};

/// A motion as keys, to be read with straight interpolation between them.
struct AnimationClip {
  std::string name;
  std::vector<double> times_s;     ///< from 0, ascending
  std::vector<JointTrack> tracks;  ///< in the order of the joints; joints that do not move have none
};

/// Two short clips for a skeleton as fit_skeleton makes it, so that anybody sees the avatar move: "idle", who breathes
/// and shifts the weight, and "wave", who lifts the right hand and waves. Both have tracks for the same joints, begin
/// and end in the same pose, and so follow each other and themselves without a jump.
///
/// The feet stay where they were captured, exactly: the legs follow the hips by two-bone inverse kinematics, the knees
/// bending forward.
/// @return empty for a skeleton that lacks a joint of the avatar's contract
std::vector<AnimationClip> make_clips(const Skeleton& skeleton);

}  // namespace booth
