#pragma once

#include <Eigen/Core>
#include <optional>
#include <span>
#include <vector>

#include "pipeline/types/rig.h"

namespace booth {

/// Where one view sees a point.
struct Sighting {
  const CalibratedView* view = nullptr;             ///< must outlive the sighting
  Eigen::Vector2d pixel = Eigen::Vector2d::Zero();  ///< distorted, as captured
  double sigma_px = 1;                              ///< standard deviation along either axis, > 0
};

struct TriangulatedPoint {
  Eigen::Vector3d position = Eigen::Vector3d::Zero();        ///< world frame, metres
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();  ///< world frame, square metres, from the sightings' sigmas
  double chi_square = 0;       ///< sum of the squared reprojection errors, each by its sigma
  int degrees_of_freedom = 0;  ///< 2 × sightings − 3
};

/// The point seen by two pinhole views: both pixels are moved by the least squared sum, in units of their sigmas, that
/// brings their rays together, which is the place of highest likelihood under Gaussian noise and does not depend on the
/// world frame. The least is found among the zeros of a polynomial of degree six, so that no start is needed and no
/// local minimum is taken for it.
///
/// Noise is taken to be even in the undistorted image, which it is to within a hundredth or so for the distortions of
/// common lenses.
///
/// @return world frame, metres; nothing where both views are in one place or the point would not be before them both
/// Source: R. Hartley, P. Sturm, "Triangulation", CVIU 68(2), 1997; R. Hartley, A. Zisserman, "Multiple View Geometry",
/// 2nd edition, algorithm 12.1.
std::optional<Eigen::Vector3d> triangulate_pair(const Sighting& a, const Sighting& b);

/// The point of highest likelihood under Gaussian noise for two or more views: Levenberg's iteration on the
/// reprojection errors in distorted pixels.
///
/// @param start  world frame, e.g. of triangulate_pair for two of the views
/// @return nothing where the point leaves a view's front or the sightings do not fix it (rays almost parallel)
/// Source: the bundle adjustment of one point, B. Triggs et al., "Bundle adjustment, a modern synthesis", 1999.
std::optional<TriangulatedPoint> triangulate_views(std::span<const Sighting> sightings, const Eigen::Vector3d& start);

struct ConsensusPoint {
  TriangulatedPoint point;
  std::vector<bool> agrees;  ///< per sighting: it took part
};

/// The point that most of the sightings agree on, when some of them are wrong altogether. Every pair of views proposes
/// one, and the proposal is taken that most views see within `most_sigmas`, of those as many agree on, the one with the
/// least error; all views that agree then fix the point together.
///
/// All pairs are tried, not a random choice of them: cameras that see a face are few.
///
/// @param most_sigmas  largest distance of a sighting from the point's projection, in units of its sigma
/// @return nothing where no two views agree
/// Source: M. Fischler, R. Bolles, "Random sample consensus", CACM 24(6), 1981.
std::optional<ConsensusPoint> triangulate_consensus(std::span<const Sighting> sightings, double most_sigmas);

}  // namespace booth
