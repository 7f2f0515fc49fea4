#pragma once

#include <Eigen/Geometry>
#include <cstddef>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/image.h"
#include "pipeline/types/work.h"

namespace booth {

/// Where the silhouette of one camera must be wrong: discs of its image that show the subject though its mask says not.
struct Contradiction {
  struct Disc {
    Eigen::Vector2f center;  ///< pixels
    float radius_px;
  };
  size_t view = 0;
  std::vector<Disc> discs;
};

/// Cameras that alone deny a part of the subject which all others see. With true silhouettes every ray through one
/// meets the hull, so a ray that misses it proves somebody wrong; and where at least four others agree on a point of
/// it, the one who objects is. So is who has a hole in the middle of the subject where all others hold it to be deeply
/// inside, deeper than true gaps that a single camera sees through.
///
/// @param volume  where to look, world frame
/// @param hull    carved from the same views
/// @return at most one entry a view, in the order of the views
std::vector<Contradiction> find_contradictions(const Eigen::AlignedBox3d& volume, const SilhouetteViews& views,
                                               const Field& hull, const Work& work = {});

/// The share of a view's subject that the hull does not cover: what the view alone shows, or what stands apart from
/// the subject, such as furniture and other people.
double unexplained_share(const SilhouetteView& view, const Field& hull);

/// The coverage with the discs added to the subject.
Image overrule(const Image& coverage, const Contradiction& contradiction);

}  // namespace booth
