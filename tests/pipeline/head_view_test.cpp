#include "pipeline/face/head_view.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>

namespace booth {
namespace {

/// Mounted on its side, two metres before the origin, with a lens that bends lines.
CalibratedView turned_camera() {
  CalibratedView camera;
  camera.id = "side";
  camera.intrinsics = {.width = 900, .height = 700, .fx = 1400, .fy = 1390, .cx = 440, .cy = 360};
  camera.intrinsics.distortion = {-0.2, 0.08, 0.001, -0.0015, 0};
  Eigen::Matrix3d rows;
  rows << 0, -1, 0, -1, 0, 0, 0, 0, -1;  // looks along -Z, its x axis down
  camera.camera_from_world.linear() = rows;
  camera.camera_from_world.translation() = -rows * Eigen::Vector3d(0.1, 0.2, 2);
  return camera;
}

Image ramps(int width, int height) {
  Image picture(width, height, 3);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c) picture.pixel(x, y)[c] = static_cast<uint8_t>(std::lround(20 + x / 6.0 + y / 9.0));
  return picture;
}

TEST(HeadView, ShowsWhatTheCameraSeesThere) {
  const CalibratedView camera = turned_camera();
  const Image picture = ramps(camera.intrinsics.width, camera.intrinsics.height);
  for (const int pixels : {90, 301}) {  // coarser and finer than the picture
    const auto view = upright_view(camera, {0, 0, 0}, 0.3, pixels);
    ASSERT_TRUE(view);
    const Image seen = render_view(camera, picture, *view);
    for (int y = 0; y < pixels; y += 7)
      for (int x = 0; x < pixels; x += 7) {
        const auto at = pixel_in_camera(camera, *view, {x, y});
        ASSERT_TRUE(at);
        const double expected = 20 + at->x() / 6 + at->y() / 9;
        EXPECT_NEAR(seen.at(x, y), expected, 1.1) << x << ' ' << y;  // both are rounded
      }
  }
}

TEST(HeadView, IsUprightAndBlackWhereThePictureEnds) {
  const CalibratedView camera = turned_camera();
  const Image picture(camera.intrinsics.width, camera.intrinsics.height, 1, 100);
  const Eigen::Vector3d mark(0, 0.1, 0);  // above the middle
  const auto view = upright_view(camera, {0, 0, 0}, 3, 200);
  ASSERT_TRUE(view);
  const Image seen = render_view(camera, picture, *view);
  int black = 0;
  for (int y = 0; y < 200; ++y)
    for (int x = 0; x < 200; ++x) {
      const auto at = pixel_in_camera(camera, *view, {x, y});
      constexpr double near_border = 12;  // the view's pixels are so large there
      const auto beyond = [&](double margin) {
        return !at || at->x() < -margin || at->y() < -margin || at->x() > camera.intrinsics.width + margin ||
               at->y() > camera.intrinsics.height + margin;
      };
      if (beyond(near_border)) {
        EXPECT_EQ(seen.at(x, y), 0) << x << ' ' << y;
        ++black;
      } else if (!beyond(-near_border)) {
        EXPECT_EQ(seen.at(x, y), 100) << x << ' ' << y;
      }
    }
  EXPECT_GT(black, 1000);
  EXPECT_LT((view->camera_from_world * mark).y(), (view->camera_from_world * Eigen::Vector3d(0, 0, 0)).y());
}

}  // namespace
}  // namespace booth
