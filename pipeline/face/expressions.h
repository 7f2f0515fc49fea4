#pragma once

#include <vector>

#include "pipeline/face/face_patch.h"
#include "pipeline/face/head_fit.h"
#include "pipeline/face/neutral_head.h"
#include "pipeline/types/avatar.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// The neutral head's expressions on a subject's mesh. How the fit has turned and stretched the face around a vertex
/// turns and stretches its offsets, so that a lid that has farther to go goes farther. A vertex of the mesh takes them
/// from the place of the fitted face nearest to it that faces the same way; they fade out where the mesh leaves the
/// fitted face, at the face's rim, and around what covers the face. The avatar is one surface, with nothing behind its
/// lids: what lies between them moves with them, by how near it is to each, so that a closing eye narrows.
///
/// @param patch  of that head
/// @param mesh   world frame, metres: the avatar's; it may have any vertices
/// @return the expressions that move a vertex at all, in the neutral head's order
/// Source: R. Sumner, J. Popović, "Deformation transfer for triangle meshes", SIGGRAPH 2004, with one gradient a
/// vertex.
std::vector<MorphTarget> carry_expressions(const NeutralHead& neutral, const FittedHead& head, const FacePatch& patch,
                                           const Mesh& mesh, const Work& work = {});

}  // namespace booth
