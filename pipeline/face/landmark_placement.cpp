#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>

#include "pipeline/face/control_points.h"
#include "pipeline/geometry/point_triangulation.h"

namespace booth {
namespace {

constexpr size_t first_inner_landmark = 17;  // after the jaw line
constexpr size_t inner_landmarks = face_landmarks - first_inner_landmark;

/// One camera's observation with what it was before it was rated.
struct View {
  const RigCamera* camera = nullptr;
  FaceObservation seen;
  std::array<double, face_landmarks> spread_px{};  ///< of repeated predictions
};

/// How far a predictor's landmark is off the true place in a frontal picture, standard deviation along one axis, as a
/// share of the detector's box: what repeated prediction does not show, because the model errs the same way each time.
/// About twice what dlib shows on rendered heads.
double model_error(size_t landmark) {
  if (landmark < 17) return 0.020;  // jaw line
  if (landmark < 27) return 0.014;  // brows, which have no corners
  if (landmark < 36) return 0.010;  // nose
  if (landmark < 48) return 0.008;  // eyes
  return 0.010;                     // lips
}

using Placed = std::array<std::optional<ConsensusPoint>, face_landmarks>;

std::optional<FaceFrame> face_frame(const Placed& points) {
  const auto mean_of = [&](size_t first, size_t last) -> std::optional<Eigen::Vector3d> {
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    int count = 0;
    for (size_t l = first; l < last; ++l)
      if (points[l]) {
        sum += points[l]->point.position;
        ++count;
      }
    if (count == 0) return std::nullopt;
    return sum / count;
  };
  const auto right_eye = mean_of(36, 42), left_eye = mean_of(42, 48), mouth = mean_of(48, 68);
  if (!right_eye || !left_eye || !mouth) return std::nullopt;
  FaceFrame frame;
  const Eigen::Vector3d eyes = (*left_eye + *right_eye) / 2, across = *left_eye - *right_eye;
  frame.middle = (eyes + *mouth) / 2;
  frame.eye_distance_m = across.norm();
  frame.up = (eyes - *mouth).normalized();
  frame.left = across.normalized();
  frame.forward = across.cross(eyes - *mouth).normalized();
  return frame;
}

/// The angle at which a view sees the face, radians: 0 from the front.
double turned_away(const View& face, const Eigen::Vector3d& middle, const Eigen::Vector3d& forward) {
  const Eigen::Vector3d to_camera = (face.camera->center() - middle).normalized();
  return std::acos(std::clamp(to_camera.dot(forward), -1.0, 1.0));
}

/// Standard deviations of what one view shows, by how the face is turned from it; from the front where that is not yet
/// known.
void rate_uncertainty(const std::optional<FaceFrame>& frame, const Placed& points, View* face) {
  constexpr double well_known_rad = 0.6;  // predictors are trained on faces turned by up to about 35° most
  // What lies on the far side of a turned face is foreshortened or hidden: there the predictor guesses.
  constexpr double far_side = 3;
  const double turned = frame ? turned_away(*face, frame->middle, frame->forward) : 0;
  const double sideways = frame ? (face->camera->center() - frame->middle).normalized().dot(frame->left) : 0;
  for (size_t l = 0; l < face_landmarks; ++l) {
    const double place =
        frame && points[l] ? (points[l]->point.position - frame->middle).dot(frame->left) / frame->eye_distance_m : 0;
    const double growth = 1 + std::pow(turned / well_known_rad, 2) + far_side * std::max(0.0, -2 * place * sideways);
    face->seen.sigma_px[l] = std::hypot(face->spread_px[l], growth * model_error(l) * face->seen.box_px);
  }
}

std::vector<Sighting> sightings_of(std::span<const View> faces, size_t landmark) {
  std::vector<Sighting> sightings;
  for (const View& face : faces)
    sightings.push_back({face.camera, face.seen.pixels[landmark], face.seen.sigma_px[landmark]});
  return sightings;
}

/// Triangulates the landmarks of [first, last) and marks in the faces who agrees.
void triangulate_landmarks(size_t first, size_t last, double most_sigmas, std::span<View> faces, Placed* points) {
  for (size_t l = first; l < last; ++l) {
    (*points)[l] = triangulate_consensus(sightings_of(faces, l), most_sigmas);
    for (size_t f = 0; f < faces.size(); ++f) faces[f].seen.agrees[l] = (*points)[l] && (*points)[l]->agrees[f];
  }
}

/// Leaves out the views most of whose inner landmarks do not agree with the others'.
/// @return whether there were such
bool drop_strangers(const Placed& points, std::vector<View>* faces) {
  const auto placed =
      std::count_if(points.begin() + first_inner_landmark, points.end(), [](const auto& p) { return p.has_value(); });
  const auto agreeing = [](const View& face) {
    return std::count(face.seen.agrees.begin() + first_inner_landmark, face.seen.agrees.end(), true);
  };
  // One at a time, the worst first: it may be what keeps others from agreeing.
  const auto worst = std::min_element(faces->begin(), faces->end(), [&](const View& a, const View& b) {
    const auto of_a = agreeing(a), of_b = agreeing(b);
    return of_a != of_b ? of_a < of_b : a.seen.score < b.seen.score;
  });
  if (worst == faces->end() || (placed > 0 && 2 * agreeing(*worst) >= placed)) return false;
  faces->erase(worst);
  return true;
}

/// Whether what was triangulated can be the face of that head; the reason why not.
std::optional<std::string> implausible(const Placed& points, const std::optional<FaceFrame>& frame,
                                       const HeadRegion& head) {
  const auto placed = static_cast<size_t>(
      std::count_if(points.begin() + first_inner_landmark, points.end(), [](const auto& p) { return p.has_value(); }));
  constexpr size_t fewest = inner_landmarks * 2 / 3;
  if (!frame || placed < fewest)
    return "the cameras agree on " + std::to_string(placed) + " of its " + std::to_string(inner_landmarks) +
           " features only";
  // Pupils are 40 mm apart at birth and 62 ± 4 mm in adults.
  constexpr double closest_eyes_m = 0.036, widest_eyes_m = 0.082;
  if (frame->eye_distance_m < closest_eyes_m || frame->eye_distance_m > widest_eyes_m)
    return "its eyes would be " + std::to_string(std::lround(1000 * frame->eye_distance_m)) + " mm apart";
  constexpr double upright = 0.64;  // cos 50°
  if (frame->up.y() < upright) return std::string("it would not be upright");
  const Eigen::Vector3d from_head = frame->middle - head.barycentre.cast<double>();
  const double size = std::max(static_cast<double>(head.height()), 0.1 * static_cast<double>(head.crown_y));
  if (from_head.norm() > size || from_head.dot(frame->forward) < 0) return std::string("it would not be on the head");
  return std::nullopt;
}

/// What a landmark of the jaw line is uncertain by beyond the pixels: views touch the face at different places. Two
/// that are 2θ apart, both tangent to a round of radius r, meet r (1/cos θ − 1) before it.
Eigen::Matrix3d contour_covariance(const Eigen::Vector3d& point, const std::vector<bool>& agrees,
                                   std::span<const View> faces) {
  double widest_rad = 0;
  for (size_t i = 0; i < faces.size(); ++i)
    for (size_t j = 0; j < i; ++j) {
      if (!agrees[i] || !agrees[j]) continue;
      const Eigen::Vector3d a = faces[i].camera->center() - point, b = faces[j].camera->center() - point;
      widest_rad = std::max(widest_rad, std::atan2(a.cross(b).norm(), a.dot(b)));
    }
  constexpr double jaw_radius_m = 0.06, along_outline_m = 0.004;
  constexpr double most_rad = 2;  // beyond, they do not see the same outline at all
  const double before_m = jaw_radius_m * (1 / std::cos(std::min(widest_rad, most_rad) / 2) - 1);
  return (before_m * before_m + along_outline_m * along_outline_m) * Eigen::Matrix3d::Identity();
}

std::string names_of(std::span<const View> faces) {
  std::string names;
  for (const View& face : faces) names += (names.empty() ? "" : ", ") + face.camera->id;
  return names;
}

}  // namespace

Result<FaceControlPoints> place_landmarks(const Rig& rig, std::vector<FaceObservation> observations,
                                          const HeadRegion& head, double most_sigmas) {
  std::vector<View> faces;
  for (FaceObservation& observation : observations) {
    const RigCamera* camera = rig.find(observation.camera);
    if (camera == nullptr) continue;
    const auto spread = observation.sigma_px;
    faces.push_back({camera, std::move(observation), spread});
  }
  std::sort(faces.begin(), faces.end(), [](const View& a, const View& b) { return a.seen.camera < b.seen.camera; });
  const std::string seen_by = names_of(faces);
  if (faces.size() < 2) return Error{ErrorCode::too_few_views, "fewer than two cameras show the face: " + seen_by};
  Placed points;
  std::optional<FaceFrame> frame;
  // How far the face is turned from each view decides how its landmarks are weighed, and comes out of them.
  constexpr int most_rounds = 4;
  for (int round = 0; round < most_rounds; ++round) {
    for (View& face : faces) rate_uncertainty(frame, points, &face);
    do {
      triangulate_landmarks(first_inner_landmark, face_landmarks, most_sigmas, faces, &points);
    } while (drop_strangers(points, &faces) && faces.size() >= 2);
    if (faces.size() < 2)
      return Error{ErrorCode::too_few_views, "no two cameras agree on the face that they show: " + seen_by};
    frame = face_frame(points);
    if (const auto reason = implausible(points, frame, head))
      return Error{ErrorCode::no_subject, "what " + seen_by + " show is no face of this person: " + *reason};
  }
  triangulate_landmarks(0, first_inner_landmark, most_sigmas, faces, &points);

  // Agreement is worse than the sigmas say, for all landmarks together, where the predictor finds this face hard.
  double chi_square = 0, freedom = 0;
  for (size_t l = first_inner_landmark; l < face_landmarks; ++l)
    if (points[l]) {
      chi_square += points[l]->point.chi_square;
      freedom += points[l]->point.degrees_of_freedom;
    }
  const double inflation = freedom > 0 ? std::max(1.0, chi_square / freedom) : 1.0;
  FaceControlPoints result;
  result.frame = *frame;
  for (size_t l = 0; l < face_landmarks; ++l) {
    if (!points[l]) continue;
    ControlPoint point{points[l]->point.position, inflation * points[l]->point.covariance,
                       static_cast<int>(std::count(points[l]->agrees.begin(), points[l]->agrees.end(), true)),
                       is_contour_landmark(l)};
    if (point.contour) point.covariance += contour_covariance(point.position, points[l]->agrees, faces);
    result.points[l] = point;
  }
  for (View& face : faces) result.observations.push_back(std::move(face.seen));
  return result;
}

}  // namespace booth
