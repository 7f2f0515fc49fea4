// The face by landmarks, outlines and pictures in whole reconstructions, against the truth and against the hull's own.
// The small recording of the repository always runs; larger ones are looked for in the folder that BOOTH_RECORDINGS
// names.

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <functional>
#include <memory>
#include <utility>

#include "pipeline/face/landmark_predictor.h"
#include "pipeline/geometry/camera_model.h"
#include "pipeline/reconstruct.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/face_truth.h"
#include "tests/quality/landmark_model.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

namespace fs = std::filesystem;
using ::testing::Contains;
using ::testing::HasSubstr;

/// True points of the face: what the face cameras see, or of the true mesh where the recording has no such points.
std::vector<Eigen::Vector3d> face_points(const fs::path& recording) {
  if (fs::exists(recording / "truth/face")) return read_face_truth(recording).points;
  const Mesh mesh = read_ply(recording / "truth/mesh.ply");
  const Eigen::Vector3d head = read_joints(recording / "truth/joints.json").at("head");
  double crown = head.y();
  for (const Eigen::Vector3f& p : mesh.positions)
    if (std::abs(static_cast<double>(p.x()) - head.x()) < 0.1) crown = std::max(crown, static_cast<double>(p.y()));
  std::vector<Eigen::Vector3d> points;
  for (const Eigen::Vector3d& p : sample_surface(mesh, 100000))
    if (p.z() > head.z() + 0.02 && std::abs(p.x() - head.x()) < 0.09 && p.y() > head.y() - 0.08 && p.y() < crown - 0.04)
      points.push_back(p);
  return points;
}

struct FaceError {
  double median_m = 0, p95_m = 0;
};

FaceError face_error(const std::vector<Eigen::Vector3d>& points, const Mesh& avatar) {
  const RayCaster caster(avatar);
  std::vector<double> distances;
  for (const Eigen::Vector3d& p : points) distances.push_back(caster.distance_m(p));
  std::sort(distances.begin(), distances.end());
  return {distances[distances.size() / 2], distances[distances.size() * 19 / 20]};
}

class PassiveFace : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    model_ = {read_landmarks(), std::make_shared<const NeutralHead>(*parse_neutral_head(built_in_neutral_head()))};
  }
  static void TearDownTestSuite() { model_ = {}; }
  void SetUp() override {
    if (!model_.landmarks) GTEST_SKIP() << "no model of landmarks: " << installed_landmark_model;
  }

  /// @param change  what happens to the capture before
  static Result<Reconstruction> reconstruct_face(const fs::path& folder, FaceMode face,
                                                 const std::function<void(CaptureFrames&)>& change = {}) {
    ThreadPool pool;
    const Work work = pool.work();
    const Recording recording = read_recording(folder).value();
    CaptureFrames capture;
    capture.rig = recording.rig;
    capture.background =
        learn_empty_booth(load_shot(recording, *recording.find(ShotRole::background), work).sets, work).views;
    capture.body = load_shot(recording, *recording.find(ShotRole::body), work).sets.at(0);
    if (change) change(capture);
    ReconstructionOptions options;
    options.face = face;
    return reconstruct(std::move(capture), options, {[] { return Result<FaceModel>(model_); }, {}, {}}, work);
  }

  inline static FaceModel model_;
};

struct Bounds {
  const char* recording;
  FaceError worst;
  double of_hulls_median, of_hulls_p95;  ///< the most the face's errors may be, as a share of the hull's
};

class PassiveFaceOf : public PassiveFace, public testing::WithParamInterface<Bounds> {};

TEST_P(PassiveFaceOf, IsNearTheTruthAndBetterThanTheHulls) {
  const auto folder = find_recording(GetParam().recording);
  if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
  const auto hull = reconstruct_face(*folder, FaceMode::none), made = reconstruct_face(*folder, FaceMode::passive);
  ASSERT_TRUE(hull) << hull.error().message;
  ASSERT_TRUE(made) << made.error().message;
  EXPECT_EQ(made->face, FaceMode::passive);
  EXPECT_FALSE(made->avatar.morphs.empty());
  EXPECT_TRUE(topology(made->avatar.mesh).closed_manifold());
  const std::vector<Eigen::Vector3d> points = face_points(*folder);
  ASSERT_GT(points.size(), 1000U);
  const FaceError of_hull = face_error(points, hull->avatar.mesh), fitted = face_error(points, made->avatar.mesh);
  RecordProperty("median_m", std::to_string(fitted.median_m));
  RecordProperty("p95_m", std::to_string(fitted.p95_m));
  EXPECT_LT(fitted.median_m, GetParam().worst.median_m);
  EXPECT_LT(fitted.p95_m, GetParam().worst.p95_m);
  EXPECT_LT(fitted.median_m, GetParam().of_hulls_median * of_hull.median_m) << of_hull.median_m;
  EXPECT_LT(fitted.p95_m, GetParam().of_hulls_p95 * of_hull.p95_m) << of_hull.p95_m;
}

