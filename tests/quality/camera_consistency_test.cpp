// What one camera's fault does to the surface: a limb missing from its mask, its calibration off by three pixels, the
// camera itself missing. Recordings as in avatar_quality_test.cpp; two cameras of each are tried, or all of them when
// BOOTH_EVERY_CAMERA is set.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <iostream>
#include <map>
#include <memory>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/hull/visual_hull.h"
#include "pipeline/refine/shape_refinement.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/quality/measures.h"
#include "tests/quality/recorded_capture.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

/// How much the surface error may grow by one camera's fault.
constexpr double most_growth = 1.2;
/// What takes a forearm from a mask in profile takes of chest and belly too, and eight small pictures miss that more.
constexpr double most_growth_without_a_forearm = 1.3;
constexpr size_t samples = 20000;

struct Errors {
  double made_to_truth_m = 0, seen_truth_to_made_m = 0;
};

class CameraConsistency : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    const auto folder = find_recording(GetParam());
    if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
    RecordedCapture capture = load_capture(*folder, work_);
    rig_ = std::move(capture.rig);
    silhouettes_ = std::move(capture.silhouettes);
    frames_ = std::move(capture.frames);
    joints_ = read_joints(*folder / "truth/joints.json");
    const Mesh truth = read_ply(*folder / "truth/mesh.ply");
    truth_ = std::make_unique<RayCaster>(truth);
    seen_truth_ = seen_points(sample_surface(truth, samples), *truth_, rig_);
    unharmed_ = errors_of(carve(rig_, silhouettes_));
  }

  VisualHull carve(const Rig& rig, const std::vector<Silhouette>& silhouettes) const {
    auto hull = carve_visual_hull(rig, silhouettes, {}, work_);
    EXPECT_TRUE(hull.ok()) << hull.error().message;
    return std::move(*hull);
  }

  Errors errors_of(const VisualHull& hull) const {
    const Mesh mesh = extract_surface(refine_shape(hull.field, hull.views, frames_, {}, work_), work_);
    const RayCaster made(mesh);
    return {mean_distance_m(sample_surface(mesh, samples), *truth_), mean_distance_m(seen_truth_, made)};
  }

  /// Body cameras to try: two, far apart, or all.
  std::vector<size_t> cameras() const {
    std::vector<size_t> all;
    for (size_t i = 0; i < silhouettes_.size(); ++i)
      if (rig_.find(silhouettes_[i].camera)->role == CameraRole::body) all.push_back(i);
    if (std::getenv("BOOTH_EVERY_CAMERA") != nullptr) return all;
    return {all[1], all[all.size() / 2 + 2]};
  }

  /// Whether the surface stays as good; tells the factors by which the errors grew.
  void expect_as_good(const std::string& fault, size_t camera, const VisualHull& hull, bool to_be_named) const {
    const Errors errors = errors_of(hull);
    const double made = errors.made_to_truth_m / unharmed_.made_to_truth_m;
    const double seen = errors.seen_truth_to_made_m / unharmed_.seen_truth_to_made_m;
    const std::string& id = silhouettes_[camera].camera;
    std::cout << GetParam() << " " << id << " " << fault << ": avatar to truth × " << made
              << ", seen truth to avatar × " << seen << "\n";
    const double most = fault == "without a forearm" ? most_growth_without_a_forearm : most_growth;
    EXPECT_LE(made, most) << id;
    EXPECT_LE(seen, most) << id;
    const auto names = [&](const std::string& warning) { return warning.find(id) != std::string::npos; };
    const bool named = std::any_of(hull.warnings.begin(), hull.warnings.end(), names);
    EXPECT_TRUE(named || !to_be_named) << id << ": " << testing::PrintToString(hull.warnings);
    EXPECT_TRUE(std::all_of(hull.warnings.begin(), hull.warnings.end(), names))
        << id << ": " << testing::PrintToString(hull.warnings);
  }

  /// A silhouette without what lies within radius_m of the line between two points.
  Silhouette without_limb(const Silhouette& whole, const Eigen::Vector3d& from, const Eigen::Vector3d& to,
                          double radius_m) const {
    const RigCamera& camera = *rig_.find(whole.camera);
    const Eigen::Vector2d a = project(camera, from).value(), b = project(camera, to).value();
    const double depth_m = (camera.camera_from_world * from).z();
    const double radius_px = radius_m * camera.intrinsics.fx / depth_m;
    Silhouette cut = whole;
    for (int y = 0; y < cut.coverage.height; ++y)
      for (int x = 0; x < cut.coverage.width; ++x) {
        const Eigen::Vector2d p(x, y);
        const double along = std::clamp((p - a).dot(b - a) / (b - a).squaredNorm(), 0.0, 1.0);
        if ((p - a - along * (b - a)).norm() < radius_px) cut.coverage.at(x, y) = 0;
      }
    return cut;
  }

  ThreadPool pool_;
  Work work_ = pool_.work();
  Rig rig_;
  std::vector<Silhouette> silhouettes_;
  std::vector<Frame> frames_;
  std::map<std::string, Eigen::Vector3d> joints_;
  std::unique_ptr<RayCaster> truth_;
  std::vector<Eigen::Vector3d> seen_truth_;
  Errors unharmed_;
};

TEST_P(CameraConsistency, NoFaultGivesNoWarning) {
  EXPECT_THAT(carve(rig_, silhouettes_).warnings, testing::IsEmpty());
}

TEST_P(CameraConsistency, OneMaskWithoutAForearmIsRepaired) {
  const Eigen::Vector3d elbow = joints_.at("lowerarm01.L"), wrist = joints_.at("wrist.L");
  for (const size_t camera : cameras()) {
    std::vector<Silhouette> silhouettes = silhouettes_;
    silhouettes[camera] = without_limb(silhouettes_[camera], elbow, wrist + 0.8 * (wrist - elbow), 0.07);
    expect_as_good("without a forearm", camera, carve(rig_, silhouettes), true);
  }
}

TEST_P(CameraConsistency, OneMaskWithoutALowerLegIsRepaired) {
  const Eigen::Vector3d knee = joints_.at("lowerleg01.R"), ankle = joints_.at("foot.R");
  for (const size_t camera : cameras()) {
    std::vector<Silhouette> silhouettes = silhouettes_;
    silhouettes[camera] = without_limb(silhouettes_[camera], knee, ankle + 0.3 * (ankle - knee), 0.10);
    expect_as_good("without a lower leg", camera, carve(rig_, silhouettes), true);
  }
}

TEST_P(CameraConsistency, OneCameraThatWasTurnedIsRealigned) {
  for (const size_t camera : cameras()) {
    for (const double direction : {0.0, 2.2}) {
      constexpr double off_px = 3;
      Rig rig = rig_;
      const auto turned = std::find_if(rig.cameras.begin(), rig.cameras.end(),
                                       [&](const RigCamera& c) { return c.id == silhouettes_[camera].camera; });
      turned->intrinsics.cx += off_px * std::cos(direction);
      turned->intrinsics.cy += off_px * std::sin(direction);
      expect_as_good("3 px off", camera, carve(rig, silhouettes_), true);
    }
  }
}

TEST_P(CameraConsistency, OneCameraMayBeMissing) {
  for (const size_t camera : cameras()) {
    std::vector<Silhouette> silhouettes = silhouettes_;
    silhouettes.erase(silhouettes.begin() + static_cast<long>(camera));
    expect_as_good("missing", camera, carve(rig_, silhouettes), false);
  }
}

INSTANTIATE_TEST_SUITE_P(Recordings, CameraConsistency, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
