#include "pipeline/image/develop.h"

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <opencv2/imgproc.hpp>
#include <random>

namespace booth {
namespace {

constexpr int width = 64, height = 48;

/// The colours of a 2 × 2 cell, spelt out: "rggb" has red at the top left.
int channel_of(std::string_view pattern, int x, int y) {
  switch (pattern[static_cast<size_t>(2 * (y % 2) + x % 2)]) {
    case 'r': return 0;
    case 'g': return 1;
    default: return 2;
  }
}

Image mosaic_of(const Image& image, std::string_view pattern) {
  Image raw(image.width, image.height, 1);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) raw.at(x, y) = image.at(x, y, channel_of(pattern, x, y));
  return raw;
}

/// Colours that differ and change slowly, so that interpolation has a right answer.
Image smooth_scene() {
  Image scene(width, height, 3);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      scene.at(x, y, 0) = static_cast<uint8_t>(200 - x);
      scene.at(x, y, 1) = static_cast<uint8_t>(60 + x + y);
      scene.at(x, y, 2) = static_cast<uint8_t>(30 + y);
    }
  return scene;
}

class Develop : public testing::TestWithParam<std::pair<BayerPattern, std::string_view>> {
 protected:
  Mosaic as_srgb() const { return {GetParam().first, false}; }
  Mosaic as_linear() const { return {GetParam().first, true}; }
};

TEST_P(Develop, FindsTheColoursOfASmoothScene) {
  const Image scene = smooth_scene();
  const auto image = develop(mosaic_of(scene, GetParam().second), as_srgb());
  ASSERT_TRUE(image) << image.error().message;
  ASSERT_EQ(image->channels, 3);
  ASSERT_EQ(image->samples.size(), scene.samples.size());
  constexpr int mirrored = 2;  // pixels at the edges have no neighbours beyond
  for (int y = mirrored; y < height - mirrored; ++y)
    for (int x = mirrored; x < width - mirrored; ++x)
      for (int c = 0; c < 3; ++c) ASSERT_NEAR(image->at(x, y, c), scene.at(x, y, c), 1) << x << " " << y << " " << c;
}

TEST_P(Develop, KeepsEverySampleThatWasMeasured) {
  Image raw(width, height, 1);
  std::mt19937 random(7);
  for (uint8_t& sample : raw.samples) sample = static_cast<uint8_t>(random());
  const auto image = develop(raw, as_srgb());
  ASSERT_TRUE(image);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) ASSERT_EQ(image->at(x, y, channel_of(GetParam().second, x, y)), raw.at(x, y));
}

TEST_P(Develop, UniformColourStaysUniformToTheEdges) {
  Image scene(width, height, 3);
  for (size_t i = 0; i < scene.samples.size(); ++i) scene.samples[i] = std::array<uint8_t, 3>{180, 90, 40}[i % 3];
  const auto image = develop(mosaic_of(scene, GetParam().second), as_srgb());
  ASSERT_TRUE(image);
  EXPECT_EQ(image->samples, scene.samples);
}

TEST_P(Develop, EncodesLinearLightAsSrgb) {
  for (const auto& [light, srgb] : std::map<int, int>{{0, 0}, {1, 13}, {55, 128}, {128, 188}, {255, 255}}) {
    const auto image = develop(Image(width, height, 1, static_cast<uint8_t>(light)), as_linear());
    ASSERT_TRUE(image);
    for (const uint8_t sample : image->samples) ASSERT_EQ(sample, srgb) << light;
  }
}

/// OpenCV names a pattern after the 2 × 2 cell that begins at the second pixel of the second row, GenICam (and we)
/// after that of the first: BayerRG8 is OpenCV's BayerBG.
TEST_P(Develop, AgreesWithOpenCvUnderItsShiftedNames) {
  static const std::map<BayerPattern, int> codes{{BayerPattern::rggb, cv::COLOR_BayerBG2RGB},
                                                 {BayerPattern::grbg, cv::COLOR_BayerGB2RGB},
                                                 {BayerPattern::gbrg, cv::COLOR_BayerGR2RGB},
                                                 {BayerPattern::bggr, cv::COLOR_BayerRG2RGB}};
  Image raw = mosaic_of(smooth_scene(), GetParam().second);
  const auto ours = develop(raw, as_srgb());
  ASSERT_TRUE(ours);
  cv::Mat theirs;
  cv::cvtColor(cv::Mat(height, width, CV_8UC1, raw.samples.data()), theirs, codes.at(GetParam().first));
  constexpr int border = 2;
  for (int y = border; y < height - border; ++y)
    for (int x = border; x < width - border; ++x)
      for (int c = 0; c < 3; ++c) ASSERT_NEAR(ours->at(x, y, c), theirs.at<cv::Vec3b>(y, x)[c], 2) << x << " " << y;
}

TEST_P(Develop, IsSharperThanBilinearInterpolation) {
  // A grey edge across the mosaic: errors are the coloured fringes.
  Image scene(width, height, 3);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < 3; ++c)
        scene.at(x, y, c) = static_cast<uint8_t>(128 + 90 * std::tanh((x + 0.4 * y - 40) / 2));
  Image raw = mosaic_of(scene, GetParam().second);
  const auto ours = develop(raw, as_srgb());
  ASSERT_TRUE(ours);
  const auto error = [&](const auto& at) {
    double sum = 0;
    for (int y = 2; y < height - 2; ++y)
      for (int x = 2; x < width - 2; ++x)
        for (int c = 0; c < 3; ++c) sum += std::pow(at(x, y, c) - scene.at(x, y, c), 2);
    return sum;
  };
  const auto bilinear = [&](int x, int y, int c) {
    if (channel_of(GetParam().second, x, y) == c) return static_cast<double>(raw.at(x, y));
    double sum = 0, count = 0;
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx)
        if (channel_of(GetParam().second, x + dx + 2, y + dy + 2) == c) sum += raw.at(x + dx, y + dy), ++count;
    return sum / count;
  };
  EXPECT_LT(error([&](int x, int y, int c) { return static_cast<double>(ours->at(x, y, c)); }), error(bilinear) / 2);
}

INSTANTIATE_TEST_SUITE_P(EveryPattern, Develop, testing::ValuesIn(bayer_patterns),
                         [](const auto& pattern) { return std::string(pattern.param.second); });

TEST(DevelopFrame, LeavesFramesThatAreNotRawAsTheyAre) {
  const Frame frame{.camera = "a", .pixels = std::make_shared<const Image>(8, 8, 1, uint8_t{9})};
  const auto developed = develop(frame);
  ASSERT_TRUE(developed);
  EXPECT_EQ(developed->pixels, frame.pixels);
}

TEST(DevelopFrame, NamesTheCameraOfAFrameThatCannotBeRaw) {
  const Frame frame{.camera = "body-01", .pixels = std::make_shared<const Image>(8, 8, 3), .mosaic = Mosaic{}};
  const auto developed = develop(frame);
  ASSERT_FALSE(developed);
  EXPECT_EQ(developed.error().code, ErrorCode::invalid_argument);
  EXPECT_EQ(developed.error().message.find("body-01: "), 0u);
}

TEST(DevelopFrame, RefusesWhatIsTooSmall) {
  EXPECT_FALSE(develop(Image(3, 8, 1), Mosaic{}));
  EXPECT_FALSE(develop(Image(8, 3, 1), Mosaic{}));
  EXPECT_FALSE(develop(Image(), Mosaic{}));
}

}  // namespace
}  // namespace booth
