#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <mutex>
#include <opencv2/structured_light.hpp>
#include <vector>

#include "drivers/display/delay_calibration.h"
#include "drivers/display/display_projector.h"
#include "drivers/display/mode_choice.h"
#include "drivers/display/pattern_image.h"

namespace booth {
namespace {

using testing::AllOf;
using testing::HasSubstr;

constexpr uint32_t white = 0xFFFFFF;

TEST(DrawPattern, IsOpenCvsSequence) {
  for (const auto& [width, height] : {std::pair{64, 48}, std::pair{100, 37}, std::pair{7, 5}}) {
    const GrayCodePattern pattern{.width = width, .height = height};
    const auto reference = cv::structured_light::GrayCodePattern::create(width, height);
    std::vector<cv::Mat> images;
    ASSERT_TRUE(reference->generate(images));
    images.push_back(cv::Mat(height, width, CV_8U, cv::Scalar(255)));
    images.push_back(cv::Mat(height, width, CV_8U, cv::Scalar(0)));
    ASSERT_EQ(static_cast<int>(images.size()), pattern_count(pattern));
    constexpr uint32_t untouched = 0x123456;
    const size_t stride = static_cast<size_t>(width) + 3;
    for (int i = 0; i < pattern_count(pattern); ++i) {
      std::vector<uint32_t> pixels(stride * static_cast<size_t>(height), untouched);
      draw_pattern(pattern, i, white, pixels, stride);
      int wrong = 0;
      for (int y = 0; y < height; ++y)
        for (size_t x = 0; x < stride; ++x) {
          const uint32_t pixel = pixels[static_cast<size_t>(y) * stride + x];
          const bool inside = x < static_cast<size_t>(width);
          const uint32_t expected = !inside ? untouched
                                    : images[static_cast<size_t>(i)].at<uint8_t>(y, static_cast<int>(x)) != 0 ? white
                                                                                                              : 0;
          wrong += pixel != expected;
        }
      EXPECT_EQ(wrong, 0) << width << "x" << height << ", pattern " << i;
    }
  }
}

TEST(DrawPattern, CanLeaveRowsOrInversesOut) {
  const GrayCodePattern columns{.width = 4, .height = 1, .rows = false, .inverse = false};
  ASSERT_EQ(pattern_count(columns), 4);
  const std::vector<std::vector<uint32_t>> expected{{0, 0, 1, 1}, {0, 1, 1, 0}, {1, 1, 1, 1}, {0, 0, 0, 0}};
  for (int i = 0; i < 4; ++i) {
    std::vector<uint32_t> pixels(4);
    draw_pattern(columns, i, 1, pixels, 4);
    EXPECT_EQ(pixels, expected[static_cast<size_t>(i)]) << i;
  }
}

std::vector<DisplayMode> modes() {
  return {{1920, 1080, 60, true, false},
          {1920, 1080, 50, false, false},
          {1024, 768, 59.94, false, false},
          {1024, 768, 75, false, false},
          {1920, 1080, 30.0, false, true}};
}

TEST(ChooseMode, FollowsTheSettings) {
  EXPECT_EQ(*choose_mode(modes(), {}), 0u) << "the preferred one";
  EXPECT_EQ(*choose_mode(modes(), {.width = 1024, .height = 768}), 3u) << "the fastest of that size";
  EXPECT_EQ(*choose_mode(modes(), {.width = 1024, .height = 768, .refresh_hz = 60}), 2u);
  EXPECT_EQ(*choose_mode(modes(), {.refresh_hz = 50}), 1u);
}

TEST(ChooseMode, RefusesWhatIsNotOfferedAndSaysWhatIs) {
  const auto refused = choose_mode(modes(), {.width = 800, .height = 600});
  EXPECT_EQ(refused.error().code, ErrorCode::invalid_argument);
  EXPECT_THAT(refused.error().message,
              AllOf(HasSubstr("projector: the mode 800x600 is not offered; the display offers 1920x1080 at 60 Hz"),
                    HasSubstr("1024x768 at 59.94 Hz"), HasSubstr("30 Hz interlaced")));
  EXPECT_FALSE(choose_mode(modes(), {.width = 1920, .height = 1080, .refresh_hz = 30})) << "interlaced";
  EXPECT_EQ(choose_mode({}, {}).error().code, ErrorCode::device_lost);
}

TEST(PatternFor, IsAsLargeAsTheMode) {
  const DisplayMode mode{1024, 768, 60, true, false};
  EXPECT_EQ(pattern_for(mode, {})->width, 1024);
  EXPECT_EQ(pattern_count(*pattern_for(mode, {})), 42);
  EXPECT_EQ(
      pattern_for(mode, {.pattern = {.width = 912, .height = 1140}}).error().message,
      "projector: the pattern is 912x1140, but the display shows 1024x768; they must be the same, so that no pixel "
      "is scaled");
}

TEST(WhiteLevel, FollowsTheProjectorsResponse) {
  EXPECT_EQ(white_level({.brightness = 1}), 255);
  EXPECT_EQ(white_level({.brightness = 0.5, .gamma = 1}), 128);
  EXPECT_EQ(white_level({.brightness = 0.5, .gamma = 2.2}), 186);
}

std::string fault(const DisplaySettings& settings) {
  const auto checked = check(settings);
  return checked ? "" : checked.error().message;
}

TEST(DisplaySettings, AreCheckedWithTheirRange) {
  EXPECT_EQ(fault({}), "");
  EXPECT_EQ(fault({.delay_us = -1}), "projector: delay_us is -1, expected 0 … 1000000");
  EXPECT_EQ(fault({.brightness = 0}), "projector: brightness is 0, expected 0.01 … 1");
  EXPECT_EQ(fault({.gamma = 5}), "projector: gamma is 5, expected 1 … 4");
  EXPECT_EQ(fault({.width = 640}), "projector: width and height must be set together");
  EXPECT_EQ(fault({.pattern = {.columns = false, .rows = false}}),
            "projector: the pattern has neither columns nor rows");
  EXPECT_EQ(fault({.id = "a/b"}), "display: id is \"a/b\", expected a file-name safe name");
}

TEST(DisplayProjector, ACardThatIsNotThereIsNamed) {
  const MonotonicClock clock;
  const auto opened = open_display_projector({.card = "/dev/dri/no-such-card"}, clock);
  ASSERT_FALSE(opened);
  EXPECT_EQ(opened.error().code, ErrorCode::device_lost);
  EXPECT_EQ(opened.error().message, "projector: /dev/dri/no-such-card cannot be opened: No such file or directory");
}

/// A projector and a camera that looks at it: what is flipped becomes light `latency` later, and the camera averages
/// the light over its exposure.
struct Scene {
  struct Change {
    Timestamp when = 0;
    double level = 0;
  };
  Timestamp latency = 0;
  Timestamp exposure = milliseconds(4);
  double ambient = 30;
  double light = 150;
  bool seen = true;  ///< the camera looks at the projector
  std::vector<Change> changes;

