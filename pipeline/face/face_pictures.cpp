#include "pipeline/face/face_pictures.h"

#include <algorithm>
#include <cmath>
#include <optional>

#include "pipeline/face/head_view.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {

std::vector<FacePicture> face_pictures(const Rig& rig, std::span<const Frame> frames, const FaceFrame& face,
                                       const Work& work, size_t most_cameras) {
  struct Choice {
    const RigCamera* camera;
    const Image* picture;
    double pixels_per_metre, merit;
  };
  std::vector<Choice> choices;
  for (const Frame& frame : frames) {
    const RigCamera* camera = rig.find(frame.camera);
    if (camera == nullptr || frame.pixels == nullptr || !project(*camera, face.middle)) continue;
    const Eigen::Vector3d to_camera = camera->center() - face.middle;
    const double pixels_per_metre = std::max(camera->intrinsics.fx, camera->intrinsics.fy) / to_camera.norm();
    constexpr double most_aside = -0.17, fewest_pixels_per_metre = 100;  // cos 100°: beyond there is but a rim
    const double frontal = to_camera.normalized().dot(face.forward);
    if (frontal < most_aside || pixels_per_metre < fewest_pixels_per_metre) continue;
    choices.push_back({camera, frame.pixels.get(), pixels_per_metre, (1 + frontal) * std::sqrt(pixels_per_metre)});
  }
  std::sort(choices.begin(), choices.end(), [](const Choice& a, const Choice& b) {
    return a.merit != b.merit ? a.merit > b.merit : a.camera->id < b.camera->id;
  });
  if (choices.size() > most_cameras) choices.resize(most_cameras);
  std::sort(choices.begin(), choices.end(),
            [](const Choice& a, const Choice& b) { return a.camera->id < b.camera->id; });

  constexpr double width_of_eye_distance = 4, most_pixels_per_metre = 1200;
  const double width_m = width_of_eye_distance * face.eye_distance_m;
  std::vector<std::optional<FacePicture>> rendered(choices.size());
  work.parallel_for(choices.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      const auto& [camera, picture, pixels_per_metre, merit] = choices[i];
      const auto width_px = static_cast<int>(std::ceil(width_m * std::min(pixels_per_metre, most_pixels_per_metre)));
      if (const auto view = upright_view(*camera, face.middle, width_m, width_px))
        rendered[i] =
            FacePicture{{*view, render_view(*camera, *picture, *view)}, render_matte(*camera, *picture, *view)};
    }
  });
  std::vector<FacePicture> pictures;
  for (auto& picture : rendered)
    if (picture) pictures.push_back(std::move(*picture));
  return pictures;
}

}  // namespace booth
