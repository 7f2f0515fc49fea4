#pragma once

#include <optional>
#include <span>
#include <string>

#include "pipeline/face/control_points.h"
#include "pipeline/face/face_patch.h"
#include "pipeline/face/face_pictures.h"
#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/work.h"

namespace booth {

/// What speaks for a fitted face and for the hull's own.
struct FaceEvidence {
  size_t compared = 0;         ///< places of the face that could be compared
  double of_hull = 0;          ///< mean correlation of what cameras see there, were the hull the surface, −1 … 1
  double of_fitted = 0;        ///< the same of the fitted face
  double outside_outline = 0;  ///< share of the fitted face that stands out of an outline by more than 6 mm

  /// Why the fitted face is worse than the hull's; nothing where it is not.
  std::optional<std::string> objection() const;
};

/// Looks at both surfaces through the cameras that see the face: where a surface is the true one, pictures agree on
/// what is on it. Both are compared at the same places, along the sight of the most frontal of these cameras.
///
/// @param seen      from face_pictures
/// @param controls  its observations name the cameras that are compared
/// @param hull      closed, world frame
/// @param views     outlines, of any cameras
FaceEvidence weigh_face(std::span<const FacePicture> seen, const FaceControlPoints& controls, const Mesh& hull,
                        const FacePatch& fitted, const SilhouetteViews& views, const Work& work = {});

}  // namespace booth