  double mean_level(Timestamp from) const {
    double level = 0, sum = 0;
    Timestamp at = from;
    for (const Change& change : changes) {
      if (change.when > from && change.when < from + exposure) {
        sum += level * static_cast<double>(change.when - at);
        at = change.when;
      }
      if (change.when < from + exposure) level = change.level;
    }
    return (sum + level * static_cast<double>(from + exposure - at)) / static_cast<double>(exposure);
  }
};

class SceneProjector final : public FlippingProjector {
 public:
  SceneProjector(Scene& scene, const Clock& clock) : scene_(scene), clock_(clock) {}
  const ProjectorInfo& info() const override { return info_; }
  Timestamp refresh_ns() const override { return milliseconds(2); }
  Result<Timestamp> flip(int index) override {
    const Timestamp now = clock_.now();
    scene_.latency += slows_down;
    scene_.changes.push_back({now + scene_.latency, index == pattern_count(info_.pattern) - 2 ? 1.0 : 0.0});
    is_dark = false;
    return now;
  }
  Result<void> show(int index) override {
    const auto flipped = flip(index);
    return flipped ? Result<void>() : flipped.error();
  }
  void dark() noexcept override { is_dark = true; }
  bool is_dark = true;
  Timestamp slows_down = 0;  ///< by which each pattern takes longer than the last

 private:
  Scene& scene_;
  const Clock& clock_;
  ProjectorInfo info_{"projector", "test", {.width = 8, .height = 8}};
};

/// Goes by note_trigger, as a USB camera does.
class SceneCamera final : public Camera {
 public:
  SceneCamera(Scene& scene) : scene_(scene) {}
  const CameraInfo& info() const override { return info_; }
  Result<void> arm(const CaptureSettings& settings, int) override {
    EXPECT_EQ(settings.role, ShotRole::gray_code);
    armed = true;
    return {};
  }
  void note_trigger(int, Timestamp when) noexcept override { trigger_ = when; }
  Result<Frame> wait_frame(Timestamp) override {
    if (fails) return Error{ErrorCode::timeout, "face-left: delivered no frame in time"};
    const size_t number = taken_++;
    const int width = grows ? 10 + static_cast<int>(number) : 10;
    const double level = scene_.ambient + (scene_.seen ? scene_.light * scene_.mean_level(trigger_) : 0);
    return Frame{.camera = info_.id,
                 .timestamp_ns = trigger_ + (jitter.empty() ? 0 : jitter[number % jitter.size()]),
                 .pixels = std::make_shared<const Image>(width, 10, 1, static_cast<uint8_t>(level))};
  }
  void stop() noexcept override { armed = false; }
  bool armed = false;
  bool fails = false;
  bool grows = false;             ///< each picture is wider than the last
  std::vector<Timestamp> jitter;  ///< by how much later, picture by picture, it says that it exposed