// A pixel of the small recording is 4 mm on the face.
INSTANTIATE_TEST_SUITE_P(Recordings, PassiveFaceOf,
                         testing::Values(Bounds{"mini", {0.0020, 0.0095}, 0.85, 0.9},
                                         Bounds{"man-casual", {0.001, 0.0055}, 0.85, 0.75},
                                         Bounds{"woman-casual", {0.001, 0.0045}, 0.75, 0.6}),
                         [](const auto& name) {
                           std::string plain = name.param.recording;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

/// A whole avatar, but for the face, and why in one warning.
void expect_hulls_own(const Result<Reconstruction>& made, const std::string& reason) {
  ASSERT_TRUE(made) << made.error().message;
  EXPECT_EQ(made->face, FaceMode::none);
  EXPECT_THAT(made->warnings, Contains(HasSubstr("the face is the hull's own: " + reason)));
  EXPECT_TRUE(made->avatar.morphs.empty());
  EXPECT_TRUE(topology(made->avatar.mesh).closed_manifold());
  EXPECT_FALSE(made->avatar.skeleton.joints.empty());
}

void leave_out(CaptureFrames& capture, const std::vector<std::string>& cameras) {
  std::erase_if(capture.body.frames, [&](const Frame& frame) {
    return std::find(cameras.begin(), cameras.end(), frame.camera) != cameras.end();
  });
}

/// Paints a mask of checked cloth over the small recording's face, where a camera sees it, but for one camera.
void mask_face(CaptureFrames& capture, const std::string& but_for) {
  const Eigen::Vector3d face =
      read_joints(*find_recording("mini") / "truth/joints.json").at("head") + Eigen::Vector3d(0, 0.01, 0.09);
  for (Frame& frame : capture.body.frames) {
    const RigCamera& camera = *capture.rig.find(frame.camera);
    const auto at = project(camera, face);
    if (!at || frame.camera == but_for) continue;
    auto masked = std::make_shared<Image>(*frame.pixels);
    constexpr double radius_m = 0.1;
    constexpr int check_px = 5;
    const double reach = radius_m * camera.intrinsics.fx / (camera.center() - face).norm();
    for (int y = 0; y < masked->height; ++y)
      for (int x = 0; x < masked->width; ++x)
        if ((Eigen::Vector2d(x, y) - *at).norm() < reach)
          std::fill_n(masked->pixel(x, y), masked->channels,
                      static_cast<uint8_t>((x / check_px + y / check_px) % 2 == 0 ? 70 : 110));
    frame.pixels = masked;
  }
}

TEST_F(PassiveFace, IsTheHullsWhereOneCameraAloneIsInFrontOfIt) {
  expect_hulls_own(reconstruct_face(*find_recording("mini"), FaceMode::passive,
                                    [](CaptureFrames& capture) {
                                      leave_out(capture, {"body-01", "body-07"});
                                    }),
                   "only one camera shows the face");
}

TEST_F(PassiveFace, IsTheHullsWhereItIsCovered) {
  expect_hulls_own(reconstruct_face(*find_recording("mini"), FaceMode::passive,
                                    [](CaptureFrames& capture) { mask_face(capture, "none"); }),
                   "no camera shows a face: it is turned away or covered");
}

TEST_F(PassiveFace, IsTheHullsWhereItIsCoveredInAllCamerasButOne) {
  expect_hulls_own(reconstruct_face(*find_recording("mini"), FaceMode::passive,
                                    [](CaptureFrames& capture) { mask_face(capture, "body-00"); }),
                   "only one camera shows the face: body-00");
}

TEST_F(PassiveFace, IsTheHullsWhereTheSubjectTurnsTheBackOnTheBooth) {
  const auto turn = [](CaptureFrames& capture) {
    const Eigen::Isometry3d about(Eigen::AngleAxisd(3.14159265358979, Eigen::Vector3d::UnitY()));
    for (RigCamera& camera : capture.rig.cameras) camera.camera_from_world = camera.camera_from_world * about;
  };
  expect_hulls_own(reconstruct_face(*find_recording("mini"), FaceMode::passive, turn), "");
}

}  // namespace
}  // namespace booth::quality
