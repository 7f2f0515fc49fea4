#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>
#include <vector>

#include "drivers/v4l2/frame_choice.h"
#include "drivers/v4l2/mjpeg.h"
#include "drivers/v4l2/v4l2_settings.h"
#include "drivers/v4l2/yuyv.h"
#include "pipeline/image/codec.h"

namespace booth {
namespace {

using testing::HasSubstr;

constexpr Timestamp ms = 1'000'000;

StreamedFrame frame_at(Timestamp begin_ms, uint64_t sequence = 0, const std::string& damage = {}) {
  return {.begin_ns = begin_ms * ms, .sequence = sequence, .bytes = {}, .damage = damage};
}

FrameChoice nearest(int count = 100) { return {FrameChoice::Rule::nearest, count, 100 * ms, 33 * ms}; }

TEST(FrameChoice, WaitsUntilNoLaterFrameCanBeNearer) {
  FrameChoice choice = nearest();
  choice.add_frame(frame_at(990, 1));
  choice.add_trigger(0, 1000 * ms);
  EXPECT_FALSE(choice.next());
  choice.add_frame(frame_at(1023, 2));
  const auto answer = choice.next();
  ASSERT_TRUE(answer && answer->frame);
  EXPECT_EQ(answer->index, 0);
  EXPECT_EQ(answer->frame->sequence, 1u);
  EXPECT_EQ(answer->offset_ns, -10 * ms);
}

TEST(FrameChoice, TakesTheLaterFrameWhereThatIsNearer) {
  FrameChoice choice = nearest();
  choice.add_frame(frame_at(975, 1));
  choice.add_frame(frame_at(1008, 2));
  choice.add_trigger(0, 1000 * ms);  // told late: the frame is there already
  EXPECT_EQ(choice.next()->frame->sequence, 2u);
}

TEST(FrameChoice, InASequenceAFrameThatBeganBeforeItsTriggerIsNotTaken) {
  FrameChoice choice(FrameChoice::Rule::first_after, 10, 100 * ms, 33 * ms);
  choice.add_frame(frame_at(999, 1));
  choice.add_trigger(0, 1000 * ms);
  EXPECT_FALSE(choice.next());
  choice.add_frame(frame_at(1032, 2));
  EXPECT_EQ(choice.next()->frame->sequence, 2u);
}

TEST(FrameChoice, AFrameAnswersOneTriggerOnlyTheNearest) {
  FrameChoice choice = nearest();
  choice.add_trigger(0, 1000 * ms);
  choice.add_trigger(1, 1050 * ms);
  choice.add_frame(frame_at(1055, 7));
  const auto first = choice.next();
  ASSERT_TRUE(first);
  EXPECT_EQ(first->index, 0);
  EXPECT_FALSE(first->frame) << "that frame is nearer to the next trigger";
  const auto second = choice.next();
  ASSERT_TRUE(second && second->frame);
  EXPECT_EQ(second->index, 1);
  EXPECT_FALSE(choice.next());
}

TEST(FrameChoice, TriggersWithinOneFramePeriodTakeFramesInTheirOrder) {
  FrameChoice choice = nearest();
  choice.add_trigger(0, 1000 * ms);
  choice.add_trigger(1, 1002 * ms);
  choice.add_frame(frame_at(1010, 1));
  choice.add_frame(frame_at(1043, 2));
  EXPECT_EQ(choice.next()->frame->sequence, 1u);
  EXPECT_EQ(choice.next()->frame->sequence, 2u);
}

TEST(FrameChoice, ALateTriggerIsNotGivenAnAnsweredTriggersFrame) {
  FrameChoice choice = nearest();
  choice.add_trigger(0, 1000 * ms);
  choice.add_frame(frame_at(995, 1));
  choice.add_frame(frame_at(1003, 2));
  EXPECT_EQ(choice.next()->frame->sequence, 2u);
  choice.add_trigger(1, 1010 * ms);
  choice.add_frame(frame_at(1036, 3));
  EXPECT_EQ(choice.next()->frame->sequence, 3u);
}

TEST(FrameChoice, NothingFartherThanTheLimitAnswers) {
  FrameChoice choice = nearest();
  choice.add_frame(frame_at(890));
  choice.add_trigger(0, 1000 * ms);
  choice.add_frame(frame_at(1101));
  const auto answer = choice.next();
  ASSERT_TRUE(answer);
  EXPECT_FALSE(answer->frame);
  EXPECT_TRUE(answer->damage.empty());
}

TEST(FrameChoice, ADamagedFrameIsReplacedByItsNeighbourOrReported) {
  FrameChoice choice = nearest();
  choice.add_trigger(0, 1000 * ms);
  choice.add_frame(frame_at(1001, 1, "cut off"));
  EXPECT_FALSE(choice.next()) << "the next one may be whole";
  choice.add_frame(frame_at(1034, 2));
  EXPECT_EQ(choice.next()->frame->sequence, 2u);

  choice.add_trigger(1, 2000 * ms);
  choice.add_frame(frame_at(2001, 3, "cut off"));
  EXPECT_FALSE(choice.next());
  const auto answer = choice.next_damaged();
  ASSERT_TRUE(answer);
  EXPECT_EQ(answer->index, 1);
  EXPECT_EQ(answer->damage, "cut off");
  EXPECT_FALSE(choice.next_damaged());
}

TEST(FrameChoice, AnswersOnlyTheTriggersItWasMadeFor) {
  FrameChoice choice = nearest(1);
  choice.add_trigger(-1, 1000 * ms);
  choice.add_trigger(1, 1000 * ms);
  choice.add_frame(frame_at(1001));
  EXPECT_FALSE(choice.next());
}

TEST(FrameChoice, ATriggerThatFiresAgainWaitsForTheNewFrame) {
  FrameChoice choice = nearest();
  choice.add_trigger(3, 1000 * ms);
  choice.add_trigger(3, 1500 * ms);
  choice.add_frame(frame_at(1501, 9));
  EXPECT_EQ(choice.next()->index, 3);
  EXPECT_FALSE(choice.next());
}

/// Whatever the phase between triggers and stream, nothing is ever farther off than half a frame period.
TEST(FrameChoice, IsNeverFartherOffThanHalfAPeriod) {
  for (Timestamp phase = 0; phase < 33; ++phase) {
    FrameChoice choice = nearest();
    Timestamp frame = phase;
    for (int index = 0; index < 10; ++index) {
      const Timestamp trigger = 100 + index * 97;
      while (frame < trigger) choice.add_frame(frame_at(frame)), frame += 33;
      choice.add_trigger(index, trigger * ms);
      while (frame < trigger + 40) choice.add_frame(frame_at(frame)), frame += 33;
      const auto answer = choice.next();
      ASSERT_TRUE(answer && answer->frame) << phase << " " << index;
      EXPECT_LE(std::abs(answer->offset_ns), 17 * ms) << phase << " " << index;
    }
  }
}

std::vector<uint8_t> jpeg() {
  Image image(16, 8, 3);
  for (size_t i = 0; i < image.samples.size(); ++i) image.samples[i] = static_cast<uint8_t>(i * 37);
  return encode_jpeg(image);
}

TEST(WholeJpeg, AcceptsAPictureAndCutsThePaddingOff) {
  std::vector<uint8_t> bytes = jpeg();
  const size_t size = bytes.size();
  EXPECT_EQ(whole_jpeg(bytes), size);
  bytes.resize(size + 100, 0);
  EXPECT_EQ(whole_jpeg(bytes), size);
  bytes.resize(size);
  bytes.insert(bytes.end(), {0xFF, 0xD8, 0xFF, 0xD9});
  EXPECT_EQ(whole_jpeg(bytes), size);
}

TEST(WholeJpeg, RefusesEveryTruncation) {
  const std::vector<uint8_t> bytes = jpeg();
  for (size_t size = 0; size < bytes.size(); ++size)
    EXPECT_FALSE(whole_jpeg(std::span(bytes).first(size))) << size << " of " << bytes.size();
}

TEST(WholeJpeg, RefusesWhatIsNoJpeg) {
  EXPECT_FALSE(whole_jpeg({}));
  EXPECT_FALSE(whole_jpeg(std::vector<uint8_t>(1000, 0)));
  EXPECT_FALSE(whole_jpeg(std::vector<uint8_t>(1000, 0xFF)));
  EXPECT_FALSE(whole_jpeg(std::vector<uint8_t>{0xFF, 0xD8, 0xFF, 0xD9})) << "no picture in it";
  std::vector<uint8_t> joined = jpeg();  // one frame's beginning, then the next frame
  joined.resize(joined.size() / 2);
  const std::vector<uint8_t> next = jpeg();
  joined.insert(joined.end(), next.begin(), next.end());
  EXPECT_FALSE(whole_jpeg(joined));
}

std::vector<int> colour(uint8_t y, uint8_t u, uint8_t v, YuvEncoding encoding) {
  const std::vector<uint8_t> bytes{y, u, y, v};
  const Image rgb = rgb_from_yuyv(bytes, bytes.size(), 2, 1, encoding);
  EXPECT_EQ(rgb.at(0, 0, 0), rgb.at(1, 0, 0));
  return {rgb.at(0, 0, 0), rgb.at(0, 0, 1), rgb.at(0, 0, 2)};
}

TEST(RgbFromYuyv, KnowsTheStandardsColours) {
  const YuvEncoding studio{.bt709 = false, .full_range = false};
  EXPECT_EQ(colour(16, 128, 128, studio), (std::vector{0, 0, 0}));
  EXPECT_EQ(colour(235, 128, 128, studio), (std::vector{255, 255, 255}));
  EXPECT_EQ(colour(81, 90, 240, studio), (std::vector{254, 0, 0}));   // BT.601's red, rounded to 8 bits
  EXPECT_EQ(colour(145, 54, 34, studio), (std::vector{0, 255, 1}));   // green
  EXPECT_EQ(colour(41, 240, 110, studio), (std::vector{0, 0, 255}));  // blue
  EXPECT_EQ(colour(100, 128, 128, {.full_range = true}), (std::vector{100, 100, 100}));
  EXPECT_EQ(colour(63, 102, 240, {.bt709 = true}), (std::vector{255, 1, 0}));  // BT.709's red
}

TEST(RgbFromYuyv, SkipsWhatLinesArePaddedWith) {
  const std::vector<uint8_t> bytes{10, 128, 20, 128, 99, 99, 30, 128, 40, 128, 99, 99};
  const Image rgb = rgb_from_yuyv(bytes, 6, 2, 2, {.full_range = true});
  EXPECT_EQ(rgb.samples, (std::vector<uint8_t>{10, 10, 10, 20, 20, 20, 30, 30, 30, 40, 40, 40}));
}

V4l2CameraSettings good() { return {.id = "body-00", .device = "/dev/video0"}; }

std::string fault(const V4l2CameraSettings& camera) {
  const auto checked = check(V4l2Settings{{camera}});
  if (checked) return "";
  EXPECT_EQ(checked.error().code, ErrorCode::invalid_argument);
  return checked.error().message;
}

TEST(V4l2Settings, DefaultsAreFine) { EXPECT_EQ(fault(good()), ""); }

TEST(V4l2Settings, NameCameraSettingValueAndWhatWouldDo) {
  auto camera = good();
  camera.exposure_us = 50;
  EXPECT_EQ(fault(camera), "body-00: exposure_us is 50, expected a multiple of 100 in 100 … 10000000");
  camera = good();
  camera.gray_code_exposure_us = 12345;
  EXPECT_THAT(fault(camera), HasSubstr("body-00: gray_code_exposure_us is 12345"));
  camera = good();
  camera.fps = std::numeric_limits<double>::quiet_NaN();
  EXPECT_EQ(fault(camera), "body-00: fps is nan, expected 0 … 1000");
  camera = good();
  camera.buffers = 1;
  EXPECT_EQ(fault(camera), "body-00: buffers is 1, expected 2 … 32");
  camera = good();
  camera.width = 640;
  EXPECT_EQ(fault(camera), "body-00: width and height must be set together");
  camera = good();
  camera.serial = "X";
  EXPECT_EQ(fault(camera), "body-00: exactly one of device, serial and bus must be set");
  camera.device.clear();
  EXPECT_EQ(fault(camera), "");
  camera.serial.clear();
  EXPECT_THAT(fault(camera), HasSubstr("exactly one"));
  camera = good();
  camera.id = "../x";
  EXPECT_THAT(fault(camera), HasSubstr("\"../x\""));
  EXPECT_THAT(check(V4l2Settings{{good(), good()}}).error().message, HasSubstr("two cameras are called body-00"));
}

TEST(V4l2Format, NamesReadBack) {
  for (const char* name : {"auto", "mjpg", "yuyv", "grey", "rggb", "grbg", "gbrg", "bggr"})
    EXPECT_EQ(to_string(*v4l2_format_from(name)), name);
  EXPECT_FALSE(v4l2_format_from("h264"));
}

}  // namespace
}  // namespace booth
