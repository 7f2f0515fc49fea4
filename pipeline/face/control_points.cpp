#include "pipeline/face/control_points.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "pipeline/face/face_search.h"

namespace booth {
namespace {

double angle_between(const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
  return std::atan2(a.cross(b).norm(), a.dot(b));
}

/// The face as the most frontal camera sees it, and as those do whose pictures can be compared with that.
struct Comparison {
  const PinholePicture* reference = nullptr;
  std::vector<const PinholePicture*> others;
};

Comparison choose_pictures(std::span<const SeenFace> faces, const FaceControlPoints& placed) {
  std::vector<const PinholePicture*> pictures;
  for (const SeenFace& face : faces)
    if (std::any_of(placed.observations.begin(), placed.observations.end(),
                    [&](const FaceObservation& seen) { return seen.camera == face.observation.camera; }))
      pictures.push_back(&face.picture);
  const auto aside = [&](const PinholePicture* picture, const Eigen::Vector3d& direction) {
    return angle_between(picture->view.center() - placed.frame.middle, direction);
  };
  Comparison comparison;
  comparison.reference = *std::min_element(pictures.begin(), pictures.end(), [&](const auto* a, const auto* b) {
    return aside(a, placed.frame.forward) < aside(b, placed.frame.forward);
  });
  constexpr double farthest_aside_rad = 0.9;  // skin looks too different beyond
  for (const PinholePicture* picture : pictures)
    if (picture != comparison.reference &&
        aside(picture, comparison.reference->view.center() - placed.frame.middle) < farthest_aside_rad)
      comparison.others.push_back(picture);
  return comparison;
}

/// Moves a landmark to where the pictures agree on the skin around it. Where they do not tell, its depth is uncertain
/// by how much people differ from the depth the predictor has learnt.
void find_depth(const Comparison& comparison, const FaceFrame& frame, ControlPoint* point) {
  const auto match = match_patch(*comparison.reference, comparison.others, point->position, frame.forward);
  if (!match) {
    const double depth_error_m = 0.06 * frame.eye_distance_m;
    point->covariance += depth_error_m * depth_error_m * frame.forward * frame.forward.transpose();
    return;
  }
  const Eigen::Vector3d sight = (point->position - comparison.reference->view.center()).normalized();
  point->position += match->depth_m * sight;
  // Across the sight nothing is known better than before.
  const Eigen::Matrix3d across = Eigen::Matrix3d::Identity() - sight * sight.transpose();
  point->covariance = across * point->covariance * across + match->sigma_m * match->sigma_m * sight * sight.transpose();
}

}  // namespace

Result<FaceControlPoints> find_control_points(const Rig& rig, std::span<const Frame> frames, const HeadRegion& head,
                                              const LandmarkPredictor& predictor, const ControlPointOptions& options,
                                              const Work& work) {
  const FaceSearch search =
      search_faces(rig, frames, head, predictor, static_cast<size_t>(std::max(2, options.most_cameras)), work);
  if (work.stopped()) return Work::cancelled();
  if (search.faces.empty())
    return Error{ErrorCode::no_subject, search.searched == 0 ? "no camera sees the head from the front large enough"
                                                             : "no camera shows a face: it is turned away or covered"};
  if (search.faces.size() == 1)
    return Error{ErrorCode::too_few_views,
                 "only one camera shows the face: " + search.faces.front().observation.camera};
  std::vector<FaceObservation> observations;
  for (const SeenFace& face : search.faces) observations.push_back(face.observation);
  auto placed = place_landmarks(rig, std::move(observations), head, options.most_sigmas);
  if (!placed) return placed.error();

  const Comparison comparison = choose_pictures(search.faces, *placed);
  work.parallel_for(face_landmarks, 4, [&](size_t begin, size_t end) {
    for (size_t l = begin; l < end; ++l)
      if (placed->points[l] && !placed->points[l]->contour) find_depth(comparison, placed->frame, &*placed->points[l]);
  });
  return placed;
}

}  // namespace booth
