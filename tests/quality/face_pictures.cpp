// face_pictures RECORDING LANDMARKS CAMERA LEFT TOP WIDTH HEIGHT OUT.jpg
//
// Side by side, as a camera of the recording sees them: the face of the hull, the passive and the active one, and that
// part of the camera's photograph; below, the shapes alone and the true one. LANDMARKS is the model for the passive
// face. replay/pictures/faces.jpg is made by it.

#include <algorithm>
#include <array>
#include <cmath>
#include <exception>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/reconstruct.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/landmark_model.h"
#include "tests/quality/measures.h"
#include "tests/quality/panels.h"

namespace booth::quality {
namespace {

constexpr std::array<uint8_t, 3> background{230, 230, 230};

std::pair<CaptureFrames, FaceCapture> load_capture(const std::filesystem::path& folder, const Work& work) {
  const Recording recording = read_recording(folder).value();
  const auto sets_of = [&](ShotRole role) {
    const Shot* shot = recording.find(role);
    if (shot == nullptr) throw std::runtime_error("the recording lacks a shot: " + std::string(to_string(role)));
    return load_shot(recording, *shot, work).sets;
  };
  CaptureFrames capture;
  capture.rig = recording.rig;
  capture.background = learn_empty_booth(sets_of(ShotRole::background), work).views;
  capture.body = sets_of(ShotRole::body).at(0);
  FaceCapture face;
  face.patterns = {recording.find(ShotRole::gray_code)->pattern.value(), sets_of(ShotRole::gray_code)};
  return {std::move(capture), std::move(face)};
}

FaceModel read_model(const std::string& landmarks) {
  auto predictor = read_landmarks(landmarks);
  if (!predictor) throw std::runtime_error(landmarks + " cannot be opened");
  return {std::move(predictor), std::make_shared<const NeutralHead>(*parse_neutral_head(built_in_neutral_head()))};
}

/// The shape alone, as plaster lit from above the camera's left.
Image render_shape(const Mesh& mesh, const CalibratedView& view, const Window& window) {
  const RayCaster caster(mesh);
  const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
  const Eigen::Vector3f light =
      (view.camera_from_world.linear().transpose() * Eigen::Vector3d(-0.6, -0.6, -1).normalized()).cast<float>();
  constexpr float ambient = 0.25F, direct = 0.7F;
  constexpr std::array<double, 2> offsets{-0.25, 0.25};
  Image picture(window.width, window.height, 3);
  for (int y = 0; y < picture.height; ++y)
    for (int x = 0; x < picture.width; ++x) {
      float grey = 0;
      for (const double dy : offsets)
        for (const double dx : offsets) {
          const auto hit = caster.cast(view.center(), world_ray(view, {window.left + x + dx, window.top + y + dy}));
          if (!hit) {
            grey += 0.25F * static_cast<float>(background[0]) / 255;
            continue;
          }
          const auto& triangle = mesh.triangles[hit->triangle];
          Eigen::Vector3f normal = Eigen::Vector3f::Zero();
          for (int corner = 0; corner < 3; ++corner)
            normal += hit->corner_weights[corner] * normals[triangle[static_cast<size_t>(corner)]];
          grey += 0.25F * (ambient + direct * std::max(0.0F, normal.normalized().dot(light)));
        }
      std::fill_n(picture.pixel(x, y), 3, static_cast<uint8_t>(std::lround(255 * std::min(grey, 1.0F))));
    }
  return picture;
}

void run(const std::filesystem::path& recording, const std::string& landmarks, const std::string& camera,
         const Window& window, const std::string& out) {
  ThreadPool pool;
  const Work work = pool.work();
  const auto [capture, face] = load_capture(recording, work);
  const FaceModel model = read_model(landmarks);
  const RigCamera* view = capture.rig.find(camera);
  const auto photograph = std::find_if(capture.body.frames.begin(), capture.body.frames.end(),
                                       [&](const Frame& frame) { return frame.camera == camera; });
  if (view == nullptr || photograph == capture.body.frames.end())
    throw std::runtime_error("the recording has no photograph of a camera " + camera);
  std::vector<Image> faces, shapes;
  for (const FaceMode mode : {FaceMode::none, FaceMode::passive, FaceMode::active}) {
    ReconstructionOptions options;
    options.face = mode;
    const FaceSources sources{.model = [&] { return Result<FaceModel>(model); },
                              .detector = {},
                              .capture = [&scan = face] { return Result<FaceCapture>(scan); }};
    const auto made = reconstruct(capture, options, sources, work);
    if (!made) throw std::runtime_error(made.error().message);
    if (made->face != mode) throw std::runtime_error("no face was made: " + std::string(to_string(mode)));
    const RayCaster caster(made->avatar.mesh);
    faces.push_back(render_view(caster, made->avatar, *view, window, background));
    shapes.push_back(render_shape(made->avatar.mesh, *view, window));
  }
  faces.push_back(part_of(*photograph->pixels, window));
  shapes.push_back(render_shape(read_ply(recording / "truth/mesh.ply"), *view, window));
  write_jpeg(in_rows({faces, shapes}), out);
}

}  // namespace
}  // namespace booth::quality

int main(int argc, char** argv) {
  if (argc != 9) {
    std::cerr << "usage: face_pictures RECORDING LANDMARKS CAMERA LEFT TOP WIDTH HEIGHT OUT.jpg\n";
    return 2;
  }
  try {
    booth::quality::run(argv[1], argv[2], argv[3],
                        {std::stoi(argv[4]), std::stoi(argv[5]), std::stoi(argv[6]), std::stoi(argv[7])}, argv[8]);
  } catch (const std::exception& e) {
    std::cerr << "face_pictures: " << e.what() << "\n";
    return 1;
  }
}
