#include "pipeline/export/portrait.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "pipeline/thread_pool.h"
#include "tests/synthetic/avatar.h"

namespace booth {
namespace {

const PortraitOptions small{.width = 192, .height = 256};

struct Extent {
  int left, right, top, bottom;
};

/// Where pixels are covered.
Extent covered(const Image& image) {
  Extent extent{image.width, -1, image.height, -1};
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x)
      if (image.at(x, y, 3) > 0)
        extent = {std::min(extent.left, x), std::max(extent.right, x), std::min(extent.top, y),
                  std::max(extent.bottom, y)};
  return extent;
}

/// A square one metre wide, facing +Z, showing `texture` upright.
Avatar poster(Image texture) {
  Avatar avatar;
  avatar.mesh.positions = {{-0.5F, 0, 0}, {0.5F, 0, 0}, {0.5F, 1, 0}, {-0.5F, 1, 0}};
  avatar.mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
  const Eigen::Vector2f a(0, 1), b(1, 1), c(1, 0), d(0, 0);
  avatar.atlas = {std::move(texture), {{a, b, c}, {a, c, d}}};
  return avatar;
}

TEST(Portrait, ShowsTheWholeAvatarInsideTheMargins) {
  for (const double azimuth : {0.0, 0.35, 2.0, -1.3})
    for (const synthetic::PersonOptions& who :
         {synthetic::PersonOptions{}, {.height_m = 0.9}, {.height_m = 2.1, .arm_angle_rad = 1.5}}) {
      PortraitOptions options = small;
      options.azimuth_rad = azimuth;
      const Extent extent = covered(render_portrait(synthetic::make_avatar(synthetic::person(who)), options));
      EXPECT_GE(extent.left, 0.035 * small.width);
      EXPECT_LE(extent.right, 0.965 * small.width);
      EXPECT_GE(extent.top, 0.035 * small.height);
      EXPECT_LE(extent.bottom, 0.965 * small.height);
      const bool fills =
          extent.bottom - extent.top > 0.8 * small.height || extent.right - extent.left > 0.8 * small.width;
      EXPECT_TRUE(fills);
    }
}

TEST(Portrait, IsTheSameWithAnyNumberOfThreads) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const Image alone = render_portrait(avatar, small);
  ThreadPool pool(4);
  EXPECT_EQ(render_portrait(avatar, small, pool.work()).samples, alone.samples);
}

TEST(Portrait, ShowsTheTextureTheRightWayRound) {
  Image quarters(64, 64, 3);
  constexpr std::array<std::array<uint8_t, 3>, 4> colours{
      {{200, 30, 30}, {30, 200, 30}, {30, 30, 200}, {200, 200, 30}}};
  for (int y = 0; y < 64; ++y)
    for (int x = 0; x < 64; ++x)
      std::copy_n(colours[static_cast<size_t>(y / 32 * 2 + x / 32)].begin(), 3, quarters.pixel(x, y));
  PortraitOptions options = small;
  options.azimuth_rad = options.elevation_rad = 0;
  const Image image = render_portrait(poster(quarters), options);
  for (const int row : {0, 1})
    for (const int column : {0, 1}) {
      const uint8_t* pixel =
          image.pixel(image.width / 2 + (column == 0 ? -40 : 40), image.height / 2 + (row == 0 ? -40 : 40));
      const auto& expected = colours[static_cast<size_t>(row * 2 + column)];
      EXPECT_EQ(pixel[3], 255);
      for (size_t c = 0; c < 3; ++c) EXPECT_NEAR(pixel[c], expected[c], 0.1 * expected[c] + 3) << row << column << c;
    }
}

TEST(Portrait, LightKeepsTheBrightnessOfWhatFacesTheViewer) {
  const Image image = render_portrait(poster(Image(8, 8, 3, 150)), {.width = 64, .height = 64, .azimuth_rad = 0});
  EXPECT_NEAR(image.at(32, 32, 0), 150, 6);
}

TEST(Portrait, ShadesConcavePlacesDarker) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  std::fill(avatar.atlas.image.samples.begin(), avatar.atlas.image.samples.end(), uint8_t{180});
  const Image image = render_portrait(avatar, small);
  int darkest = 255, brightest = 0;
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x)
      if (image.at(x, y, 3) == 255) {
        darkest = std::min<int>(darkest, image.at(x, y, 1));
        brightest = std::max<int>(brightest, image.at(x, y, 1));
      }
  EXPECT_GT(darkest, 90) << "no more than a tint";
  EXPECT_LT(darkest, 160);
  EXPECT_GT(brightest, 175);
  EXPECT_LT(brightest, 205);
}

