#include "pipeline/hull/rig_correction.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>

#include "pipeline/hull/camera_alignment.h"
#include "pipeline/hull/visual_hull.h"

namespace booth {
namespace {

/// Standard deviations of a camera's pose without any sample, pixels: of one that was moved, as good as free; of one
/// that was not, times the noise of its samples.
constexpr double free_px = 10;
constexpr double held_px = 0.2;
constexpr int refinements = 3;
/// In a good rig no camera deviates by more.
constexpr double doubtful = 7;

/// One capture's hull and the views that it explains, of cameras of the common rig.
struct Capture {
  SilhouetteViews views;
  Field hull;
};

/// Carves each capture by itself, which overrules masks that lack a limb, and sees it with the cameras of `rig`.
Result<std::vector<Capture>> carve_all(Rig& rig, std::span<const std::vector<Silhouette>> captures,
                                       const RigCorrectionOptions& options, std::vector<std::string>& messages,
                                       const Work& work) {
  std::vector<Capture> carved;
  std::optional<Error> fault;
  for (size_t n = 0; n < captures.size(); ++n) {
    auto hull = carve_visual_hull(rig, captures[n], {.voxel_m = options.voxel_m}, work);
    if (work.stopped()) return Work::cancelled();
    if (!hull) {
      if (!fault) fault = hull.error();
      messages.push_back("capture " + std::to_string(n + 1) + " was left out: " + hull.error().message);
      continue;
    }
    Capture capture{{}, std::move(hull->field)};
    for (const auto& view : hull->views)
      for (const RigCamera& camera : rig.cameras)
        if (camera.id == view->camera().id)
          capture.views.push_back(std::make_unique<SilhouetteView>(camera, view->coverage()));
    carved.push_back(std::move(capture));
  }
  if (carved.empty())
    return fault.value_or(Error{ErrorCode::invalid_argument, "no capture to correct the cameras from"});
  return carved;
}

/// By camera, how far the rays of its outline miss the others' hull.
std::vector<double> misses_of(std::span<const CoherenceSample> samples, size_t cameras) {
  std::vector<double> squares(cameras), counts(cameras);
  for (const CoherenceSample& sample : samples) {
    squares[sample.slopes[0].view] += std::pow(std::max(0.0, sample.miss_px), 2);
    counts[sample.slopes[0].view] += 1;
  }
  for (size_t c = 0; c < cameras; ++c) squares[c] = counts[c] > 0 ? std::sqrt(squares[c] / counts[c]) : 0;
  return squares;
}

double largest(const Eigen::Matrix3d& covariance) {
  return std::sqrt(std::max(0.0, Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(covariance).eigenvalues().maxCoeff()));
}

/// Moves the cameras that moved to where all samples want them, measured anew each time. @return by camera, how
/// certain they are then; empty when it was stopped
std::vector<PoseUncertainty> refine(AlignmentScenes& scenes, const std::vector<CameraDeviation>& found,
                                    const Work& work) {
  std::vector<PoseUncertainty> certain(scenes.cameras());
  for (int round = 0; round <= refinements; ++round) {
    const std::vector<CoherenceSample> samples = scenes.sample(work);
    if (work.stopped()) return {};
    const PoseEstimation estimation(samples, scenes.scales(samples));
    std::vector<double> prior_px;
    for (size_t c = 0; c < scenes.cameras(); ++c)
      prior_px.push_back(found[c].moved ? free_px : held_px * estimation.scale(c).noise_px);
    const PoseSolution solution = estimation.solve(prior_px);
    if (round < refinements) {
      for (size_t c = 0; c < scenes.cameras(); ++c)
        if (found[c].moved)
          scenes.put(c, changed_pose(scenes.camera(c).camera_from_world, estimation.change(solution, c)));
      continue;
    }
    const Eigen::MatrixXd covariance =
        solution.information.llt().solve(Eigen::MatrixXd::Identity(solution.px.size(), solution.px.size()));
    for (size_t c = 0; c < scenes.cameras(); ++c) {
      const PoseChange per_px = estimation.scale(c).px.cwiseInverse();
      const auto at = static_cast<Eigen::Index>(6 * c);
      const Eigen::Matrix<double, 6, 6> pose =
          per_px.asDiagonal() * covariance.block<6, 6>(at, at) * per_px.asDiagonal();
      // A small motion carries the centre by minus its translation.
      certain[c] = {.center_m = largest(pose.bottomRightCorner<3, 3>()),
                    .rotation_rad = largest(pose.topLeftCorner<3, 3>())};
    }
  }
  return certain;
}

}  // namespace

Result<RigCorrection> correct_rig(const Rig& rig, std::span<const std::vector<Silhouette>> captures,
                                  const RigCorrectionOptions& options, const Work& work) {
  RigCorrection correction;
  correction.rig = rig;
  auto carved = carve_all(correction.rig, captures, options, correction.messages, work);
  if (!carved) return carved.error();
  std::vector<AlignmentScene> shown;
  for (Capture& capture : *carved) shown.push_back({&capture.views, &capture.hull});
  AlignmentScenes scenes(correction.rig, shown);
  if (scenes.cameras() == 0)
    return Error{ErrorCode::too_few_views, "with fewer than six cameras nobody can tell which of them moved"};
  std::vector<CameraDeviation> found(scenes.cameras());
  std::vector<PoseUncertainty> certain(scenes.cameras());
  // Once the first are where they belong, one that was moved by less stands out.
  for (size_t moved = 0; moved <= scenes.cameras() / 3;) {
    const std::vector<CameraDeviation> look = realign_cameras(scenes, work);
    if (work.stopped()) return Work::cancelled();
    const size_t before = moved;
    for (size_t c = 0; c < look.size(); ++c) {
      if (found[c].moved) continue;
      found[c] = look[c];
      moved += look[c].moved ? 1 : 0;
    }
    if (moved == before) break;
    certain = refine(scenes, found, work);
  }
  const bool any = std::any_of(found.begin(), found.end(), [](const CameraDeviation& one) { return one.moved; });
  if (work.stopped()) return Work::cancelled();
  const std::vector<double> after_px = misses_of(scenes.sample(work), scenes.cameras());
  std::vector<Eigen::Isometry3d> corrected;
  for (size_t c = 0; c < scenes.cameras(); ++c) {
    corrected.push_back(scenes.camera(c).camera_from_world);
    scenes.put(c, rig.find(scenes.camera(c).id)->camera_from_world);
  }
  const std::vector<CoherenceSample> as_calibrated = scenes.sample(work);
  if (work.stopped()) return Work::cancelled();
  const std::vector<double> before_px = misses_of(as_calibrated, scenes.cameras());
  for (const RigCamera& camera : rig.cameras)
    for (size_t c = 0; c < scenes.cameras(); ++c) {
      if (scenes.camera(c).id != camera.id) continue;
      CameraCorrection one{.camera = camera.id,
                           .deviation = found[c].deviation,
                           .moved = found[c].moved,
                           .doubtful = !found[c].moved && found[c].deviation > doubtful,
                           .offset_px = found[c].offset_px,
                           .before_px = before_px[c],
                           .after_px = after_px[c],
                           .uncertainty = certain[c]};
      for (const Capture& capture : *carved)
        one.captures +=
            static_cast<int>(std::count_if(capture.views.begin(), capture.views.end(),
                                           [&](const auto& view) { return view->camera().id == camera.id; }));
      if (found[c].moved) {
        const Eigen::Isometry3d motion = corrected[c] * camera.camera_from_world.inverse();
        one.turned_rad = Eigen::AngleAxisd(motion.linear()).angle();
        one.carried_m = (corrected[c].inverse().translation() - camera.center()).norm();
      }
      correction.cameras.push_back(std::move(one));
      scenes.put(c, corrected[c]);
      break;
    }
  for (RigCamera& camera : correction.rig.cameras)
    for (const CameraCorrection& one : correction.cameras)
      if (one.camera == camera.id && one.moved) camera.uncertainty = one.uncertainty;
  correction.captures = static_cast<int>(carved->size());
  correction.needed = any;
  return correction;
}

}  // namespace booth
