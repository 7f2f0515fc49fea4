#include "pipeline/image/codec.h"

#include <gtest/gtest.h>
#include <png.h>
#include <zlib.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <random>
#include <string>
#include <vector>

namespace booth {
namespace {

using Bytes = std::vector<uint8_t>;

uint32_t draw(std::mt19937& random, uint32_t below) { return static_cast<uint32_t>(random() % below); }

/// Smooth, with some noise, so that both coders have something to do.
Image picture(int width, int height, int channels, uint32_t seed = 1) {
  Image image(width, height, channels);
  std::mt19937 random(seed);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int c = 0; c < channels; ++c)
        image.at(x, y, c) =
            static_cast<uint8_t>(128 + 90 * std::sin(0.1 * x + c) * std::cos(0.07 * y) + draw(random, 8));
  return image;
}

void expect_same(const Image& expected, const Image& found) {
  EXPECT_EQ(found.width, expected.width);
  EXPECT_EQ(found.height, expected.height);
  EXPECT_EQ(found.channels, expected.channels);
  EXPECT_EQ(found.samples, expected.samples);
}

/// A fault or a picture, never a crash; and both functions agree about the header of what can be decoded.
void try_to_decode(std::span<const uint8_t> bytes) {
  const auto header = read_image_header(bytes);
  const auto image = decode_image(bytes);
  if (!image) {
    EXPECT_EQ(image.error().code, ErrorCode::invalid_file);
    EXPECT_FALSE(image.error().message.empty());
    return;
  }
  ASSERT_TRUE(header);
  EXPECT_EQ(header->width, image->width);
  EXPECT_EQ(header->height, image->height);
  EXPECT_EQ(header->channels, image->channels);
  EXPECT_EQ(image->samples.size(), static_cast<size_t>(image->width * image->height * image->channels));
}

void append_big_endian(Bytes& bytes, uint32_t word) {
  for (int shift = 24; shift >= 0; shift -= 8) bytes.push_back(static_cast<uint8_t>(word >> shift));
}

void append_chunk(Bytes& png, const std::string& type, const Bytes& content) {
  append_big_endian(png, static_cast<uint32_t>(content.size()));
  Bytes checked(type.begin(), type.end());
  checked.insert(checked.end(), content.begin(), content.end());
  png.insert(png.end(), checked.begin(), checked.end());
  append_big_endian(png, static_cast<uint32_t>(crc32(0, checked.data(), static_cast<uInt>(checked.size()))));
}

/// A PNG put together by hand. `rows` holds each row behind its filter's byte.
Bytes make_png(uint32_t width, uint32_t height, int bits, int colour_type, const Bytes& rows,
               const Bytes& palette = {}) {
  Bytes header;
  append_big_endian(header, width);
  append_big_endian(header, height);
  header.insert(header.end(), {static_cast<uint8_t>(bits), static_cast<uint8_t>(colour_type), 0, 0, 0});
  Bytes compressed(compressBound(rows.size()));
  uLongf size = compressed.size();
  compress(compressed.data(), &size, rows.data(), rows.size());
  compressed.resize(size);
  Bytes png{0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n'};
  append_chunk(png, "IHDR", header);
  if (!palette.empty()) append_chunk(png, "PLTE", palette);
  append_chunk(png, "IDAT", compressed);
  append_chunk(png, "IEND", {});
  return png;
}

// ---- round trips ----------------------------------------------------------------------------------------------------

TEST(Png, ComesBackExactly) {
  for (const int channels : {1, 3, 4})
    for (const auto& [width, height] : {std::pair{1, 1}, {1, 17}, {23, 1}, {64, 48}, {101, 67}}) {
      const Image image = picture(width, height, channels);
      const Bytes png = encode_png(image);
      const auto decoded = decode_image(png);
      ASSERT_TRUE(decoded) << decoded.error().message;
      expect_same(image, *decoded);
      const auto header = read_image_header(png);
      ASSERT_TRUE(header);
      EXPECT_EQ(header->format, ImageFormat::png);
      EXPECT_EQ(header->width, width);
      EXPECT_EQ(header->height, height);
      EXPECT_EQ(header->channels, channels);
    }
}

TEST(Png, ComesBackExactlyAtEveryLevel) {
  const Image image = picture(90, 70, 3);
  for (int level = 0; level <= 12; ++level) {
    const auto decoded = decode_image(encode_png(image, level));
    ASSERT_TRUE(decoded);
    expect_same(image, *decoded);
  }
  EXPECT_LT(encode_png(image, 9).size(), encode_png(image, 0).size());
}

TEST(Png, ComesBackExactlyWhicheverFilterARowLikes) {
  std::mt19937 random(4);
  Image image(64, 120, 3);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x)
      for (int c = 0; c < 3; ++c) {
        uint8_t& sample = image.at(x, y, c);
        switch (y / 20) {
          case 0: sample = static_cast<uint8_t>(random()); break;                                        // none
          case 1: sample = static_cast<uint8_t>(7 * x + c + 31 * (y % 2)); break;                        // left
          case 2: sample = y % 20 == 0 ? static_cast<uint8_t>(random()) : image.at(x, y - 1, c); break;  // up
          case 3: sample = static_cast<uint8_t>(3 * x + 5 * y); break;
          case 4: sample = y % 2 == 0 ? 0 : 255; break;
          default: sample = static_cast<uint8_t>(x * y); break;
        }
      }
  const auto decoded = decode_image(encode_png(image));
  ASSERT_TRUE(decoded);
  expect_same(image, *decoded);
}

TEST(Png, IsTheSameEveryTime) {
  const Image image = picture(80, 60, 3);
  EXPECT_EQ(encode_png(image), encode_png(image));
}

TEST(Jpeg, ComesBackNearly) {
  for (const int channels : {1, 3}) {
    const Image image = picture(121, 83, channels);
    const Bytes jpeg = encode_jpeg(image, 95);
    const auto decoded = decode_image(jpeg);
    ASSERT_TRUE(decoded) << decoded.error().message;
    ASSERT_EQ(decoded->samples.size(), image.samples.size());
    EXPECT_EQ(decoded->channels, channels);
    double sum = 0;
    for (size_t i = 0; i < image.samples.size(); ++i) sum += std::pow(image.samples[i] - decoded->samples[i], 2);
    EXPECT_LT(std::sqrt(sum / static_cast<double>(image.samples.size())), 4);
    const auto header = read_image_header(jpeg);
    ASSERT_TRUE(header);
    EXPECT_EQ(header->format, ImageFormat::jpeg);
    EXPECT_EQ(header->channels, channels);
  }
}

TEST(Jpeg, LosesLessWithMoreQuality) {
  const Image image = picture(64, 64, 3);
  EXPECT_LT(encode_jpeg(image, 50).size(), encode_jpeg(image, 95).size());
}

TEST(Encode, RefusesImagesThatTheFormatCannotHold) {
  EXPECT_THROW(encode_png(Image(4, 4, 2)), std::invalid_argument);
  EXPECT_THROW(encode_png(Image()), std::invalid_argument);
  EXPECT_THROW(encode_png(picture(4, 4, 3), 13), std::invalid_argument);
  EXPECT_THROW(encode_jpeg(Image(4, 4, 4)), std::invalid_argument);
  EXPECT_THROW(encode_jpeg(Image()), std::invalid_argument);
}

// ---- other kinds of PNG ---------------------------------------------------------------------------------------------

TEST(Decode, BringsSixteenBitsToEight) {
  const auto image = decode_image(make_png(2, 1, 16, PNG_COLOR_TYPE_GRAY, {0, 0xff, 0xff, 0x80, 0x00}));
  ASSERT_TRUE(image) << image.error().message;
  EXPECT_EQ(image->channels, 1);
  EXPECT_EQ(image->samples, (Bytes{255, 128}));
}

TEST(Decode, SpreadsFewBitsOverTheWholeRange) {
  const auto image = decode_image(make_png(3, 1, 2, PNG_COLOR_TYPE_GRAY, {0, 0b00'01'11'00}));
  ASSERT_TRUE(image) << image.error().message;
  EXPECT_EQ(image->samples, (Bytes{0, 85, 255}));
}

TEST(Decode, LooksUpPalettes) {
  const auto image = decode_image(make_png(2, 1, 8, PNG_COLOR_TYPE_PALETTE, {0, 1, 0}, {10, 20, 30, 40, 50, 60}));
  ASSERT_TRUE(image) << image.error().message;
  EXPECT_EQ(image->channels, 3);
  EXPECT_EQ(image->samples, (Bytes{40, 50, 60, 10, 20, 30}));
}

TEST(Decode, TurnsGreyWithAlphaIntoRgba) {
  const Bytes png = make_png(2, 1, 8, PNG_COLOR_TYPE_GRAY_ALPHA, {0, 100, 7, 200, 255});
  const auto image = decode_image(png);
  ASSERT_TRUE(image) << image.error().message;
  EXPECT_EQ(image->samples, (Bytes{100, 100, 100, 7, 200, 200, 200, 255}));
  EXPECT_EQ(read_image_header(png)->channels, 4);
}

// ---- faults ---------------------------------------------------------------------------------------------------------

TEST(Decode, RefusesWhatIsNoImage) {
  for (const std::string text : {"", "x", "GIF89a", "\x89PNG", "\xff\xd8", "{\"json\": true}"}) {
    const Bytes bytes(text.begin(), text.end());
    EXPECT_FALSE(decode_image(bytes)) << text;
    EXPECT_FALSE(read_image_header(bytes)) << text;
  }
}

TEST(Decode, RefusesEveryTruncation) {
  for (const Bytes& whole : {encode_png(picture(40, 30, 3)), encode_jpeg(picture(40, 30, 3)),
                             encode_png(picture(40, 30, 1)), encode_jpeg(picture(40, 30, 1))}) {
    ASSERT_TRUE(decode_image(whole));
    for (size_t length = 0; length < whole.size(); length += length < 100 ? 1 : 13)
      EXPECT_FALSE(decode_image(std::span(whole).first(length))) << length << " of " << whole.size();
  }
}

TEST(Decode, SurvivesScrambledBytes) {
  std::mt19937 random(9);
  for (const Bytes& whole : {encode_png(picture(24, 20, 3)), encode_jpeg(picture(24, 20, 3)),
                             make_png(9, 1, 8, PNG_COLOR_TYPE_PALETTE, Bytes(10, 1), Bytes(6, 99))})
    for (int round = 0; round < 1500; ++round) {
      Bytes bytes = whole;
      for (unsigned flips = 1 + draw(random, 4); flips > 0; --flips)
        bytes[draw(random, static_cast<uint32_t>(bytes.size()))] = static_cast<uint8_t>(random());
      try_to_decode(bytes);
    }
}

TEST(Decode, SurvivesScrambledHeadersWithRightChecksums) {
  std::mt19937 random(10);
  for (int round = 0; round < 1000; ++round) {
    const Bytes rows(draw(random, 200), static_cast<uint8_t>(draw(random, 6)));
    try_to_decode(make_png(draw(random, 40), draw(random, 40), static_cast<int>(draw(random, 18)),
                           static_cast<int>(draw(random, 8)), rows, Bytes(draw(random, 12), 50)));
  }
}

TEST(Decode, RefusesEmptyImages) {
  EXPECT_FALSE(decode_image(make_png(0, 5, 8, PNG_COLOR_TYPE_GRAY, {})));
  EXPECT_FALSE(decode_image(make_png(5, 0, 8, PNG_COLOR_TYPE_GRAY, {})));
}

TEST(Decode, RefusesImagesTooLargeToHoldWithoutTryingTo) {
  for (const auto& [width, height] :
       {std::pair{100'000U, 100'000U}, {0x7fffffffU, 1U}, {0xffffffffU, 0xffffffffU}, {20'000U, 5'001U}}) {
    const Bytes png = make_png(width, height, 8, PNG_COLOR_TYPE_RGB, {0, 1, 2, 3});
    EXPECT_FALSE(decode_image(png)) << width << " × " << height;
    EXPECT_FALSE(read_image_header(png)) << width << " × " << height;
  }
  Bytes jpeg = encode_jpeg(picture(16, 16, 3));
  const Bytes start_of_frame{0xff, 0xc0};
  const auto frame = std::search(jpeg.begin(), jpeg.end(), start_of_frame.begin(), start_of_frame.end());
  ASSERT_NE(frame, jpeg.end());
  std::fill(frame + 5, frame + 9, uint8_t{0xff});  // 65535 × 65535
  EXPECT_FALSE(decode_image(jpeg));
  EXPECT_FALSE(read_image_header(jpeg));
  std::fill(frame + 5, frame + 9, uint8_t{0x20});  // 8224 × 8224 from some hundred bytes
  EXPECT_FALSE(decode_image(jpeg));
}

TEST(Decode, AcceptsImagesThatCompressWell) {
  for (const Image& image : {Image(3000, 2000, 1, 255), Image(1000, 3000, 3, 0)}) {
    const auto from_png = decode_image(encode_png(image, 12));
    ASSERT_TRUE(from_png) << from_png.error().message;
    expect_same(image, *from_png);
    const auto from_jpeg = decode_image(encode_jpeg(image, 10));
    ASSERT_TRUE(from_jpeg) << from_jpeg.error().message;
  }
}

TEST(Decode, RefusesPixelsThatTheFileDoesNotHold) {
  const auto image = decode_image(make_png(8, 8, 8, PNG_COLOR_TYPE_RGB, Bytes(25, 0)));  // one row of eight
  EXPECT_FALSE(image);
}

}  // namespace
}  // namespace booth
