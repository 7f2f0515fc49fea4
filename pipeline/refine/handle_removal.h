#pragma once

#include <cstddef>

#include "pipeline/types/field.h"
#include "pipeline/types/work.h"

namespace booth {

struct HandleRemovalOptions {
  double area_m2 = 0.001;  ///< rings that a cut, or a cover over their opening, up to this large undoes are undone
};

struct RemovedHandles {
  size_t cut_samples = 0;     ///< that were inside
  size_t filled_samples = 0;  ///< that were outside
};

/// Cuts thin rings and fills narrow openings through a solid: a finger that touches the leg, a pinhole under an arm.
/// A ring that is thick and wide, such as of a hand on the hip, stays.
///
/// The inside is grown from one cell, deepest first, by cells that do not change the topology; where two fronts of it
/// would meet, a layer of one sample is left, which cuts each ring once. The same with the outside gives one cover for
/// each opening. A small layer changes sides, half a voxel from the surface.
///
/// @param field  one connected part without cavities
/// Source: simple points after G. Bertrand, G. Malandain, "A new characterization of three-dimensional simple points",
/// Pattern Recognition Letters 15(2), 1994; topology-preserving growth after J.-F. Mangin et al., "From 3D magnetic
/// resonance images to structural representations of the cortex topography using topology preserving deformations",
/// J. Mathematical Imaging and Vision 5(4), 1995.
RemovedHandles remove_small_handles(Field& field, const HandleRemovalOptions& options, const Work& work = {});

}  // namespace booth
