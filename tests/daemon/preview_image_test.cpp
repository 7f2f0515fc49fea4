#include "daemon/preview_image.h"

#include <gtest/gtest.h>

#include "daemon/empty_booth.h"

namespace booth {
namespace {

/// 4 × 2 pixels that all differ.
Image numbered() {
  Image image(4, 2, 1);
  for (size_t i = 0; i < image.samples.size(); ++i) image.samples[i] = static_cast<uint8_t>(10 * i);
  return image;
}

TEST(MakePreview, TurnsClockwise) {
  const Image image = numbered();  // 0 10 20 30 / 40 50 60 70
  EXPECT_EQ(make_preview(image, 0, 100).samples, image.samples);
  const Image quarter = make_preview(image, 90, 100);
  EXPECT_EQ(quarter.width, 2);
  EXPECT_EQ(quarter.height, 4);
  EXPECT_EQ(quarter.samples, (std::vector<uint8_t>{40, 0, 50, 10, 60, 20, 70, 30}));
  EXPECT_EQ(make_preview(image, 180, 100).samples, (std::vector<uint8_t>{70, 60, 50, 40, 30, 20, 10, 0}));
  EXPECT_EQ(make_preview(image, 270, 100).samples, (std::vector<uint8_t>{30, 70, 20, 60, 10, 50, 0, 40}));
}

TEST(MakePreview, ShrinksToTheMeanAndNeverEnlarges) {
  const Image small = make_preview(numbered(), 0, 2);
  EXPECT_EQ(small.width, 2);
  EXPECT_EQ(small.height, 1);
  EXPECT_EQ(small.samples, (std::vector<uint8_t>{25, 45}));
  EXPECT_EQ(make_preview(numbered(), 90, 1).width, 1) << "the width is the upright picture's";
  EXPECT_EQ(make_preview(numbered(), 0, 4000).width, 4);
  const Image colour(7, 5, 3, 77);
  for (const uint8_t sample : make_preview(colour, 270, 3).samples) EXPECT_EQ(sample, 77);
}

TEST(BinMosaic, FindsTheColoursOfEveryPattern) {
  constexpr uint8_t red = 200, green = 100, blue = 50;
  const auto raw_of = [](std::vector<uint8_t> samples) {
    Image raw(2, 2, 1);
    raw.samples = std::move(samples);
    return raw;
  };
  const std::vector<uint8_t> expected{red, green, blue};
  EXPECT_EQ(bin_mosaic(raw_of({red, green, green, blue}), {BayerPattern::rggb, false}).samples, expected);
  EXPECT_EQ(bin_mosaic(raw_of({green, red, blue, green}), {BayerPattern::grbg, false}).samples, expected);
  EXPECT_EQ(bin_mosaic(raw_of({green, blue, red, green}), {BayerPattern::gbrg, false}).samples, expected);
  EXPECT_EQ(bin_mosaic(raw_of({blue, green, green, red}), {BayerPattern::bggr, false}).samples, expected);
  // Half the light is 188 in sRGB.
  EXPECT_EQ(bin_mosaic(Image(2, 2, 1, 128), {BayerPattern::rggb, true}).samples, (std::vector<uint8_t>{188, 188, 188}));
}

Frame frame_of(Image image) { return {.camera = "a", .pixels = std::make_shared<const Image>(std::move(image))}; }

TEST(ChangedShare, IgnoresTheLightsStrengthAndSeesThings) {
  Image empty(320, 240, 3, 100);
  for (int y = 0; y < 240; ++y)
    for (int x = 0; x < 160; ++x) empty.at(x, y, 1) = 60;
  Image brighter = empty;
  for (uint8_t& sample : brighter.samples) sample = static_cast<uint8_t>(sample * 3 / 2);
  Image visited = empty;
  for (int y = 60; y < 180; ++y)
    for (int x = 120; x < 160; ++x)
      for (int channel = 0; channel < 3; ++channel) visited.at(x, y, channel) = 200;
  const auto share = [&](const Image& other) {
    const std::vector<CoarseView> views{coarse_view(frame_of(empty)), coarse_view(frame_of(other))};
    return changed_share(views);
  };
  EXPECT_EQ(share(empty), 0);
  EXPECT_EQ(share(brighter), 0);
  EXPECT_GT(share(visited), 0.05);
  EXPECT_EQ(changed_share({}), 0);
}

}  // namespace
}  // namespace booth
