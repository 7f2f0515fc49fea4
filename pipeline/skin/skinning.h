#pragma once

#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

struct SkinningOptions {
  double stiffness = 3.0;  ///< how quickly a vertex takes its own bone's motion on, 0.1 … 10; lower blends wider
  int cells = 160;         ///< voxels along the height of the body, in which bones are assigned, 60 … 400
};

/// Smooth joint weights, at most four a vertex.
///
/// Each vertex belongs to the bone that is nearest through the inside of the body, counted from the thickness of the
/// limb around the bone, so that arm and trunk or the two legs do not catch each other across a gap. From there the
/// weights spread over the surface like heat: a bone's share is the equilibrium temperature when it alone is warm.
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
/// meshes", SCA 2013.
Result<Skin> compute_skin(const Mesh& mesh, const Skeleton& skeleton, const SkinningOptions& options,
                          const Work& work = {});

}  // namespace booth
