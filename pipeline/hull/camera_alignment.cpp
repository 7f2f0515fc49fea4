#include "pipeline/hull/camera_alignment.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <memory>
#include <numeric>
#include <optional>
#include <span>
#include <utility>

#include "pipeline/hull/pose_estimation.h"

namespace booth {
namespace {

/// With fewer cameras the others' hull is too loose to judge one by.
constexpr size_t fewest_judges = 6;
/// Fewer points of an outline say nothing about its camera.
constexpr size_t fewest_samples = 60;
/// How far a camera that was not moved is off, in the noise of its samples: calibration, lens and segmentation.
constexpr double still_px = 0.2;
/// How far one may be off that was: weak enough that the samples decide, strong enough where they cannot.
constexpr double moved_px = 3;
/// Of one that was found to be: nothing of it may be left for the others to explain.
constexpr double surely_moved_px = 10;
/// A camera that deviates by more may have been moved. Measured on people seen by 12 cameras of 1200 × 1600 in a well
/// calibrated rig: unmoved cameras up to 5.4; moved by 5 mm or 0.3° from 5.8 on, most from 7 on.
constexpr double suspicious = 5;
/// A second one by so many times more: where the first was put leaves some doubt.
constexpr double next_suspicious = 1.5;
/// As suspicious as the first is who deviates by that much of its deviation; so many are looked at.
constexpr double alike = 0.7;
constexpr size_t most_suspects = 3;
/// Half of the cameras of a well calibrated rig deviate by less.
constexpr double usual = 2.4;
/// A camera that is put back where it belongs takes most of the misses with it that it is part of. Counted are those
/// beyond the noise; what misses by more than the largest is as bad.
constexpr double settled_share = 0.5;
constexpr double tolerated_px = 0.6;
constexpr double largest_px = 5;
/// In a large rig, who is looked at closely: those whose freedom seems to explain most.
constexpr size_t most_candidates = 16;

double deviation_of(const PoseEstimation& estimation, const PoseSolution& solution, size_t camera) {
  const auto at = static_cast<Eigen::Index>(6 * camera);
  const Eigen::Index size = solution.px.size();
  const double prior_px = still_px * estimation.scale(camera).noise_px;
  const Eigen::MatrixXd columns =
      solution.information.llt().solve(Eigen::MatrixXd::Identity(size, size).middleCols(at, 6));
  Eigen::Matrix<double, 6, 6> covariance = columns.middleRows(at, 6);
  covariance.diagonal().array() += prior_px * prior_px;
  const PoseChange px = solution.px.segment<6>(at);
  return std::sqrt(std::max(0.0, px.dot(covariance.llt().solve(px))));
}

/// The solution that setting one more camera free would about give, from one where it was held.
PoseSolution released(const PoseSolution& held, size_t camera, double from_px, double to_px) {
  PoseSolution solution = held;
  const auto at = static_cast<Eigen::Index>(6 * camera);
  solution.information.diagonal().segment<6>(at).array() += 1 / (to_px * to_px) - 1 / (from_px * from_px);
  solution.px = solution.information.llt().solve(held.information * held.px);
  return solution;
}

double median(std::vector<double> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Sets each camera free that is not yet.
class Search {
 public:
  Search(const PoseEstimation& estimation, const std::vector<bool>& judged, const std::vector<bool>& free,
         const Work& work)
      : estimation_(estimation), judged_(judged), free_(free), work_(work) {}

  /// What a camera does when it alone is free, beside those that were found to have moved.
  struct Finding {
    size_t camera = 0;
    double deviation = 0;
    PoseSolution solution;
  };

  /// Of the cameras that are still held, the one whose freedom explains most first.
  std::vector<Finding> look() const {
    std::vector<Finding> findings;
    for (const size_t camera : choose_candidates()) findings.push_back({.camera = camera, .solution = {}});
    work_.parallel_for(findings.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end && !work_.stopped(); ++i) {
        Finding& finding = findings[i];
        std::vector<double> prior_px = priors();
        prior_px[finding.camera] = suspect_px(finding.camera);
        finding.solution = estimation_.solve(prior_px);
        finding.deviation = deviation_of(estimation_, finding.solution, finding.camera);
      }
    });
    std::stable_sort(findings.begin(), findings.end(),
                     [](const Finding& a, const Finding& b) { return a.deviation > b.deviation; });
    return findings;
  }

  /// The changes of pose of all cameras, as far as each is free.
  std::vector<PoseChange> settle() const {
    const PoseSolution solution = estimation_.solve(priors());
    std::vector<PoseChange> changes;
    for (size_t v = 0; v < free_.size(); ++v) changes.push_back(estimation_.change(solution, v));
    return changes;
  }

