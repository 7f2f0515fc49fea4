// A ball with a pattern on it, photographed by pinholes: how far a surface beside it is off is known.

#include "pipeline/face/surface_matching.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "pipeline/thread_pool.h"

namespace booth {
namespace {

constexpr double radius_m = 0.1;
const Eigen::Vector3d middle(0.1, 1.6, 0.05);

/// A ball about the middle, by latitude and longitude.
Mesh ball(double radius) {
  constexpr int rings = 60, sectors = 90;
  constexpr double pi = 3.14159265358979;
  Mesh mesh;
  for (int i = 0; i <= rings; ++i)
    for (int k = 0; k < sectors; ++k) {
      // Poles are cut off, so that no triangle is degenerate.
      const double polar = 0.02 + (pi - 0.04) * i / rings, around = 2 * pi * k / sectors;
      const Eigen::Vector3d way(std::sin(polar) * std::sin(around), std::cos(polar),
                                std::sin(polar) * std::cos(around));
      mesh.positions.push_back((middle + radius * way).cast<float>());
    }
  const auto at = [](int i, int k) { return static_cast<uint32_t>(i * sectors + k % sectors); };
  for (int i = 0; i < rings; ++i)
    for (int k = 0; k < sectors; ++k) {
      mesh.triangles.push_back({at(i, k), at(i + 1, k), at(i + 1, k + 1)});
      mesh.triangles.push_back({at(i, k), at(i + 1, k + 1), at(i, k + 1)});
    }
  return mesh;
}

double pattern(const Eigen::Vector3d& p) {
  constexpr double wave = 260;
  return std::sin(wave * p.x() + 2 * std::sin(150 * p.y())) + std::sin(0.8 * wave * p.y() + std::sin(200 * p.z()));
}

enum class Skin { patterned, plain, highlights };

/// The ball as a camera at an angle about the vertical sees it.
FacePicture photograph(double angle, Skin skin) {
  constexpr int side = 240;
  const Eigen::Vector3d eye = middle + 1.5 * Eigen::Vector3d(std::sin(angle), 0.1, std::cos(angle));
  FacePicture picture{{{}, Image(side, side, 1)}, FloatImage(side, side, 1)};
  CalibratedView& view = picture.pinhole.view;
  const Eigen::Vector3d forward = (middle - eye).normalized();
  const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
  Eigen::Matrix3d rows;
  rows << right.transpose(), forward.cross(right).transpose(), forward.transpose();
  view.camera_from_world.linear() = rows;
  view.camera_from_world.translation() = -rows * eye;
  view.intrinsics.width = view.intrinsics.height = side;
  view.intrinsics.fx = view.intrinsics.fy = side * 1.5 / 0.25;
  view.intrinsics.cx = view.intrinsics.cy = (side - 1) / 2.0;
  for (int y = 0; y < side; ++y)
    for (int x = 0; x < side; ++x) {
      const Eigen::Vector3d way = (rows.transpose() * Eigen::Vector3d((x - view.intrinsics.cx) / view.intrinsics.fx,
                                                                      (y - view.intrinsics.cy) / view.intrinsics.fy, 1))
                                      .normalized();
      const double along = (middle - eye).dot(way);
      const double beside = (middle - eye).squaredNorm() - along * along;
      if (beside >= radius_m * radius_m) continue;
      const Eigen::Vector3d p = eye + (along - std::sqrt(radius_m * radius_m - beside)) * way;
      const double colour = skin == Skin::plain ? 0 : pattern(p - middle);
      // A highlight stands where it is in the picture, whatever the skin there.
      const double glint = skin == Skin::highlights ? 60 * std::sin(0.35 * x) * std::sin(0.31 * y) : 0;
      const double grey = 128 + (skin == Skin::highlights ? 5 : 25) * colour + glint;
      picture.pinhole.grey.at(x, y) = static_cast<uint8_t>(std::lround(std::clamp(grey, 0.0, 255.0)));
      picture.matte.at(x, y) = static_cast<float>(0.15 + 0.03 * colour);
    }
  return picture;
}

std::vector<FacePicture> photographs(Skin skin) {
  std::vector<FacePicture> pictures;
  for (const double angle : {-0.6, 0.0, 0.5}) pictures.push_back(photograph(angle, skin));
  return pictures;
}

Eigen::Isometry3d frame() {
  Eigen::Isometry3d world_from_head = Eigen::Isometry3d::Identity();
  world_from_head.translation() = middle;
  return world_from_head;
}

double median_along_m(std::vector<SurfaceMatch> matches) {
  const auto half = matches.begin() + static_cast<std::ptrdiff_t>(matches.size() / 2);
  std::nth_element(matches.begin(), half, matches.end(),
                   [](const SurfaceMatch& a, const SurfaceMatch& b) { return a.along_m < b.along_m; });
  return half->along_m;
}

TEST(SurfaceMatching, FindsHowFarASurfaceIsOff) {
  const auto pictures = photographs(Skin::patterned);
  for (const double off_m : {-0.003, -0.0007, 0.0, 0.002}) {
    const auto matches = match_surface(pictures, ball(radius_m + off_m), frame());
    ASSERT_GT(matches.size(), 100U) << off_m;
    EXPECT_NEAR(median_along_m(matches), -off_m, 0.00015) << off_m;
    const auto wrong = std::count_if(matches.begin(), matches.end(), [&](const SurfaceMatch& match) {
      return std::abs(match.along_m + off_m) > std::max(3 * match.sigma_m, 0.0005);
    });
    EXPECT_LT(static_cast<double>(wrong), 0.05 * static_cast<double>(matches.size())) << off_m;
  }
}

TEST(SurfaceMatching, HighlightsThatWanderWithTheEyeDoLittle) {
  const auto matches =
      match_surface(photographs(Skin::highlights), ball(radius_m + 0.002), frame(), {.least_correlation = 0.3});
  ASSERT_GT(matches.size(), 50U);
  EXPECT_NEAR(median_along_m(matches), -0.002, 0.0004);
}

TEST(SurfaceMatching, SaysNothingWithoutPatternOrWithASinglePicture) {
  EXPECT_TRUE(match_surface(photographs(Skin::plain), ball(radius_m), frame()).empty());
  EXPECT_TRUE(match_surface(std::vector{photograph(0, Skin::patterned)}, ball(radius_m), frame()).empty());
  EXPECT_TRUE(match_surface({}, ball(radius_m), frame()).empty());
  EXPECT_TRUE(match_surface(photographs(Skin::patterned), Mesh(), frame()).empty());
}

TEST(SurfaceMatching, DoesNotDependOnThreads) {
  const auto pictures = photographs(Skin::patterned);
  const Mesh surface = ball(radius_m + 0.001);
  ThreadPool pool(4);
  const auto serial = match_surface(pictures, surface, frame());
  const auto parallel = match_surface(pictures, surface, frame(), {}, pool.work());
  ASSERT_EQ(serial.size(), parallel.size());
  for (size_t i = 0; i < serial.size(); ++i) {
    EXPECT_EQ(serial[i].along_m, parallel[i].along_m);
    EXPECT_EQ(serial[i].sigma_m, parallel[i].sigma_m);
  }
}

}  // namespace
}  // namespace booth
