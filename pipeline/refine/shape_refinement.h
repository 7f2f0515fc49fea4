#pragma once

#include <span>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/work.h"

namespace booth {

struct ShapeRefinementOptions {
  bool enabled = true;        ///< false: the hull as it is
  double sure_m = 0.0007;     ///< hull that is off by at most this stays as it is
  double open_m = 0.012;      ///< hull that may be off by more than this says nothing about the surface
  bool photographs = true;    ///< whether the surface is also looked for in the pictures, where the hull is doubtful
  double doubtful_m = 0.003;  ///< hull that may be off by more than this is
  double stiffness = 0.02;    ///< of the surface where the hull is open, against what holds it
};

/// The visual hull without the flesh that is there only because no silhouette carves it: where the hull is not sure,
/// the smoothest surface inside it that joins what is sure.
///
/// Along each viewing ray that grazes the subject, the true surface meets the hull, mostly in one point. Where a ray
/// grazes the hull for a short stretch only, that point is known; where it is long (in armpits, between the legs, in
/// front of a belly that the hands hide), or where the same ray grazes another part as well, the hull is but a bound.
///
/// @param hull   world frame, as carve_visual_hull returns it
/// @param views  the silhouettes that it explains
/// @return a field on the same grid that lies inside the hull: one connected body without cavities. Where the hull is
///         sure (fingers, noses, rims of limbs) it is the hull's own
/// Cost: grows with the surface. Same input, same bytes, whatever the thread count and the order of the views.
/// Source: contacts of rays after C. Hernández Esteban, F. Schmitt, "Silhouette and stereo fusion for 3D object
/// modeling", CVIU 96(3), 2004; surface after F. Calakli, G. Taubin (see smooth_distance.h).
Field refine_shape(Field hull, const SilhouetteViews& views, std::span<const Frame> frames,
                   const ShapeRefinementOptions& options, const Work& work = {});

}  // namespace booth
