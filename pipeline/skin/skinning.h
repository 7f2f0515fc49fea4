#pragma once

#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

enum class SkinningMethod {
  heat,    ///< weights are temperatures in equilibrium
  regions  ///< the method of reference: regions grown into overlaps, a smooth transition on each
};

struct SkinningOptions {
  SkinningMethod method = SkinningMethod::heat;
  double stiffness = 3.0;  ///< heat: how quickly a vertex takes its own bone's motion on, 0.1 … 10; lower blends wider
  double overlap = 0.7;    ///< regions: how far each grows over its border, in radii of the limb there, 0.1 … 3
  int cells = 160;         ///< voxels along the height of the body, in which bones are assigned, 60 … 400
};

/// Smooth joint weights, at most four a vertex.
///
/// Each vertex belongs to the bone that is nearest through the inside of the body, counted from the thickness of the
/// limb around the bone, so that arm and trunk or the two legs do not catch each other across a gap. From there the
/// weights spread over the surface like heat: a bone's share is the equilibrium temperature when it alone is warm.
/// Or, by the method of reference, each joint's region grows over its border along the surface, and a joint's weight
/// falls smoothly across the overlap, half of it on the border; beyond it the skin is rigid.
/// A joint's weight is that of the bones from it to its children; joints that end a limb move what lies along their
/// +Y axis, and those named "…_End" nothing.
///
/// @param mesh      closed, world frame; may have several parts
/// @param skeleton  at rest in the same frame, inside the mesh
/// @return check(skin) holds; the same bytes whatever the number of threads
/// @error invalid_argument  options out of range, a mesh or skeleton that fails its check or that has no bones
/// Cost: one sparse Cholesky factorisation of V × V and a solve a joint; about 0.2 s for 10,000 vertices.
/// Source: heat equilibrium: I. Baran, J. Popović, "Automatic rigging and animation of 3D characters", SIGGRAPH 2007,
/// section 4; distances through the inside: O. Dionne, M. de Lasa, "Geodesic voxel binding for production character
/// meshes", SCA 2013; regions: F. Hétroy, C. Gérot, L. Lu, B. Thibert, "Simple flexible skinning based on manifold
/// modeling", GRAPP 2009.
Result<Skin> compute_skin(const Mesh& mesh, const Skeleton& skeleton, const SkinningOptions& options,
                          const Work& work = {});

}  // namespace booth
