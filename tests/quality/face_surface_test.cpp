// The surface of avatars with a scanned face, against recordings whose truth is known, and what becomes of a scan that
// is spoilt. Recordings as in avatar_quality_test.cpp.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <numbers>
#include <optional>

#include "pipeline/face/head.h"
#include "pipeline/face/scan_mesh.h"
#include "pipeline/reconstruct.h"
#include "pipeline/surface/self_intersection.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/face_scan.h"
#include "tests/quality/landmark_model.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

using ::testing::Contains;
using ::testing::HasSubstr;
using ::testing::Not;

/// The normal of what lies under a point: where the ray against `up` meets the mesh first.
std::optional<Eigen::Vector3d> normal_under(const Eigen::Vector3d& p, const Eigen::Vector3d& up, const Mesh& mesh,
                                            const RayCaster& caster) {
  constexpr double above_m = 0.01;
  const auto hit = caster.cast(p + above_m * up, -up);
  if (!hit) return std::nullopt;
  const auto& [a, b, c] = mesh.triangles[hit->triangle];
  return (mesh.positions[b] - mesh.positions[a])
      .cross(mesh.positions[c] - mesh.positions[a])
      .normalized()
      .cast<double>();
}

/// By how much the surface's normal turns across a point, 2.5 mm to each side, the sharper of two directions, degrees.
std::optional<double> turn_at(const Eigen::Vector3d& p, const Eigen::Vector3d& up, const Mesh& mesh,
                              const RayCaster& caster) {
  constexpr double reach_m = 0.0025;
  const Eigen::Vector3d across = up.unitOrthogonal();
  double turn = 0;
  for (const Eigen::Vector3d& way : {across, Eigen::Vector3d(up.cross(across))}) {
    const auto a = normal_under(p + reach_m * way, up, mesh, caster),
               b = normal_under(p - reach_m * way, up, mesh, caster);
    if (!a || !b) return std::nullopt;
    turn = std::max(turn, std::acos(std::clamp(a->dot(*b), -1.0, 1.0)) * 180 / std::numbers::pi);
  }
  return turn;
}

struct Turns {
  double avatar = 0, truth = 0;  ///< 90 % of them are less, degrees
  double where_smooth = 0;       ///< 90 % of the avatar's where the truth turns little are less
  size_t points = 0;
};

/// Where the avatar's surface goes over from the scan to the hull.
Turns turns_beside_scan(const Mesh& avatar, const Mesh& truth, const ScanMesh& scan, const HeadRegion& head) {
  const RayCaster of_avatar(avatar), of_truth(truth), of_scan(scan.mesh);
  const double bridge_m = FaceMergeOptions().bridge * static_cast<double>(head.height());
  constexpr double on_scan_m = 0.0005;
  constexpr size_t samples = 150000;
  constexpr double little_deg = 15;
  std::array<std::vector<double>, 3> turns;
  for (const Eigen::Vector3d& p : sample_surface(avatar, samples)) {
    if (p.y() < static_cast<double>(head.lowest_face_y())) continue;
    const double away_m = of_scan.distance_m(p);
    if (away_m < on_scan_m || away_m > bridge_m) continue;
    const Eigen::Vector3d outwards = (p - head.barycentre.cast<double>()).normalized();
    const auto up = normal_under(p, outwards, avatar, of_avatar);
    if (!up) continue;
    const auto ours = turn_at(p, *up, avatar, of_avatar), true_one = turn_at(p, *up, truth, of_truth);
    if (!ours || !true_one) continue;
    turns[0].push_back(*ours);
    turns[1].push_back(*true_one);
    if (*true_one < little_deg) turns[2].push_back(*ours);
  }
  const auto p90 = [](std::vector<double>& values) {
    if (values.empty()) return 0.0;
    const auto at = values.begin() + static_cast<std::ptrdiff_t>(values.size() * 90 / 100);
    std::nth_element(values.begin(), at, values.end());
    return *at;
  };
  return {p90(turns[0]), p90(turns[1]), p90(turns[2]), turns[0].size()};
}

