#pragma once

#include <string>
#include <vector>

#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

/// How the joints are found.
enum class SkeletonMethod {
  anatomy,   ///< from extremities, centre lines, girths and proportions
  embedding  ///< the method of reference: a given skeleton embedded into medial spheres, see embedding.h
};

struct SkeletonOptions {
  int cells = 200;  ///< voxels along the height of the body, 100 … 400
  SkeletonMethod method = SkeletonMethod::anatomy;
};

struct FittedSkeleton {
  Skeleton skeleton;  ///< the 23 joints of the avatar's contract, world frame, rest = captured pose
  std::vector<std::string> warnings;
};

/// The skeleton of a standing person, found from the shape.
///
/// Hands, feet and the crown are the ends of the shape: the voxels inside that are geodesically farthest from the
/// trunk. From them the limbs' centre lines are followed inwards; joints come from where these bend and narrow,
/// from crotch, neck and shoulder outline, and from the proportions of the limb where the shape says nothing.
/// Arms may be held anywhere between straight down and straight out, or with the hands on the hips. What could not be
/// seen (arms that touch the body, legs in a long skirt) is placed by outline and proportions and named in the
/// warnings.
///
/// The person is measured along their own axes: at first those of the mass, then, from a coarse fit, up from the ankles
/// to the neck and across as hands, feet and shoulders have it. So the joints turn with the body.
///
/// Axes at rest: every joint's +Y runs along its bone, to the next joint of the limb (to the middle of the hand, the
/// tip of the foot, the crown for those that end it; HeadTop_End turns like Head). +Z is the direction across it that
/// is nearest to forward (world +Z, or where a person who stands turned faces), for the feet and toes to up; +X = Y × Z
/// completes a right-handed frame: the convention of Blender's and FBX's bones, which retargeters expect. So +X is the
/// hinge of knees and elbows, and turning twins of both sides about their X by the same angle gives mirrored poses
/// (about Y and Z: by opposite angles).
///
/// @param mesh  closed, world frame, facing +Z, turned from it by no more than 50° and leaning by no more than 17°; it
///              need not stand on y = 0, small parts beside the body are ignored
/// @return every joint lies inside the mesh
/// @error not_riggable  the shape has no recognisable head, hands and feet; the message says which and why
/// @error invalid_argument  options out of range, or a mesh that fails its check
/// Cost: O(cells³ + triangles), about 0.1 s and 30 MB at 200 cells.
/// Source: own; segment lengths from P. de Leva, "Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters",
/// J. Biomechanics 29(9), 1996, and R. Drillis, R. Contini, "Body segment parameters", 1966 (in D. Winter,
/// "Biomechanics and motor control of human movement"). Compare I. Baran, J. Popović, "Automatic rigging and animation
/// of 3D characters", SIGGRAPH 2007, which embeds one given skeleton instead; SkeletonMethod::embedding does that.
Result<FittedSkeleton> fit_skeleton(const Mesh& mesh, const SkeletonOptions& options, const Work& work = {});

}  // namespace booth
