#include "pipeline/face/patch_matching.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <functional>

#include "pipeline/face/face_evidence.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

using Texture = std::function<double(double x_m, double y_m)>;  ///< grey levels on the plane z = 0

double rough(double x, double y) {
  return 128 + 50 * std::sin(310 * x + 1) * std::cos(270 * y) + 40 * std::sin(170 * x - 230 * y);
}

/// A picture of the plane z = 0 from half a metre before it, `azimuth_rad` aside.
PinholePicture photograph(double azimuth_rad, const Texture& texture) {
  PinholePicture picture;
  Intrinsics& k = picture.view.intrinsics;
  k = {.width = 200, .height = 200, .fx = 600, .fy = 600, .cx = 99.5, .cy = 99.5};
  const Eigen::Vector3d center(0.5 * std::sin(azimuth_rad), 0, 0.5 * std::cos(azimuth_rad));
  const Eigen::Vector3d forward = -center.normalized(), right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
  Eigen::Matrix3d rows;
  rows << right.transpose(), forward.cross(right).transpose(), forward.transpose();
  picture.view.camera_from_world.linear() = rows;
  picture.view.camera_from_world.translation() = -rows * center;
  picture.grey = Image(k.width, k.height, 1);
  for (int y = 0; y < k.height; ++y)
    for (int x = 0; x < k.width; ++x) {
      const Eigen::Vector3d ray = world_ray(picture.view, {x, y});
      const Eigen::Vector3d hit = center - center.z() / ray.z() * ray;
      picture.grey.at(x, y) = static_cast<uint8_t>(std::lround(texture(hit.x(), hit.y())));
    }
  return picture;
}

TEST(PatchMatching, FindsHowFarTheSurfaceIs) {
  const PinholePicture front = photograph(0, rough), left = photograph(-0.4, rough), right = photograph(0.4, rough);
  const std::vector<const PinholePicture*> others{&left, &right};
  for (const double before_m : {-0.006, 0.0, 0.004}) {
    const auto match = match_patch(front, others, {0, 0, before_m}, Eigen::Vector3d::UnitZ());
    ASSERT_TRUE(match) << before_m;
    EXPECT_NEAR(match->depth_m, before_m, 3e-4);
    EXPECT_GT(match->correlation, 0.95);
    EXPECT_GT(match->sigma_m, 0);
  }
}

TEST(PatchMatching, SaysNothingWithoutContrastOrWithRepetition) {
  const auto plain = [](double, double) { return 128.0; };
  const auto stripes = [](double x, double) { return 128 + 60 * std::sin(2 * 3.14159265 * x / 0.003); };
  for (const Texture& texture : {Texture(plain), Texture(stripes)}) {
    const PinholePicture front = photograph(0, texture), left = photograph(-0.4, texture);
    const std::vector<const PinholePicture*> others{&left};
    EXPECT_FALSE(match_patch(front, others, {0, 0, 0.001}, Eigen::Vector3d::UnitZ()));
  }
}

TEST(PatchMatching, PicturesAgreeOnTheTrueSurfaceAlone) {
  const PinholePicture front = photograph(0, rough), left = photograph(-0.4, rough);
  const std::vector<const PinholePicture*> others{&left};
  const auto on = patch_correlation(front, others, {0, 0, 0}, Eigen::Vector3d::UnitZ());
  const auto before = patch_correlation(front, others, {0, 0, 0.01}, Eigen::Vector3d::UnitZ());
  ASSERT_TRUE(on && before);
  EXPECT_GT(*on, 0.98);
  EXPECT_LT(*before, 0.7);
  EXPECT_FALSE(patch_correlation(front, others, {0, 0, 0}, -Eigen::Vector3d::UnitZ())) << "turned away";
}

TEST(FaceEvidence, ObjectsToAFaceThatIsWorseThanTheHulls) {
  EXPECT_FALSE((FaceEvidence{.compared = 200, .of_hull = 0.6, .of_fitted = 0.7, .outside_outline = 0.02}.objection()));
  EXPECT_TRUE((FaceEvidence{.compared = 200, .of_hull = 0.7, .of_fitted = 0.6, .outside_outline = 0.02}.objection()));
  EXPECT_TRUE((FaceEvidence{.compared = 200, .of_hull = 0.6, .of_fitted = 0.7, .outside_outline = 0.3}.objection()));
  EXPECT_FALSE((FaceEvidence{.compared = 5, .of_hull = 0.7, .of_fitted = 0.2, .outside_outline = 0}.objection()))
      << "too few places to tell";
}

}  // namespace
}  // namespace booth
