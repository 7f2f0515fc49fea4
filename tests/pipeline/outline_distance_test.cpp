#include "pipeline/geometry/outline_distance.h"

#include <gtest/gtest.h>

#include <cmath>

namespace booth {
namespace {

/// Coverage of a half-plane or disc, from its signed distance: a linear ramp one pixel wide.
template <class Distance>
Image draw(int width, int height, const Distance& distance) {
  Image image(width, height, 1);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      image.at(x, y) = static_cast<uint8_t>(std::lround(255 * std::clamp(0.5 - distance(x, y), 0.0, 1.0)));
  return image;
}

TEST(OutlineDistance, ADiscIsKnownToAFractionOfAPixel) {
  const auto exact = [](double x, double y) { return std::hypot(x - 70.3, y - 58.6) - 31.4; };
  const OutlineDistance outline(draw(150, 117, exact), 0);
  EXPECT_EQ(outline.content(), OutlineDistance::Content::outline);
  for (double y = 0; y <= 116; y += 0.7)
    for (double x = 0; x <= 149; x += 0.7) {
      const double found = outline.at(static_cast<float>(x), static_cast<float>(y));
      const double expected = exact(x, y);
      // Around its middle the distance has a cusp, which samples eight pixels apart cut off.
      const double off = std::abs(expected) < 7 ? 0.15 : expected < -20 ? 6.0 : 1.0;
      ASSERT_NEAR(found, expected, off) << x << ", " << y;
    }
}

TEST(OutlineDistance, ASlantedEdgeIsKnownToATenthOfAPixel) {
  for (const double angle : {0.0, 0.2, 0.6, 0.785, 1.3}) {
    const auto exact = [&](double x, double y) { return (x - 31.7) * std::cos(angle) + (y - 30.2) * std::sin(angle); };
    const OutlineDistance outline(draw(64, 64, exact), 0);
    for (double y = 16; y <= 48; y += 0.9)
      for (double x = 16; x <= 48; x += 0.9)
        ASSERT_NEAR(outline.at(static_cast<float>(x), static_cast<float>(y)), exact(x, y), 0.1) << angle;
  }
}

TEST(OutlineDistance, ChangesByNoMoreThanItsSlope) {
  const auto wavy = [](double x, double y) { return y - 40 - 15 * std::sin(x * 0.15); };
  for (const double feather_px : {0.0, 12.0}) {
    const OutlineDistance outline(draw(120, 90, wavy), feather_px);
    for (float y = 0; y < 88; y += 1.5F)
      for (float x = 0; x < 118; x += 1.5F)
        ASSERT_LE(std::abs(outline.at(x + 1, y) - outline.at(x, y)), outline.slope() * 1.01 + 0.3);
  }
}

TEST(OutlineDistance, AnImageWithoutAnOutlineIsAllOneThing) {
  const OutlineDistance none(Image(40, 30, 1, 0), 4), all(Image(40, 30, 1, 255), 4);
  EXPECT_EQ(none.content(), OutlineDistance::Content::no_subject);
  EXPECT_EQ(all.content(), OutlineDistance::Content::all_subject);
  EXPECT_GT(none.at(20, 15), 30);
  EXPECT_LT(all.at(20, 15), -30);
  EXPECT_EQ(OutlineDistance(Image(1, 1, 1, 255), 0).content(), OutlineDistance::Content::all_subject);
}

TEST(OutlineDistance, FadesTowardsTheCutAndNowhereElse) {
  // A pillar that leaves the image at the bottom: background beside the cut is no longer surely outside.
  const auto pillar = [](double x, double y) { return std::max(std::abs(x - 50) - 10, 30 - y); };
  const Image image = draw(100, 100, pillar);
  const OutlineDistance plain(image, 0), feathered(image, 20);
  EXPECT_NEAR(plain.at(70, 99), 10, 0.5);
  EXPECT_LT(feathered.at(70, 99), 10);
  EXPECT_LT(feathered.at(63, 99), 0);
  EXPECT_NEAR(feathered.at(70, 70), plain.at(70, 70), 1e-4);
  EXPECT_NEAR(feathered.at(10, 99), plain.at(10, 99), 1e-4);
  EXPECT_NEAR(feathered.at(50, 25), plain.at(50, 25), 1e-4);
}

}  // namespace
}  // namespace booth