class FaceSurface : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    const auto folder = find_recording(GetParam());
    if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
    folder_ = *folder;
    face_ = read_face_recording(folder_, pool_.work());
  }
  Result<Reconstruction> made_with(GrayCodeCapture face, FaceSources sources = {}) {
    const Recording recording = read_recording(folder_).value();
    const Work work = pool_.work();
    CaptureFrames capture;
    capture.rig = recording.rig;
    capture.background =
        learn_empty_booth(load_shot(recording, *recording.find(ShotRole::background), work).sets, work).views;
    capture.body = load_shot(recording, *recording.find(ShotRole::body), work).sets.at(0);
    sources.capture = [&] { return Result<FaceCapture>({std::move(face)}); };
    ReconstructionOptions options;
    options.atlas.size = 512;  // the texture is not looked at
    return reconstruct(std::move(capture), options, sources, work);
  }
  /// As if the projector had stood still: every image shows what the first did.
  GrayCodeCapture without_patterns() const {
    GrayCodeCapture still = face_.capture;
    for (FrameSet& set : still.sets)
      for (Frame& frame : set.frames)
        for (const Frame& first : face_.capture.sets.front().frames)
          if (first.camera == frame.camera) frame.pixels = first.pixels;
    return still;
  }
  std::filesystem::path folder_;
  ThreadPool pool_;
  FaceRecording face_;
};

TEST_P(FaceSurface, GoesOverIntoTheHullWithoutACrease) {
  const auto made = made_with(face_.capture);
  ASSERT_TRUE(made.ok()) << made.error().message;
  EXPECT_EQ(made->face, FaceMode::active);
  const Mesh& mesh = made->avatar.mesh;
  EXPECT_TRUE(topology(mesh).closed_manifold());
  EXPECT_TRUE(find_self_intersections(mesh).empty());

  const auto scan = scan_structured_light(face_.rig, face_.capture, {}, face_.region, {}, pool_.work());
  ASSERT_TRUE(scan.ok()) << scan.error().message;
  const auto scan_mesh = mesh_scan(scan->scan, {}, pool_.work());
  ASSERT_TRUE(scan_mesh.ok());
  const Turns turns = turns_beside_scan(mesh, read_ply(folder_ / "truth/mesh.ply"), *scan_mesh, *find_head(mesh));
  RecordProperty("turn_p90_deg", std::to_string(turns.avatar));
  RecordProperty("true_turn_p90_deg", std::to_string(turns.truth));
  RecordProperty("turn_where_smooth_p90_deg", std::to_string(turns.where_smooth));
  EXPECT_GT(turns.points, 1000U);
  EXPECT_LE(turns.avatar, turns.truth + 5);
  EXPECT_LE(turns.where_smooth, 28);
}

TEST_P(FaceSurface, IsTheHullsWhereThePatternsAreSpoilt) {
  const auto made = made_with(without_patterns());
  ASSERT_TRUE(made.ok()) << made.error().message;
  EXPECT_EQ(made->face, FaceMode::none);
  EXPECT_THAT(made->warnings, Contains(HasSubstr("the face is the hull's own: camera face-")));
  EXPECT_TRUE(topology(made->avatar.mesh).closed_manifold());
}

TEST_P(FaceSurface, IsThePassiveOneWhereThePatternsAreSpoiltAndThereIsAModel) {
  auto predictor = read_landmarks();
  if (!predictor) GTEST_SKIP() << "no model of landmarks: " << installed_landmark_model;
  const FaceModel model{std::move(predictor),
                        std::make_shared<const NeutralHead>(*parse_neutral_head(built_in_neutral_head()))};
  int asked = 0;
  const auto made = made_with(without_patterns(), {.model =
                                                       [&] {
                                                         ++asked;
                                                         return Result<FaceModel>(model);
                                                       },
                                                   .detector = {},
                                                   .capture = {}});
  ASSERT_TRUE(made.ok()) << made.error().message;
  EXPECT_EQ(made->face, FaceMode::passive);
  EXPECT_EQ(asked, 1);
  EXPECT_THAT(made->warnings, Contains(HasSubstr("the face was not scanned: camera face-")));
  EXPECT_THAT(made->warnings, Not(Contains(HasSubstr("the hull's own"))));
  const Mesh& mesh = made->avatar.mesh;
  EXPECT_TRUE(topology(mesh).closed_manifold());
  EXPECT_FALSE(made->avatar.morphs.empty());
  // Half of the true face lies within a millimetre, as where no scan was taken at all.
  const RayCaster caster(mesh);
  std::vector<double> distances;
  for (const Eigen::Vector3d& p : face_.truth.points) distances.push_back(caster.distance_m(p));
  ASSERT_FALSE(distances.empty());
  const auto middle = distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2);
  std::nth_element(distances.begin(), middle, distances.end());
  EXPECT_LT(*middle, 0.001);
}

INSTANTIATE_TEST_SUITE_P(Recordings, FaceSurface, testing::Values("man-casual", "woman-casual"), [](const auto& name) {
  return std::string(name.param).substr(0, 3) == "man" ? "man" : "woman";
});

}  // namespace
}  // namespace booth::quality