 private:
  double held_px(size_t v) const { return still_px * estimation_.scale(v).noise_px; }
  double suspect_px(size_t v) const { return moved_px * std::max(1.0, estimation_.scale(v).noise_px); }
  std::vector<double> priors() const {
    std::vector<double> prior_px(free_.size());
    for (size_t v = 0; v < prior_px.size(); ++v) prior_px[v] = free_[v] ? surely_moved_px : held_px(v);
    return prior_px;
  }

  std::vector<size_t> choose_candidates() const {
    std::vector<size_t> held;
    for (size_t v = 0; v < free_.size(); ++v)
      if (judged_[v] && !free_[v]) held.push_back(v);
    if (held.size() <= most_candidates) return held;
    const PoseSolution wide = estimation_.solve(priors(), false);
    std::vector<double> promise(free_.size());
    work_.parallel_for(held.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i)
        promise[held[i]] =
            deviation_of(estimation_, released(wide, held[i], held_px(held[i]), suspect_px(held[i])), held[i]);
    });
    std::stable_sort(held.begin(), held.end(), [&](size_t a, size_t b) { return promise[a] > promise[b]; });
    held.resize(most_candidates);
    return held;
  }

  const PoseEstimation& estimation_;
  const std::vector<bool>&judged_, &free_;
  const Work& work_;
};

/// By how much a pose's change moves the outline of each camera, root of the mean square, pixels.
double outline_offset(std::span<const CoherenceSample> samples, size_t view, const PoseChange& change) {
  double squares = 0, count = 0;
  for (const CoherenceSample& sample : samples) {
    if (sample.slopes[0].view != view) continue;
    squares += std::pow(sample.slopes[0].px.dot(change), 2);
    count += 1;
  }
  return count > 0 ? std::sqrt(squares / count) : 0;
}

/// What a look at all cameras found: those that are still held, the most suspicious first.
struct Look {
  struct Camera {
    size_t view = 0;
    double deviation = 0, offset_px = 0;
    PoseChange change;
  };
  std::vector<Camera> cameras;
  std::vector<PoseChange> left;  ///< by view: what those still ask for that were put back
  std::vector<double> misses;    ///< by view: of the samples that it is part of, how far they miss

  double all_misses() const { return std::accumulate(misses.begin(), misses.end(), 0.0); }

  /// How far all of them deviate, compared to those of a well calibrated rig; at least 1.
  double unrest() const {
    std::vector<double> deviations;
    for (const Camera& camera : cameras) deviations.push_back(camera.deviation);
    return std::max(1.0, median(std::move(deviations)) / usual);
  }
};

/// One camera put where it asks to be, and what all look like then.
struct Trial {
  Look::Camera suspect;
  Look look;
};

/// @param free  cameras that were found to have moved
Look look_at(const AlignmentScenes& scenes, const std::vector<bool>& free, const Work& work) {
  const std::vector<CoherenceSample> samples = scenes.sample(work);
  if (work.stopped() || samples.empty()) return {};
  std::vector<size_t> counts(scenes.cameras());
  for (const CoherenceSample& sample : samples) ++counts[sample.slopes[0].view];
  std::vector<bool> judged(scenes.cameras());
  for (size_t v = 0; v < judged.size(); ++v) judged[v] = counts[v] >= fewest_samples;
  const PoseEstimation estimation(samples, scenes.scales(samples));
  Look look;
  look.misses.resize(scenes.cameras());
  for (const CoherenceSample& sample : samples)
    for (const CoherenceSample::Slope& slope : sample.slopes)
      if (!slope.px.isZero())
        look.misses[slope.view] += std::clamp(sample.miss_px / sample.noise_px - tolerated_px, 0.0, largest_px);
  const Search search(estimation, judged, free, work);
  if (std::any_of(free.begin(), free.end(), [](bool one) { return one; })) look.left = search.settle();
  for (const Search::Finding& finding : search.look()) {
    const PoseChange change = estimation.change(finding.solution, finding.camera);
    look.cameras.push_back(
        {finding.camera, finding.deviation, outline_offset(samples, finding.camera, change), change});
  }
  if (work.stopped()) return {};
  return look;
}

}  // namespace

AlignmentScenes::AlignmentScenes(Rig& rig, std::span<const AlignmentScene> scenes) {
  for (const AlignmentScene& scene : scenes) {
    if (scene.views->size() < fewest_judges) continue;
    scenes_.push_back(scene);
    for (const auto& view : *scene.views) {
      const auto known = std::find_if(cameras_.begin(), cameras_.end(),
                                      [&](const RigCamera* camera) { return camera->id == view->camera().id; });
      cameras_of_views_.emplace_back(static_cast<size_t>(known - cameras_.begin()));
      if (known != cameras_.end()) continue;
      cameras_.push_back(&*std::find_if(rig.cameras.begin(), rig.cameras.end(),
                                        [&](const RigCamera& camera) { return camera.id == view->camera().id; }));
    }
  }
}

