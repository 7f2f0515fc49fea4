// Landmarks of the small recording's face, found by dlib's model, and what is said when they cannot be.

#include "pipeline/face/control_points.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <filesystem>
#include <memory>
#include <tuple>

#include "pipeline/face/landmark_predictor.h"
#include "pipeline/geometry/camera_model.h"
#include "replay/recording.h"
#include "tests/quality/landmark_model.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

using ::testing::HasSubstr;

/// The head of the small recording's hull.
HeadRegion head() { return {.barycentre = {0.004F, 1.614F, 0.062F}, .neck_y = 1.513F, .crown_y = 1.714F}; }

class ControlPoints : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    predictor_ = read_landmarks();
    folder_ = *find_recording("mini");
    const auto recording = read_recording(folder_);
    rig_ = recording->rig;
    frames_ = load_shot(*recording, *recording->find(ShotRole::body), {}).sets.front().frames;
  }
  static void TearDownTestSuite() { predictor_.reset(); }
  void SetUp() override {
    if (predictor_ == nullptr) GTEST_SKIP() << "no model of landmarks: " << installed_landmark_model;
  }

  static std::vector<Frame> frames_of(const std::vector<std::string>& cameras) {
    std::vector<Frame> chosen;
    for (const Frame& frame : frames_)
      if (std::find(cameras.begin(), cameras.end(), frame.camera) != cameras.end()) chosen.push_back(frame);
    return chosen;
  }

  static double median_distance_m(const FaceControlPoints& found) {
    const RayCaster truth(read_ply(folder_ / "truth/mesh.ply"));
    std::vector<double> distances;
    for (const auto& point : found.points)
      if (point && !point->contour) distances.push_back(truth.distance_m(point->position));
    EXPECT_GE(distances.size(), 40U);
    std::nth_element(distances.begin(), distances.begin() + static_cast<long>(distances.size() / 2), distances.end());
    return distances[distances.size() / 2];
  }

  inline static std::shared_ptr<const LandmarkPredictor> predictor_;
  inline static std::filesystem::path folder_;
  inline static Rig rig_;
  inline static std::vector<Frame> frames_;
};

TEST_F(ControlPoints, LieOnTheTrueFace) {
  const auto found = find_control_points(rig_, frames_, head(), *predictor_);
  ASSERT_TRUE(found) << found.error().message;
  EXPECT_LT(median_distance_m(*found), 0.003);
  EXPECT_GE(found->observations.size(), 3U);
  EXPECT_GT(found->frame.forward.z(), 0.95);
  EXPECT_NEAR(found->frame.eye_distance_m, 0.062, 0.006);
}

/// A camera and its picture as they would be, were it mounted a quarter turn further.
std::pair<RigCamera, Frame> turned(const RigCamera& camera, const Frame& frame) {
  RigCamera other = camera;
  const Intrinsics& k = camera.intrinsics;
  const auto& d = k.distortion;
  other.intrinsics = {.width = k.height,
                      .height = k.width,
                      .fx = k.fy,
                      .fy = k.fx,
                      .cx = k.height - 1 - k.cy,
                      .cy = k.cx,
                      .skew = 0,
                      .distortion = {d[0], d[1], d[3], -d[2], d[4]}};
  Eigen::Isometry3d quarter = Eigen::Isometry3d::Identity();
  quarter.linear() << 0, -1, 0, 1, 0, 0, 0, 0, 1;
  other.camera_from_world = quarter * camera.camera_from_world;
  other.mount_rotation_deg = (camera.mount_rotation_deg + 270) % 360;
  const Image& picture = *frame.pixels;
  auto image = std::make_shared<Image>(picture.height, picture.width, picture.channels);
  for (int y = 0; y < picture.height; ++y)
    for (int x = 0; x < picture.width; ++x)
      std::copy_n(picture.pixel(x, y), picture.channels, image->pixel(picture.height - 1 - y, x));
  Frame moved = frame;
  moved.pixels = image;
  return {other, moved};
}

TEST_F(ControlPoints, DoNotDependOnHowCamerasAreMounted) {
  const auto upright = find_control_points(rig_, frames_, head(), *predictor_);
  ASSERT_TRUE(upright) << upright.error().message;
  Rig rig = rig_;
  std::vector<Frame> frames = frames_;
  for (size_t i = 0; i < frames.size(); ++i)
    for (RigCamera& camera : rig.cameras)
      if (camera.id == frames[i].camera)
        for (size_t quarters = 0; quarters < i % 4; ++quarters) std::tie(camera, frames[i]) = turned(camera, frames[i]);
  const auto found = find_control_points(rig, frames, head(), *predictor_);
  ASSERT_TRUE(found) << found.error().message;
  ASSERT_EQ(found->observations.size(), upright->observations.size());
  EXPECT_LT((found->frame.middle - upright->frame.middle).norm(), 5e-4);
  for (size_t l = 17; l < face_landmarks; ++l)
    if (found->points[l] && upright->points[l]) {
      EXPECT_LT((found->points[l]->position - upright->points[l]->position).norm(), 0.004) << l;
    }
}

TEST_F(ControlPoints, SayWhenTheFaceIsCovered) {
  std::vector<Frame> covered = frames_;
  for (Frame& frame : covered) {
    auto image = std::make_shared<Image>(*frame.pixels);
    const auto at = project(*rig_.find(frame.camera), head().barycentre.cast<double>());
    if (!at) continue;
    constexpr int reach = 45;
    for (int y = static_cast<int>(at->y()) - reach; y < static_cast<int>(at->y()) + reach; ++y)
      for (int x = static_cast<int>(at->x()) - reach; x < static_cast<int>(at->x()) + reach; ++x)
        if (image->contains(x, y)) std::fill_n(image->pixel(x, y), image->channels, uint8_t{90});
    frame.pixels = image;
  }
  const auto found = find_control_points(rig_, covered, head(), *predictor_);
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, ErrorCode::no_subject);
  EXPECT_THAT(found.error().message, HasSubstr("turned away or covered"));
}

TEST_F(ControlPoints, SayWhenOneCameraAloneShowsTheFace) {
  const auto found =
      find_control_points(rig_, frames_of({"body-00", "body-03", "body-04", "body-05"}), head(), *predictor_);
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, ErrorCode::too_few_views);
  EXPECT_THAT(found.error().message, HasSubstr("body-00"));
}

TEST_F(ControlPoints, SayWhenNoCameraSeesTheFaceFromTheFront) {
  const auto found = find_control_points(rig_, frames_of({"body-03", "body-04", "body-05"}), head(), *predictor_);
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, ErrorCode::no_subject);
  EXPECT_FALSE(find_control_points(rig_, {}, head(), *predictor_));
}

TEST(DlibLandmarks, RefuseWhatIsNoModel) {
  const std::vector<uint8_t> nonsense{'n', 'o', ' ', 'm', 'o', 'd', 'e', 'l'};
  EXPECT_EQ(read_dlib_landmarks({}).error().code, ErrorCode::invalid_file);
  EXPECT_EQ(read_dlib_landmarks(nonsense).error().code, ErrorCode::invalid_file);
}

}  // namespace
}  // namespace booth::quality
