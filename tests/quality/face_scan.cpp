#include "tests/quality/face_scan.h"

#include <bit>

#include "pipeline/geometry/camera_model.h"
#include "replay/recording.h"
#include "tests/quality/face_perturbation.h"
#include "tests/quality/truth.h"

namespace booth::quality {

FaceRecording read_face_recording(const std::filesystem::path& folder, const Work& work) {
  const Recording recording = read_recording(folder).value();
  const Shot& shot = *recording.find(ShotRole::gray_code);
  FaceRecording face{recording.rig, {shot.pattern.value(), load_shot(recording, shot, work).sets}, {}, {}};
  face.truth = read_face_truth(folder);
  const Eigen::Vector3d head = read_joints(folder / "truth/joints.json").at("head");
  face.region = {head - Eigen::Vector3d(0.17, 0.12, 0.17), head + Eigen::Vector3d(0.17, 0.2, 0.17)};
  return face;
}

std::vector<FaceFault> face_faults(const FaceRecording& recording, const RangeScan& clean) {
  const GrayCodeCapture& capture = recording.capture;
  const FaceTruth& truth = recording.truth;
  constexpr uint32_t seed = 5;
  const auto swaying = [&](const std::string& name, const Eigen::Vector3d& sway_m) {
    const int images = pattern_count(capture.pattern);
    const double at = (2 * std::bit_width(static_cast<unsigned>(capture.pattern.width - 1)) - 1.5) / (images - 1);
    FaceFault fault{name, with_sway(capture, recording.rig, clean, sway_m, seed), truth};
    for (size_t i = 0; i < truth.points.size(); ++i) {
      const auto before = project(*recording.rig.projector, truth.points[i]);
      fault.truth.points[i] += at * sway_m;
      const auto after = project(*recording.rig.projector, fault.truth.points[i]);
      if (before && after) fault.truth.projected[i] += *after - *before;
    }
    return fault;
  };
  return {{"noise of 4 grey levels", with_noise(capture, 4, seed), truth},
          {"light of the room, half of the projector's", with_ambient_light(capture, 0.5, seed), truth},
          {"1 image in 10 missing", without_images(capture, 0.1, seed), truth},
          {"1 image in 20 repeats the one before", with_repeats(capture, 0.05, seed), truth},
          swaying("sway of 2 mm sideways", {0.002, 0, 0}),
          swaying("sway of 2 mm forwards", {0, 0, 0.002})};
}

}  // namespace booth::quality