void AlignmentScenes::put(size_t camera, const Eigen::Isometry3d& camera_from_world) {
  cameras_[camera]->camera_from_world = camera_from_world;
  size_t n = 0;
  for (const AlignmentScene& scene : scenes_)
    for (auto& view : *scene.views)
      if (cameras_of_views_[n++] == camera)
        view = std::make_unique<SilhouetteView>(*cameras_[camera], view->coverage());
}

std::vector<CoherenceSample> AlignmentScenes::sample(const Work& work) const {
  std::vector<CoherenceSample> all;
  size_t first = 0;
  for (const AlignmentScene& scene : scenes_) {
    for (CoherenceSample sample : sample_coherence(*scene.views, *scene.hull, work)) {
      for (CoherenceSample::Slope& slope : sample.slopes) slope.view = cameras_of_views_[first + slope.view];
      all.push_back(sample);
    }
    first += scene.views->size();
  }
  return all;
}

std::vector<PoseScale> AlignmentScenes::scales(std::span<const CoherenceSample> samples) const {
  Eigen::Vector3d center = Eigen::Vector3d::Zero();
  for (const AlignmentScene& scene : scenes_) {
    const Grid& grid = scene.hull->grid();
    center += (grid.origin + grid.point(grid.size[0] - 1, grid.size[1] - 1, grid.size[2] - 1)) / 2;
  }
  center /= static_cast<double>(scenes_.size());
  return pose_scales(std::vector<const CalibratedView*>(cameras_.begin(), cameras_.end()), center, samples);
}

std::vector<CameraDeviation> realign_cameras(AlignmentScenes& scenes, const Work& work) {
  std::vector<CameraDeviation> found(scenes.cameras());
  std::vector<bool> free(scenes.cameras());
  const auto note = [&](const Look& look) {
    for (const Look::Camera& camera : look.cameras)
      found[camera.view] = {.offset_px = camera.offset_px, .deviation = camera.deviation};
  };
  Look look = look_at(scenes, free, work);
  note(look);
  double least = suspicious;
  for (size_t moved = 0; moved < scenes.cameras() / 3; ++moved) {
    if (look.cameras.empty() || look.cameras.front().deviation <= least) break;
    // Cameras that face each other see the same outline, so that either may seem to have moved: each of those that are
    // about as suspicious is put back where it would belong, and the one without which the others agree best it was.
    std::vector<Look::Camera> suspects = look.cameras;
    const double enough = std::max(least, alike * suspects.front().deviation);
    std::erase_if(suspects, [&](const Look::Camera& camera) { return camera.deviation < enough; });
    if (suspects.size() > most_suspects) suspects.resize(most_suspects);
    std::optional<Trial> best;
    for (const Look::Camera& suspect : suspects) {
      const Eigen::Isometry3d as_calibrated = scenes.camera(suspect.view).camera_from_world;
      // From where it belongs, all others are measured anew: what it stirred up in them is not theirs.
      scenes.put(suspect.view, changed_pose(as_calibrated, suspect.change));
      free[suspect.view] = true;
      Trial trial{suspect, look_at(scenes, free, work)};
      scenes.put(suspect.view, as_calibrated);
      free[suspect.view] = false;
      if (trial.look.cameras.empty()) return found;
      if (!best || trial.look.all_misses() < best->look.all_misses()) best = std::move(trial);
    }
    const Look::Camera& suspect = best->suspect;
    if (suspect.deviation <= least * best->look.unrest() ||
        best->look.misses[suspect.view] > settled_share * look.misses[suspect.view])
      break;
    scenes.put(suspect.view, changed_pose(scenes.camera(suspect.view).camera_from_world, suspect.change));
    free[suspect.view] = true;
    found[suspect.view] = {.offset_px = suspect.offset_px, .deviation = suspect.deviation, .moved = true};
    look = std::move(best->look);
    for (size_t v = 0; v < free.size(); ++v)
      if (free[v]) scenes.put(v, changed_pose(scenes.camera(v).camera_from_world, look.left[v]));
    note(look);
    least = suspicious * next_suspicious;
  }
  return found;
}

std::vector<CameraDeviation> realign_cameras(Rig& rig, SilhouetteViews& views, const Field& hull, const Work& work) {
  const AlignmentScene scene{&views, &hull};
  AlignmentScenes scenes(rig, std::span(&scene, 1));
  if (scenes.cameras() == 0) return std::vector<CameraDeviation>(views.size());
  return realign_cameras(scenes, work);
}

}  // namespace booth