 private:
  Scene& scene_;
  size_t taken_ = 0;
  CameraInfo info_{"face-left", "test", CameraRole::face, 10, 10};
  Timestamp trigger_ = 0;
};

class DelayCalibrationTest : public testing::Test {
 protected:
  static constexpr DelayCalibrationOptions quick{.max_delay_ms = 40, .repeats = 1};

  MonotonicClock clock;
  Scene scene;
  SceneProjector projector{scene, clock};
  SceneCamera camera{scene};
};

TEST_F(DelayCalibrationTest, FindsTheDelay) {
  scene.latency = milliseconds(17);
  const auto measured = calibrate_delay(projector, nullptr, camera, clock, quick);
  ASSERT_TRUE(measured) << measured.error().message;
  // Up to 3 % of the exposure may hold the other pattern; a busy machine begins exposures late, which costs precision.
  EXPECT_GE(measured->measured_us, 16800);
  EXPECT_LE(measured->measured_us, 22000);
  EXPECT_EQ(measured->delay_us, measured->measured_us + 2000) << "one refresh for safety";
  EXPECT_NEAR(measured->contrast, 150, 1);
  EXPECT_TRUE(projector.is_dark);
  EXPECT_FALSE(camera.armed);
}

/// What it recommends is enough though some pictures are older than they say.
TEST_F(DelayCalibrationTest, IsOnTheSafeSideOfACameraWhoseInstantsJitter) {
  scene.latency = milliseconds(10);
  camera.jitter = {0, 0, milliseconds(6), 0, milliseconds(2), milliseconds(8), 0, milliseconds(4)};
  const auto measured = calibrate_delay(projector, nullptr, camera, clock, quick);
  ASSERT_TRUE(measured) << measured.error().message;
  EXPECT_GE(measured->measured_us, 9800);
  EXPECT_LE(measured->measured_us, 30'000);
}

TEST_F(DelayCalibrationTest, RefusesACameraThatDoesNotSeeTheProjector) {
  scene.seen = false;
  const auto refused = calibrate_delay(projector, nullptr, camera, clock, quick);
  EXPECT_EQ(refused.error().code, ErrorCode::not_ready);
  EXPECT_EQ(refused.error().message,
            "face-left: does not see the light of projector; darken the booth, or expose longer");
  EXPECT_TRUE(projector.is_dark);
}

TEST_F(DelayCalibrationTest, RefusesAProjectorThatIsSlowerThanTheLongestDelay) {
  scene.latency = milliseconds(43);
  const auto refused = calibrate_delay(projector, nullptr, camera, clock, quick);
  EXPECT_EQ(refused.error().code, ErrorCode::not_ready);
  EXPECT_EQ(refused.error().message,
            "face-left: pictures still mix two patterns 40 ms after the flip; does the scene move, or the light "
            "flicker?");
}

/// By the time a delay was found it is not long enough any more.
TEST_F(DelayCalibrationTest, RefusesAProjectorThatIsNotSteady) {
  projector.slows_down = milliseconds(4);
  const auto refused = calibrate_delay(projector, nullptr, camera, clock, quick);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::not_ready);
  EXPECT_THAT(refused.error().message,
              testing::MatchesRegex("face-left: the delay is not steady: pictures still mixed two patterns [0-9]+ µs "
                                    "after the flip; does the scene move, or the light flicker.*"));
  EXPECT_TRUE(projector.is_dark);
}

TEST_F(DelayCalibrationTest, RefusesPicturesThatChangeTheirSize) {
  camera.grows = true;
  EXPECT_EQ(calibrate_delay(projector, nullptr, camera, clock, quick).error().message,
            "face-left: its pictures differ in size");
}

TEST_F(DelayCalibrationTest, IsDarkAfterAFault) {
  camera.fails = true;
  EXPECT_EQ(calibrate_delay(projector, nullptr, camera, clock, quick).error().code, ErrorCode::timeout);
  EXPECT_TRUE(projector.is_dark);
  EXPECT_FALSE(camera.armed);
}

TEST_F(DelayCalibrationTest, RefusesBadOptions) {
  const std::pair<DelayCalibrationOptions, const char*> cases[] = {
      {{.max_delay_ms = 9}, "projector calibration: max_delay_ms, expected 10 … 2000"},
      {{.repeats = 0}, "projector calibration: repeats, expected 1 … 100"},
      {{.tolerance = 0.5}, "projector calibration: tolerance, expected 0.001 … 0.2"},
      {{.frame_timeout_ms = 49}, "projector calibration: frame_timeout_ms, expected 50 … 60000"}};
  for (const auto& [options, message] : cases) {
    const auto refused = calibrate_delay(projector, nullptr, camera, clock, options);
    EXPECT_EQ(refused.error().code, ErrorCode::invalid_argument);
    EXPECT_EQ(refused.error().message, message);
  }
}

}  // namespace
}  // namespace booth
