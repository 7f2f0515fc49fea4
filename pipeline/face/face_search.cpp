#include "pipeline/face/face_search.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <optional>

#include "pipeline/face/head_view.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// The landmark at the mirrored place of a face.
constexpr std::array<size_t, face_landmarks> mirrored{
    16, 15, 14, 13, 12, 11, 10, 9,  8,  7,  6,  5,  4,  3,  2,  1,  0,  26, 25, 24, 23, 22, 21,
    20, 19, 18, 17, 27, 28, 29, 30, 35, 34, 33, 32, 31, 45, 44, 43, 42, 47, 46, 39, 38, 37, 36,
    41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65};

struct Candidate {
  const RigCamera* camera = nullptr;
  const Image* picture = nullptr;
  double merit = 0;
  double aside_rad = 0;  ///< how far to the side of the booth's front the camera stands: to +X positive
};

/// How much of the world around the head is searched.
double searched_width(const HeadRegion& head) {
  constexpr double of_head = 1.5;
  // A collar or long hair shifts what seems to be the neck; no head is much smaller than an adult's share of the
  // stature.
  constexpr double least_of_stature = 0.21;
  return std::max(of_head * static_cast<double>(head.height()), least_of_stature * static_cast<double>(head.crown_y));
}

/// The cameras worth searching, the best first.
std::vector<Candidate> candidates_of(const Rig& rig, std::span<const Frame> frames, const Eigen::Vector3d& head,
                                     size_t most) {
  std::vector<Candidate> candidates;
  for (const Frame& frame : frames) {
    const RigCamera* camera = rig.find(frame.camera);
    if (camera == nullptr || frame.pixels == nullptr) continue;
    const auto at = project(*camera, head);
    if (!at ||
        !(at->x() > 0 && at->y() > 0 && at->x() < camera->intrinsics.width && at->y() < camera->intrinsics.height))
      continue;
    const Eigen::Vector3d to_camera = camera->center() - head;
    const double pixels_per_metre = std::max(camera->intrinsics.fx, camera->intrinsics.fy) / to_camera.norm();
    // Who stands in the booth faces +Z, give or take: from behind there is nothing to find. The box that the detector
    // looks for is about 0.15 m wide.
    constexpr double most_aside = -0.17, fewest_pixels_per_metre = 150;
    const double frontal = to_camera.z() / std::hypot(to_camera.x(), to_camera.z());
    if (frontal < most_aside || pixels_per_metre < fewest_pixels_per_metre) continue;
    candidates.push_back({camera, frame.pixels.get(), (1 + frontal) * std::sqrt(pixels_per_metre),
                          std::atan2(to_camera.x(), to_camera.z())});
  }
  std::sort(candidates.begin(), candidates.end(), [](const Candidate& a, const Candidate& b) {
    return a.merit != b.merit ? a.merit > b.merit : a.camera->id < b.camera->id;
  });
  if (candidates.size() > most) candidates.resize(most);
  std::sort(candidates.begin(), candidates.end(),
            [](const Candidate& a, const Candidate& b) { return a.camera->id < b.camera->id; });
  return candidates;
}

Image mirror(const Image& image) {
  Image flipped(image.width, image.height, 1);
  for (int y = 0; y < image.height; ++y)
    std::reverse_copy(image.pixel(0, y), image.pixel(0, y) + image.width, flipped.pixel(0, y));
  return flipped;
}

/// Landmarks and their spread from several starts, in pixels of the image.
struct RepeatedPrediction {
  FaceLandmarks mean{};
  std::array<double, face_landmarks> spread{};  ///< standard deviation of one prediction along one axis
};

RepeatedPrediction predict_repeatedly(const LandmarkPredictor& predictor, const Image& image,
                                      const Eigen::AlignedBox2d& box) {
  struct Start {
    double right, down, size;  ///< of the box
    bool mirrored;
  };
  constexpr std::array<Start, 4> starts{
      {{0.02, 0.02, 1.03, false}, {-0.02, -0.02, 0.97, false}, {0.02, -0.02, 0.97, true}, {-0.02, 0.02, 1.03, true}}};
  const Image flipped = mirror(image);
  std::array<FaceLandmarks, starts.size()> predictions;
  for (size_t i = 0; i < starts.size(); ++i) {
    const Start& start = starts[i];
    const Eigen::Vector2d half = box.sizes() / 2 * start.size;
    Eigen::Vector2d middle = box.center() + Eigen::Vector2d(start.right, start.down).cwiseProduct(box.sizes());
    if (!start.mirrored) {
      predictions[i] = predictor.predict(image, {middle - half, middle + half});
      continue;
    }
    middle.x() = image.width - 1 - middle.x();
    const FaceLandmarks there = predictor.predict(flipped, {middle - half, middle + half});
    for (size_t l = 0; l < face_landmarks; ++l)
      predictions[i][l] = {image.width - 1 - there[mirrored[l]].x(), there[mirrored[l]].y()};
  }
  RepeatedPrediction result;
  for (size_t l = 0; l < face_landmarks; ++l) {
    Eigen::Vector2d sum = Eigen::Vector2d::Zero();
    for (const FaceLandmarks& prediction : predictions) sum += prediction[l];
    result.mean[l] = sum / static_cast<double>(starts.size());
    double squares = 0;
    for (const FaceLandmarks& prediction : predictions) squares += (prediction[l] - result.mean[l]).squaredNorm();
    result.spread[l] = std::sqrt(squares / static_cast<double>(2 * (starts.size() - 1)));
  }
  return result;
}

