#include "pipeline/geometry/camera_model.h"

#include <gtest/gtest.h>

#include <cmath>
#include <opencv2/calib3d.hpp>
#include <random>

#include "tests/synthetic/scene.h"

namespace booth {
namespace {

Intrinsics wide_lens() {
  return {.width = 1200,
          .height = 1600,
          .fx = 1100,
          .fy = 1110,
          .cx = 610,
          .cy = 790,
          .skew = 0.7,
          .distortion = {-0.18, 0.05, 0.0007, -0.0011, -0.006}};
}

/// Lenses from none to strong distortion, barrel and pincushion.
std::vector<Intrinsics> lenses() {
  std::vector<Intrinsics> all{wide_lens(), wide_lens(), wide_lens(), wide_lens()};
  all[1].distortion = {0, 0, 0, 0, 0};
  all[2].distortion = {0.12, -0.03, -0.002, 0.001, 0.004};
  all[3].distortion = {-0.28, 0.09, 0, 0, -0.01};
  return all;
}

/// Calls `visit` on a grid of pixels, corners of the image included.
template <class Visit>
void over_image(const Intrinsics& k, const Visit& visit) {
  constexpr int steps = 20;
  for (int j = 0; j <= steps; ++j)
    for (int i = 0; i <= steps; ++i)
      visit(Eigen::Vector2d(-0.5 + k.width * static_cast<double>(i) / steps,
                            -0.5 + k.height * static_cast<double>(j) / steps));
}

TEST(CameraModel, ProjectsWhatItUnprojectedBackToThePixel) {
  for (const Intrinsics& k : lenses())
    over_image(k, [&](const Eigen::Vector2d& pixel) {
      const Eigen::Vector3d direction = unproject(k, pixel);
      EXPECT_EQ(direction.z(), 1);
      const auto projected = project_camera_point(k, 2.5 * direction);
      ASSERT_TRUE(projected) << pixel.transpose();
      EXPECT_LT((*projected - pixel).norm(), 1e-6) << pixel.transpose();
    });
}

TEST(CameraModel, AgreesWithOpenCv) {
  std::mt19937 random(3);
  std::uniform_real_distribution<double> lateral(-0.5, 0.5), depth(0.3, 5);
  for (Intrinsics k : lenses()) {
    k.skew = 0;  // OpenCV has none
    const cv::Matx33d matrix(k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1);
    const std::vector<double> distortion(k.distortion.begin(), k.distortion.end());
    for (int i = 0; i < 200; ++i) {
      const double z = depth(random);
      const Eigen::Vector3d p(lateral(random) * z, lateral(random) * z, z);
      std::vector<cv::Point2d> expected;
      cv::projectPoints(std::vector<cv::Point3d>{{p.x(), p.y(), p.z()}}, cv::Vec3d(), cv::Vec3d(), matrix, distortion,
                        expected);
      const auto projected = project_camera_point(k, p);
      ASSERT_TRUE(projected);
      EXPECT_NEAR(projected->x(), expected[0].x, 1e-9);
      EXPECT_NEAR(projected->y(), expected[0].y, 1e-9);
    }
  }
}

TEST(CameraModel, SkewMovesColumnsWithRows) {
  Intrinsics k{.width = 100, .height = 100, .fx = 50, .fy = 60, .cx = 49, .cy = 51, .skew = 5, .distortion = {}};
  const auto projected = project_camera_point(k, {0.2, 0.5, 1});
  ASSERT_TRUE(projected);
  EXPECT_NEAR(projected->x(), 50 * 0.2 + 5 * 0.5 + 49, 1e-12);
  EXPECT_NEAR(projected->y(), 60 * 0.5 + 51, 1e-12);
}

TEST(CameraModel, SeesNothingAtOrBehindTheCamera) {
  const Intrinsics k = wide_lens();
  for (const double z : {-1.0, -1e-9, 0.0, 1e-3}) EXPECT_FALSE(project_camera_point(k, {0, 0, z})) << z;
  EXPECT_TRUE(project_camera_point(k, {0, 0, 2e-3}));
  EXPECT_FALSE(project_camera_point(k, {0, 0, std::nan("")}));
}

TEST(CameraModel, RefusesPointsThatAFoldedDistortionWouldBringBack) {
  Intrinsics k = wide_lens();
  k.distortion = {-0.3, 0, 0, 0, 0};  // r (1 − 0.3 r²) grows until r = 1.054
  EXPECT_TRUE(project_camera_point(k, {1.05, 0, 1}));
  EXPECT_FALSE(project_camera_point(k, {1.06, 0, 1}));
  // By the polynomial alone this point, 61° off the axis, would lie in the middle of the image.
  EXPECT_FALSE(project_camera_point(k, {1.8, 0, 1}));
  EXPECT_FALSE(project_camera_point(k, {30, 0, 1}));
}

TEST(CameraModel, RefusesPointsBehindAFoldThatUnfoldsAgain) {
  Intrinsics k = wide_lens();
  k.distortion = {-0.4, 0.05, 0, 0, 0};  // the radius falls from r = 1.035 to 1.93 and grows again
  EXPECT_TRUE(project_camera_point(k, {1.03, 0, 1}));
  EXPECT_FALSE(project_camera_point(k, {1.5, 0, 1}));
  EXPECT_FALSE(project_camera_point(k, {2, 0, 1})) << "at radius 0.4 by the polynomial";
  k.distortion = {-0.4, 0, 0, 0, 0.02};
  EXPECT_FALSE(project_camera_point(k, {1.8, 0, 1}));
  k.distortion = {0.1, -0.4, 0, 0, 0.1};  // grows, falls, grows
  EXPECT_TRUE(project_camera_point(k, {0.8, 0, 1}));
  EXPECT_FALSE(project_camera_point(k, {1.6, 0, 1}));
}

TEST(CameraModel, AcceptsExactlyTheRadiiBelowTheFirstFold) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> coefficient(-0.5, 0.5);
  for (int lens = 0; lens < 200; ++lens) {
    Intrinsics k = wide_lens();
    k.distortion = {coefficient(random), coefficient(random), 0, 0, coefficient(random)};
    bool folded = false;
    for (double r = 0.0005; r < 3; r += 0.001) {
      const double s = r * r;
      const double slope = 1 + s * (3 * k.distortion[0] + s * (5 * k.distortion[1] + s * 7 * k.distortion[4]));
      folded = folded || slope <= 0;
      if (std::abs(slope) < 1e-2) continue;  // too near to the fold for the steps of this test
      ASSERT_EQ(project_camera_point(k, {r, 0, 1}).has_value(), !folded)
          << k.distortion[0] << ' ' << k.distortion[1] << ' ' << k.distortion[4] << " at " << r;
    }
  }
}

TEST(CameraModel, UnprojectsPixelsBeyondTheFoldToSomethingFinite) {
  Intrinsics k = wide_lens();
  k.distortion = {-0.3, 0, 0, 0, 0};
  for (const double x : {1300.0, 2000.0, 1e5, -1e5}) EXPECT_TRUE(unproject(k, {x, 800}).allFinite()) << x;
}

TEST(CameraModel, WorldRaysMeetTheirPixelAndTheCamerasCenter) {
  for (const RigCamera& camera : synthetic::ring_rig().cameras)
    over_image(camera.intrinsics, [&](const Eigen::Vector2d& pixel) {
      const Eigen::Vector3d ray = world_ray(camera, pixel);
      EXPECT_NEAR(ray.norm(), 1, 1e-12);
      const auto projected = project(camera, camera.center() + 1.7 * ray);
      ASSERT_TRUE(projected);
      EXPECT_LT((*projected - pixel).norm(), 1e-6);
    });
}

}  // namespace
}  // namespace booth
