#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <span>
#include <vector>

#include "pipeline/face/control_points.h"
#include "pipeline/face/face_pictures.h"
#include "pipeline/face/neutral_head.h"
#include "pipeline/geometry/silhouette_view.h"
#include "pipeline/types/field.h"
#include "pipeline/types/work.h"

namespace booth {

/// How the neutral head becomes the subject's.
enum class HeadFitMethod {
  smooth,    ///< bends as little as control points and outlines allow
  pyramids,  ///< the paper's: transformation pyramids from the control points alone
};

struct HeadFitOptions {
  HeadFitMethod method = HeadFitMethod::smooth;
  double variation_m = 0.004;  ///< by how much faces differ over 6 cm, standard deviation, 0.0005 … 0.02
  int fewest_features = 20;    ///< landmarks, those of the jaw not counted, without which nothing is fitted, 8 … 51
  double worst_feature_m = 0.008;  ///< median distance of features from the fitted similarity that makes it a failure
};

/// The neutral head in the subject's shape.
struct FittedHead {
  /// The neutral head's vertices and triangles; world frame, metres. By pyramids, vertices outside all of them are
  /// where the similarity puts them.
  Mesh mesh;
  std::vector<uint8_t> face;  ///< per vertex: 1 where the fit says something about the face's surface
  /// Per vertex, 0 … 1: whether the hull is where it would be around that face; 0 where hair or something else is over
  /// it, and where the fit says nothing.
  std::vector<float> bare;
  /// Of the similarity that brought the neutral head to the subject's: p_world = scale · rotation · p_neutral +
  /// translation.
  double scale = 1;
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();
  int features = 0;             ///< landmarks used, those of the jaw not counted
  double feature_median_m = 0;  ///< how far the fitted surface's landmarks are from them, median
  size_t outline_points = 0;    ///< places where an outline holds the fit
};

/// Brings the neutral head to a subject's control points, first by a similarity (robust to wrong points), then by the
/// method asked for. Control points that are missing are predicted: by the mirrored one's deviation from the similarity
/// where that is known, else by the mean of the nearest known deviations.
///
/// Smooth: the displacements of all vertices have the least thin-plate energy, against the control points (weighed by
/// their covariances and a landmark's own vagueness; the jaw's, where sights touch and do not meet, only where there are
/// no outlines), the outlines and the pictures. Where the head's own outline in a view is the whole head's, it lies on
/// the subject's outline, and no vertex of the face lies outside any. Then the pictures are compared on the surface, see
/// match_surface, and it moves to where they agree, first by centimetre-wide windows, at last by finer ones. Glasses,
/// beards and hair give outlines far from where the others want them and lose their say (Geman-McClure).
///
/// @param pictures  from face_pictures, none allowed
/// @param views     outlines of the subject, none allowed
/// @error no_subject  too few control points, or they do not have the shape of a face
/// Cost: five sparse factorizations of the neutral head's size, and three comparisons of the pictures.
/// Source: pyramids: R. Pagés et al., automatic avatar booth, section 4.3. Energy: M. Botsch, O. Sorkine, "On linear
/// variational surface deformation methods", TVCG 14(1), 2008. Similarity: S. Umeyama, PAMI 13(4), 1991.
Result<FittedHead> fit_neutral_head(const NeutralHead& neutral, const FaceControlPoints& controls,
                                    std::span<const FacePicture> pictures, const SilhouetteViews& views,
                                    const Field& hull, const HeadFitOptions& options = {}, const Work& work = {});

}  // namespace booth
