#pragma once

#include "pipeline/geometry/interior.h"
#include "pipeline/skeleton/body_joints.h"
#include "pipeline/types/result.h"

namespace booth {

/// The skeleton of an average adult, embedded into a body as Baran and Popović do it: the inside is packed with medial
/// spheres, those that touch make a graph, the skeleton's branching points and ends are laid onto its nodes so that
/// bones have about their lengths and directions, the joints between follow the ways through the graph, and all of
/// them are moved until the bones lie deep inside, equally long on both sides.
///
/// It knows nothing of people but that one skeleton: joints slide along a limb that does not narrow. It is there to be
/// compared with; fit_skeleton's own method is more exact.
///
/// @param interior  of a person who stands upright and faces +Z, arms held out
/// @error not_riggable  the body cannot be packed, or the skeleton finds no place in it
/// Cost: O(spheres² log spheres), at most 400 of them.
/// Source: I. Baran, J. Popović, "Automatic rigging and animation of 3D characters", SIGGRAPH 2007, sections 3.1 to
/// 3.5. The discrete embedding minimises the sum of the bones' penalties exactly, by dynamic programming over the tree,
/// instead of searching for the minimum of a sum that also has penalties between bones.
Result<BodyJoints> embed_skeleton(const Interior& interior);

}  // namespace booth
