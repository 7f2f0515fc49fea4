#pragma once

#include <Eigen/Core>
#include <vector>

#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/work.h"

namespace booth {

/// How far a camera's silhouette lies from where the other cameras' silhouettes expect it.
struct CameraOffset {
  Eigen::Vector2d shift_px = Eigen::Vector2d::Zero();  ///< of the picture against the calibration
  size_t support = 0;                                  ///< points of the outline that it was measured at
};

/// The shift of every camera's silhouette that the others' ask for. A ray through a true outline touches the hull of
/// the other cameras or passes through it, but never misses it; an outline that is shifted misses on one side and runs
/// too deep on the other. The shift is a quantile regression of the misses on the outline's direction: most of the
/// hull's surplus, which only ever lies on one side, does not count.
///
/// @param hull  carved from the same views; it tells where to look
/// @return by view; a shift of 0 without support where there are too few points, or not in all directions
/// Source: consistency of silhouettes under a hull, C. Hernández, F. Schmitt, R. Cipolla, "Silhouette coherence for
/// camera calibration under circular motion", IEEE PAMI 29(2), 2007; R. Koenker, G. Bassett, "Regression quantiles",
/// Econometrica 46(1), 1978.
std::vector<CameraOffset> measure_camera_offsets(const SilhouetteViews& views, const Field& hull,
                                                 const Work& work = {});

struct Realignment {
  size_t view = 0;
  double offset_px = 0;  ///< how far its picture was off
};

/// Finds cameras that were moved since their calibration, by a few pixels, and moves their principal points so that
/// their silhouettes agree with the others' again. With few cameras nobody can tell, and none is moved.
///
/// @param rig    holds the cameras of the views
/// @param views  those of realigned cameras are made anew
/// @return one entry a realigned camera; at most a third of the cameras
std::vector<Realignment> realign_cameras(Rig& rig, SilhouetteViews& views, const Field& hull, const Work& work = {});

}  // namespace booth
