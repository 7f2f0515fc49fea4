#include "pipeline/image/webp.h"

#include <gtest/gtest.h>
#include <webp/demux.h>

#include <cstdlib>
#include <memory>
#include <stdexcept>
#include <vector>

namespace booth {
namespace {

/// A disc that sits at another place in each frame, on a transparent ground.
std::vector<Image> moving_disc(int frames) {
  std::vector<Image> images;
  for (int f = 0; f < frames; ++f) {
    Image& image = images.emplace_back(64, 48, 4);
    for (int y = 0; y < image.height; ++y)
      for (int x = 0; x < image.width; ++x) {
        const int dx = x - 12 - 8 * f, dy = y - 24;
        if (dx * dx + dy * dy > 100) continue;
        image.at(x, y, 0) = 200;
        image.at(x, y, 1) = static_cast<uint8_t>(40 * f);
        image.at(x, y, 3) = 255;
      }
  }
  return images;
}

TEST(WebpAnimation, ReadsBackFrameByFrame) {
  const std::vector<Image> frames = moving_disc(5);
  const std::vector<uint8_t> bytes = encode_webp_animation(frames, 0.125, 90);
  const WebPData data{bytes.data(), bytes.size()};
  const std::unique_ptr<WebPAnimDecoder, void (*)(WebPAnimDecoder*)> decoder(WebPAnimDecoderNew(&data, nullptr),
                                                                             WebPAnimDecoderDelete);
  ASSERT_TRUE(decoder);
  WebPAnimInfo info;
  ASSERT_TRUE(WebPAnimDecoderGetInfo(decoder.get(), &info));
  EXPECT_EQ(info.canvas_width, 64U);
  EXPECT_EQ(info.canvas_height, 48U);
  EXPECT_EQ(info.loop_count, 0U);  // for ever
  ASSERT_EQ(info.frame_count, 5U);
  for (int f = 0; f < 5; ++f) {
    uint8_t* pixels = nullptr;
    int end_ms = 0;
    ASSERT_TRUE(WebPAnimDecoderGetNext(decoder.get(), &pixels, &end_ms));
    EXPECT_EQ(end_ms, 125 * (f + 1));
    const Image& frame = frames[static_cast<size_t>(f)];
    for (int y = 0; y < 48; ++y)
      for (int x = 0; x < 64; ++x) EXPECT_EQ(pixels[4 * (64 * y + x) + 3], frame.at(x, y, 3)) << x << ", " << y;
    const uint8_t* middle = pixels + 4 * (64 * 24 + 12 + 8 * f);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(middle[c], frame.at(12 + 8 * f, 24, c), 16);
  }
}

TEST(WebpAnimation, RefusesWhatIsNoAnimation) {
  EXPECT_THROW(encode_webp_animation({}, 0.1, 80), std::invalid_argument);
  EXPECT_THROW(encode_webp_animation(moving_disc(2), 0, 80), std::invalid_argument);
  EXPECT_THROW(encode_webp_animation(std::vector<Image>{Image(8, 8, 4), Image(8, 9, 4)}, 0.1, 80),
               std::invalid_argument);
  EXPECT_THROW(encode_webp_animation(std::vector<Image>{Image(8, 8, 3)}, 0.1, 80), std::invalid_argument);
}

}  // namespace
}  // namespace booth