/// The face that a camera sees around the head, if it sees one.
/// @param searched_px  width of the picture in which the face is looked for
std::optional<SeenFace> find_face(const Candidate& candidate, const HeadRegion& head, int searched_px,
                                  const LandmarkPredictor& predictor) {
  const RigCamera& camera = *candidate.camera;
  const Eigen::Vector3d middle = head.barycentre.cast<double>();
  const double searched_m = searched_width(head);
  const auto view = upright_view(camera, middle, searched_m, searched_px);
  if (!view) return std::nullopt;
  const auto faces = predictor.detect(render_view(camera, *candidate.picture, *view));
  if (faces.empty()) return std::nullopt;

  // Closer, so that a landmark's place is not a matter of whole pixels.
  const DetectedFace& face = faces.front();
  constexpr double box_px = 200, around = 1.8;
  const double metres_per_pixel = searched_m / searched_px;
  const double box_m = face.box.sizes().mean() * metres_per_pixel;
  const double distance = (middle - camera.center()).norm();
  const auto closer = upright_view(camera, camera.center() + distance * world_ray(*view, face.box.center()),
                                   around * box_m, static_cast<int>(around * box_px));
  if (!closer) return std::nullopt;
  const Eigen::Vector2d center(closer->intrinsics.cx, closer->intrinsics.cy), half(box_px / 2, box_px / 2);
  SeenFace seen;
  seen.picture = {*closer, render_view(camera, *candidate.picture, *closer)};
  const RepeatedPrediction prediction =
      predict_repeatedly(predictor, seen.picture.grey, {center - half, center + half});
  seen.observation.camera = camera.id;
  seen.observation.score = face.score;
  const auto here = pixel_in_camera(camera, *closer, center);
  const auto aside = pixel_in_camera(camera, *closer, center + Eigen::Vector2d::UnitX());
  if (!here || !aside) return std::nullopt;
  const double scale = (*aside - *here).norm();
  seen.observation.box_px = scale * box_px;
  for (size_t l = 0; l < face_landmarks; ++l) {
    const auto pixel = pixel_in_camera(camera, *closer, prediction.mean[l]);
    if (!pixel) return std::nullopt;
    seen.observation.pixels[l] = *pixel;
    seen.observation.sigma_px[l] = scale * prediction.spread[l];
  }
  return seen;
}

/// Whether faces were seen from both sides of the booth's front: then cameras beyond see the head's sides.
bool seen_from_both_sides(const std::vector<Candidate>& candidates, const std::vector<std::optional<SeenFace>>& found) {
  constexpr double clearly_rad = 0.1;
  bool left = false, right = false;
  for (size_t i = 0; i < candidates.size(); ++i) {
    left = left || (found[i] && candidates[i].aside_rad > clearly_rad);
    right = right || (found[i] && candidates[i].aside_rad < -clearly_rad);
  }
  return left && right;
}

}  // namespace

FaceSearch search_faces(const Rig& rig, std::span<const Frame> frames, const HeadRegion& head,
                        const LandmarkPredictor& predictor, size_t most_cameras, const Work& work) {
  const auto candidates = candidates_of(rig, frames, head.barycentre.cast<double>(), most_cameras);
  std::vector<std::optional<SeenFace>> found(candidates.size());
  const auto look = [&](double farthest_aside_rad, int searched_px) {
    work.parallel_for(candidates.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end && !work.stopped(); ++i)
        if (!found[i] && std::abs(candidates[i].aside_rad) < farthest_aside_rad)
          found[i] = find_face(candidates[i], head, searched_px, predictor);
    });
  };
  // Detectors want a face's box to be 80 pixels wide. It is 95 or more in the small picture, unless what seems to be
  // the head is much larger than it, or smaller than heads are: then the large one shows the face as well.
  constexpr int small_px = 256, large_px = 320;
  constexpr double frontal_rad = 1.2, anywhere_rad = 3.2;
  look(frontal_rad, small_px);
  if (!seen_from_both_sides(candidates, found)) look(anywhere_rad, large_px);
  FaceSearch search;
  search.searched = candidates.size();
  for (auto& face : found)
    if (face) search.faces.push_back(std::move(*face));
  return search;
}

}  // namespace booth
