#include "pipeline/health/background_registration.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <random>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/segmentation/segmentation.h"

namespace booth {
namespace {

/// A far wall of blotches and lines, as seen in a direction: 0 … 1.
double wall(const Eigen::Vector3d& direction) {
  const double x = direction.x() / direction.z(), y = direction.y() / direction.z();
  double value = 0.5 + 0.1 * std::sin(31 * x + 3 * std::sin(17 * y)) + 0.1 * std::sin(43 * y + 2 * std::cos(23 * x));
  constexpr double half_width = 0.004;  // a pixel and a half: soft, as any lens leaves it
  for (const double off : {std::remainder(x, 0.31), std::remainder(y, 0.27)})
    value -= 0.25 * std::exp(-std::pow(off / half_width, 2));
  return value;
}

Intrinsics lens() {
  return {
      .width = 400, .height = 300, .fx = 380, .fy = 380, .cx = 203, .cy = 148, .distortion = {-0.05, 0.01, 0, 0, 0}};
}

/// What a camera that was turned and carried forwards (growth) sees of the wall, with noise.
Frame picture(const Eigen::Vector3d& rotation_rad, double growth, uint32_t seed, double light = 1) {
  const Intrinsics k = lens();
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, 1.5);
  const double angle = rotation_rad.norm();
  const Eigen::Matrix3d turn =
      angle > 0 ? Eigen::AngleAxisd(angle, rotation_rad / angle).toRotationMatrix() : Eigen::Matrix3d::Identity();
  Image image(k.width, k.height, 3);
  for (int y = 0; y < k.height; ++y)
    for (int x = 0; x < k.width; ++x) {
      Eigen::Vector3d ray = unproject(k, {x, y});
      ray.head<2>() /= 1 + growth;
      const double value = 255 * std::pow(light, 1 / 2.4) * wall(turn.transpose() * ray);
      for (int c = 0; c < 3; ++c)
        image.at(x, y, c) = static_cast<uint8_t>(std::lround(std::clamp(value + noise(random), 0.0, 255.0)));
    }
  return {.camera = "a", .pixels = std::make_shared<const Image>(std::move(image))};
}

const Image& empty_booth() {
  static const Image mean = learn_empty_view(std::vector<Frame>{picture(Eigen::Vector3d::Zero(), 0, 1),
                                                                picture(Eigen::Vector3d::Zero(), 0, 2)})
                                .value()
                                .mean;
  return mean;
}

TEST(BackgroundRegistration, FindsATurnToAFewHundredthsOfAPixel) {
  for (const Eigen::Vector3d& turn :
       {Eigen::Vector3d(0.001, 0, 0), Eigen::Vector3d(0, -0.0006, 0), Eigen::Vector3d(0.0005, 0.01, -0.004)}) {
    const auto found = register_background(empty_booth(), picture(turn, 0, 3), {}, lens());
    ASSERT_TRUE(found);
    // A turn is taken to be small: of four pixels a hundredth may be missing.
    EXPECT_LT((found->rotation_rad - turn).norm() * lens().fx, 0.02 + 0.01 * turn.norm() * lens().fx);
    EXPECT_NEAR(found->growth, 0, 1e-4);
    EXPECT_TRUE(found->moved);
    EXPECT_LT(found->sigma_px, 0.1);
  }
}

TEST(BackgroundRegistration, FindsACameraThatWasCarriedForwards) {
  const auto found = register_background(empty_booth(), picture(Eigen::Vector3d::Zero(), 0.003, 3), {}, lens());
  ASSERT_TRUE(found);
  EXPECT_NEAR(found->growth, 0.003, 1e-4);
  EXPECT_TRUE(found->moved);
}

TEST(BackgroundRegistration, ACameraThatNobodyTouchedStandsStillInAnyLight) {
  for (const double light : {1.0, 0.6, 1.3}) {
    const auto found = register_background(empty_booth(), picture(Eigen::Vector3d::Zero(), 0, 4, light), {}, lens());
    ASSERT_TRUE(found);
    EXPECT_FALSE(found->moved) << light;
    EXPECT_GT(found->deviation, 0);
    EXPECT_LT(found->shift_px, 0.05) << light;
  }
}

/// A dark column with its shadow, a third of the picture, and one that was moved in the background.
TEST(BackgroundRegistration, WhoStandsBeforeTheBackgroundHasNoSay) {
  const Eigen::Vector3d turn(0.0015, 0.001, 0);
  for (const bool turned : {false, true}) {
    Frame frame = picture(turned ? turn : Eigen::Vector3d::Zero(), 0, 5);
    Image image = *frame.pixels;
    Image subject(image.width, image.height, 1);
    for (int y = 40; y < image.height; ++y)
      for (int x = 0; x < image.width; ++x) {
        const bool inside = std::abs(x - 200) < 60;
        if (inside) subject.at(x, y) = 255;
        const double shade = 1 - 0.3 * std::exp(-std::pow((x - 285) / 25.0, 2));
        const bool chair = x > 330 && x < 350 && y > 150 && y < 220;
        for (int c = 0; c < 3; ++c) {
          uint8_t& value = image.at(x, y, c);
          value = inside  ? static_cast<uint8_t>(30 + (x * 7 + y * 3) % 60)
                  : chair ? uint8_t{60}
                          : static_cast<uint8_t>(std::lround(shade * value));
        }
      }
    frame.pixels = std::make_shared<const Image>(std::move(image));
    const auto found = register_background(empty_booth(), frame, subject, lens());
    ASSERT_TRUE(found);
    EXPECT_EQ(found->moved, turned);
    EXPECT_LT((found->rotation_rad - (turned ? turn : Eigen::Vector3d::Zero())).norm() * lens().fx, 0.1);
  }
}

TEST(BackgroundRegistration, ABlankWallTellsNothing) {
  Frame blank = picture(Eigen::Vector3d::Zero(), 0, 6);
  blank.pixels = std::make_shared<const Image>(lens().width, lens().height, 3, uint8_t{180});
  const auto found = register_background(*blank.pixels, blank, {}, lens());
  ASSERT_TRUE(found);
  EXPECT_FALSE(found->moved);
  // Nor one of which everything is hidden.
  const auto hidden =
      register_background(empty_booth(), blank, Image(lens().width, lens().height, 1, uint8_t{255}), lens());
  ASSERT_TRUE(hidden);
  EXPECT_FALSE(hidden->moved);
  EXPECT_EQ(hidden->deviation, 0);
}

TEST(BackgroundRegistration, RefusesPicturesThatDoNotBelongTogether) {
  const Frame frame = picture(Eigen::Vector3d::Zero(), 0, 7);
  EXPECT_FALSE(register_background(Image(), frame, {}, lens()));
  Frame small = frame;
  small.pixels = std::make_shared<const Image>(100, 100, 3);
  EXPECT_FALSE(register_background(empty_booth(), small, {}, lens()));
  EXPECT_FALSE(register_background(empty_booth(), frame, Image(10, 10, 1), lens()));
  Intrinsics other = lens();
  other.width = 401;
  EXPECT_FALSE(register_background(empty_booth(), frame, {}, other));
  // Small ones that do belong together tell nothing, and harm nothing.
  Intrinsics tiny = lens();
  for (const int size : {1, 2, 5, 9}) {
    tiny.width = tiny.height = size;
    small.pixels = std::make_shared<const Image>(size, size, 3);
    const auto found = register_background(*small.pixels, small, {}, tiny);
    ASSERT_TRUE(found) << size;
    EXPECT_FALSE(found->moved);
  }
}

}  // namespace
}  // namespace booth