TEST(Portrait, EdgesAreSmoothAndKeepTheirColour) {
  const Image image = render_portrait(poster(Image(8, 8, 3, 150)), small);
  int between = 0;
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      const uint8_t* pixel = image.pixel(x, y);
      if (pixel[3] == 0) {
        EXPECT_EQ(pixel[0] + pixel[1] + pixel[2], 0);
      } else {
        EXPECT_NEAR(pixel[0], 150, 15) << "not premultiplied";
      }
      between += pixel[3] > 0 && pixel[3] < 255;
    }
  EXPECT_GT(between, small.height / 2);
}

TEST(Portrait, TheNearerSurfaceHidesTheOther) {
  Avatar avatar = poster(Image(8, 8, 3, 150));
  const Avatar front = avatar;
  for (Eigen::Vector3f p : front.mesh.positions) avatar.mesh.positions.push_back(p - Eigen::Vector3f(0, 0, 0.5F));
  avatar.mesh.triangles.push_back({4, 5, 6});
  avatar.mesh.triangles.push_back({4, 6, 7});
  avatar.atlas.image = Image(16, 8, 3, 40);
  for (int y = 0; y < 8; ++y)
    for (int x = 0; x < 8; ++x) std::fill_n(avatar.atlas.image.pixel(x, y), 3, uint8_t{200});
  for (auto& corners : avatar.atlas.uv) corners.fill({0.25F, 0.5F});
  avatar.atlas.uv.resize(4, {Eigen::Vector2f(0.75F, 0.5F), {0.75F, 0.5F}, {0.75F, 0.5F}});
  PortraitOptions options = small;
  options.azimuth_rad = 0;
  const Image image = render_portrait(avatar, options);
  EXPECT_GT(image.at(image.width / 2, image.height / 2), 150);
  std::reverse(avatar.mesh.triangles.begin(), avatar.mesh.triangles.end());
  std::reverse(avatar.atlas.uv.begin(), avatar.atlas.uv.end());
  EXPECT_EQ(render_portrait(avatar, options).samples, image.samples) << "whatever the order of the triangles";
}

TEST(Portrait, OfNothingIsTransparent) {
  const Image image = render_portrait({}, small);
  EXPECT_EQ(image.channels, 4);
  EXPECT_TRUE(std::all_of(image.samples.begin(), image.samples.end(), [](uint8_t s) { return s == 0; }));
}

TEST(Portrait, SurvivesAMeshWithoutExtent) {
  Avatar avatar = poster(Image(1, 1, 3, 150));
  for (Eigen::Vector3f& p : avatar.mesh.positions) p.setZero();
  EXPECT_EQ(render_portrait(avatar, small).channels, 4);
}

TEST(Turntable, GoesRoundInPlace) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const TurntableOptions options{.width = 120, .height = 160, .frames = 8};
  const std::vector<Image> frames = render_turntable(avatar, options);
  ASSERT_EQ(frames.size(), 8U);
  const Extent front = covered(frames[0]), side = covered(frames[2]), back = covered(frames[4]);
  for (const Image& frame : frames) {
    const Extent extent = covered(frame);
    EXPECT_GE(extent.left, 0.03 * options.width);
    EXPECT_LE(extent.right, 0.97 * options.width);
    EXPECT_GE(extent.top, 0.03 * options.height);
    EXPECT_LE(extent.bottom, 0.97 * options.height);
    EXPECT_NEAR(extent.top, front.top, 4);
    EXPECT_NEAR(extent.bottom, front.bottom, 4);
  }
  // The person is wider than deep, and as wide from behind.
  EXPECT_LT(side.right - side.left, 0.7 * (front.right - front.left));
  EXPECT_NEAR(back.right - back.left, front.right - front.left, 3);
}

TEST(Turntable, IsTheSameWithAnyNumberOfThreads) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const TurntableOptions options{.width = 60, .height = 80, .frames = 3};
  ThreadPool pool(4);
  const auto alone = render_turntable(avatar, options), together = render_turntable(avatar, options, pool.work());
  ASSERT_EQ(alone.size(), together.size());
  for (size_t i = 0; i < alone.size(); ++i) EXPECT_EQ(alone[i].samples, together[i].samples);
}

TEST(Turntable, OfNothingIsEmpty) {
  const auto frames = render_turntable({}, {.width = 8, .height = 6, .frames = 2});
  ASSERT_EQ(frames.size(), 2U);
  EXPECT_EQ(frames[1].samples, Image(8, 6, 4).samples);
}

}  // namespace
}  // namespace booth
