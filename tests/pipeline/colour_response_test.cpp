#include "pipeline/calibration/colour_response.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <random>
#include <string>
#include <vector>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/calibration.h"
#include "pipeline/calibration/report.h"
#include "pipeline/geometry/camera_model.h"
#include "tests/synthetic/board_recording.h"

namespace booth {
namespace {

using testing::Contains;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::StartsWith;

const CalibrationBoard board = synthetic::small_board();

/// Cameras of enough pixels that the white around the markers is wider than the blur.
Rig fine_rig() {
  Rig rig = synthetic::arc_rig();
  for (RigCamera& camera : rig.cameras) {
    Intrinsics& k = camera.intrinsics;
    k.width *= 2, k.height *= 2, k.fx *= 2, k.fy *= 2, k.cx *= 2, k.cy *= 2;
  }
  return rig;
}

uint8_t value_of(double light, double noise) {
  const double l = std::clamp(light, 0.0, 1.0);
  const double encoded = l <= 0.0031308 ? 12.92 * l : 1.055 * std::pow(l, 1 / 2.4) - 0.055;
  return static_cast<uint8_t>(std::clamp(std::lround(255 * encoded + noise), 0L, 255L));
}

/// A photograph of the board under a lamp that lights its one side by half more than the other, the paper yellowish;
/// times the camera's response, in linear light, with blur and noise.
Image photograph(const RigCamera& camera, const Eigen::Isometry3d& world_from_board, const Eigen::Array3d& response,
                 double brightness, uint32_t seed) {
  constexpr int samples = 3;          // squared, of a pixel
  constexpr double footprint_px = 2;  // what a pixel gathers light from
  const Eigen::Array3d paper(1.0, 0.95, 0.8);
  const BoardPattern pattern(board);
  const Eigen::Isometry3d board_from_camera = (camera.camera_from_world * world_from_board).inverse();
  const Eigen::Vector3d eye = board_from_camera.translation();
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, 1.5);
  constexpr double margin_m = 0.02;
  Eigen::AlignedBox2d box;  // of the board in the picture
  for (const double x : {-margin_m, pattern.width_m() + margin_m})
    for (const double y : {-margin_m, pattern.height_m() + margin_m})
      box.extend(project(camera, world_from_board * Eigen::Vector3d(x, y, 0)).value());
  box = Eigen::AlignedBox2d(box.min().array() - footprint_px, box.max().array() + footprint_px);
  const double wall = 0.2 * brightness;
  Image image(camera.intrinsics.width, camera.intrinsics.height, 3);
  for (int c = 0; c < 3; ++c) {
    const uint8_t wall_value = value_of(wall * paper[c] * response[c], 0);
    for (int y = 0; y < image.height; ++y)
      for (int x = 0; x < image.width; ++x)
        image.at(x, y, c) = static_cast<uint8_t>(std::lround(wall_value + noise(random)));
  }
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      if (!box.contains(Eigen::Vector2d(x, y))) continue;
      double light = 0;
      for (int s = 0; s < samples * samples; ++s) {
        const Eigen::Vector2d offset((s % samples + 0.5) / samples - 0.5, (s / samples + 0.5) / samples - 0.5);
        const Eigen::Vector2d pixel = Eigen::Vector2d(x, y) + footprint_px * offset;
        const Eigen::Vector3d ray = board_from_camera.linear() * unproject(camera.intrinsics, pixel);
        const Eigen::Vector3d p = eye - eye.z() / ray.z() * ray;
        const bool on_board = p.x() > -margin_m && p.y() > -margin_m && p.x() < pattern.width_m() + margin_m &&
                              p.y() < pattern.height_m() + margin_m;
        const double shade = brightness * (1 + 0.5 * p.x() / pattern.width_m());
        light += !on_board ? wall : (pattern.white(p.x(), p.y()) ? 1.0 : 0.04) * shade;
      }
      for (int c = 0; c < 3; ++c)
        image.at(x, y, c) = value_of(light / (samples * samples) * paper[c] * response[c], noise(random));
    }
  return image;
}

Image grey_of(const Image& image) {
  Image grey(image.width, image.height, 1);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) grey.at(x, y) = image.at(x, y, 1);
  return grey;
}

std::vector<std::string> ids_of(const Rig& rig) {
  std::vector<std::string> ids;
  for (const RigCamera& camera : rig.cameras) ids.push_back(camera.id);
  return ids;
}

/// Four cameras of known responses, the last one grey, and the board in three places.
class MatchedColours : public testing::Test {
 protected:
  static constexpr size_t grey_camera = 3;

  static void SetUpTestSuite() {
    const auto places = synthetic::tilted_places(board, 3);
    for (size_t pose = 0; pose < places.size(); ++pose)
      for (size_t c = 0; c < rig().cameras.size(); ++c) {
        Image image =
            photograph(rig().cameras[c], places[pose], responses()[c], 0.45, static_cast<uint32_t>(10 * pose + c));
        if (c == grey_camera) image = grey_of(image);
        auto view = find_board(rig().cameras[c].id, static_cast<int>(pose), image, board);
        ASSERT_TRUE(view);
        const auto found = sample_whites(*view, image, board);
        samples().insert(samples().end(), found.begin(), found.end());
        views().push_back(std::move(*view));
      }
  }
  static void TearDownTestSuite() {
    samples().clear();
    views().clear();
  }

  static const Rig& rig() {
    static const Rig made = fine_rig();
    return made;
  }
  /// What the sensors make of light.
  static const std::vector<Eigen::Array3d>& responses() {
    static const std::vector<Eigen::Array3d> made{{1.25, 1.0, 0.8}, {0.8, 0.9, 1.1}, {1.0, 1.2, 1.15}, {0.9, 0.9, 0.9}};
    return made;
  }
  static std::vector<WhiteSample>& samples() {
    static std::vector<WhiteSample> made;
    return made;
  }
  static std::vector<BoardView>& views() {
    static std::vector<BoardView> made;
    return made;
  }
  /// The responses of the colour cameras about their geometric mean, inverted.
  static Eigen::Array3d wanted_gain(size_t camera) {
    Eigen::Array3d product = Eigen::Array3d::Ones();
    for (size_t c = 0; c < grey_camera; ++c) product *= responses()[c];
    return product.pow(1.0 / 3) / responses()[camera];
  }
};

TEST_F(MatchedColours, IsFoundWithinOnePercent) {
  const auto matched = match_colours(ids_of(rig()), samples());
  EXPECT_THAT(matched.messages, IsEmpty());
  ASSERT_EQ(matched.cameras.size(), 4U);
  Eigen::Array3d product = Eigen::Array3d::Ones();
  for (size_t c = 0; c < grey_camera; ++c) {
    const CameraColour& camera = matched.cameras[c];
    EXPECT_TRUE(camera.matched);
    EXPECT_GE(camera.samples, 20) << "of 45 white squares";
    EXPECT_LT((camera.gain.cast<double>() / wanted_gain(c) - 1).abs().maxCoeff(), 0.01) << camera.gain.transpose();
    EXPECT_GT(camera.before, 0.05);
    EXPECT_LT(camera.after, 0.01);
    product *= camera.gain.cast<double>();
  }
  EXPECT_LT((product - 1).abs().maxCoeff(), 1e-5);
  EXPECT_GT(matched.before, 10 * matched.after);
  RecordProperty("before_percent", std::to_string(100 * matched.before));
  RecordProperty("after_percent", std::to_string(100 * matched.after));
}

TEST_F(MatchedColours, OfAGreyCameraIsTheSameInAllChannels) {
  const auto matched = match_colours(ids_of(rig()), samples());
  const Eigen::Array3f gain = matched.cameras[grey_camera].gain;
  EXPECT_TRUE(matched.cameras[grey_camera].matched);
  EXPECT_EQ(gain[0], gain[1]);
  EXPECT_EQ(gain[1], gain[2]);
  // It saw the paper's green: so much darker or brighter than each colour in the mean of the other cameras.
  const Eigen::Array3d paper(1.0, 0.95, 0.8);
  const Eigen::Array3d each = wanted_gain(grey_camera) * paper / paper[1];
  EXPECT_NEAR(static_cast<double>(gain[0]), std::cbrt(each.prod()), 0.01);
}

TEST_F(MatchedColours, DoesNotDependOnTheOrder) {
  auto turned = samples();
  std::reverse(turned.begin(), turned.end());
  auto ids = ids_of(rig());
  const auto one = match_colours(ids, samples());
  std::reverse(ids.begin(), ids.end());
  const auto other = match_colours(ids, turned);
  for (size_t c = 0; c < ids.size(); ++c) {
    EXPECT_EQ(other.cameras[c].id, one.cameras[ids.size() - 1 - c].id);
    EXPECT_TRUE((other.cameras[c].gain == one.cameras[ids.size() - 1 - c].gain).all());
  }
  EXPECT_EQ(one.after, other.after);
}

TEST_F(MatchedColours, IsNotLedAstrayByHighlights) {
  auto shining = samples();
  int highlights = 0;
  for (WhiteSample& sample : shining)
    if (sample.camera == "b1" && sample.square % 4 == 1) sample.light = (sample.light * 1.6F).min(1.0F), ++highlights;
  ASSERT_GE(highlights, 5);
  const auto matched = match_colours(ids_of(rig()), shining);
  for (size_t c = 0; c < grey_camera; ++c)
    EXPECT_LT((matched.cameras[c].gain.cast<double>() / wanted_gain(c) - 1).abs().maxCoeff(), 0.02)
        << matched.cameras[c].gain.transpose();
}

TEST_F(MatchedColours, OfCamerasThatShareNoPoseIsOneAndTheyAreNamed) {
  auto apart = samples();
  std::erase_if(apart, [](const WhiteSample& sample) { return (sample.camera == "b2") != (sample.pose == 2); });
  const auto matched = match_colours(ids_of(rig()), apart);
  EXPECT_THAT(matched.messages, Contains(testing::AllOf(HasSubstr("share no"), testing::EndsWith(": b2"))));
  EXPECT_FALSE(matched.cameras[2].matched);
  EXPECT_TRUE((matched.cameras[2].gain == 1).all());
  EXPECT_TRUE(matched.cameras[0].matched && matched.cameras[1].matched && matched.cameras[3].matched);
  EXPECT_LT((matched.cameras[0].gain / matched.cameras[1].gain - (wanted_gain(0) / wanted_gain(1)).cast<float>())
                .abs()
                .maxCoeff(),
            0.02F);

  const auto none = match_colours(ids_of(rig()), {});
  EXPECT_THAT(none.messages, Contains(testing::EndsWith(": b0, b1, b2, b3")));
}

TEST_F(MatchedColours, OfAnOverexposedCameraIsNotGuessed) {
  const Image image = photograph(rig().cameras[1], synthetic::tilted_places(board, 3)[0], {2.5, 2.5, 2.5}, 0.45, 5);
  const auto view = find_board("b1", 0, image, board);
  ASSERT_TRUE(view);
  auto overexposed = samples();
  std::erase_if(overexposed, [](const WhiteSample& sample) { return sample.camera == "b1"; });
  const auto found = sample_whites(*view, image, board);
  ASSERT_FALSE(found.empty());
  overexposed.insert(overexposed.end(), found.begin(), found.end());
  const auto matched = match_colours(ids_of(rig()), overexposed);
  EXPECT_GT(matched.cameras[1].clipped, matched.cameras[1].samples);
  EXPECT_THAT(matched.messages, Contains(StartsWith("b1: the board's white is overexposed in ")));
  EXPECT_FALSE(matched.cameras[1].matched);
}

TEST_F(MatchedColours, OutsideTheRigsRangeIsRefused) {
  auto dark = samples();
  for (WhiteSample& sample : dark)
    if (sample.camera == "b1") sample.light *= 1e-3F;
  const auto matched = match_colours(ids_of(rig()), dark);
  EXPECT_THAT(matched.messages, Contains(StartsWith("b1: the board's white is more than ten times")));
  EXPECT_TRUE((matched.cameras[1].gain == 1).all());
}

TEST_F(MatchedColours, GoesIntoTheRigAndTheReport) {
  CalibrationInput input;
  input.devices = calibration_devices(rig());
  input.board = board;
  input.views = views();
  input.previous = rig();
  input.whites = samples();
  const auto solved = solve_calibration(input, {.refine_corners = false});
  ASSERT_TRUE(solved) << solved.error().message;
  const auto matched = match_colours(ids_of(rig()), samples());
  ASSERT_EQ(solved->rig.cameras.size(), 4U);
  for (size_t c = 0; c < 4; ++c)
    EXPECT_TRUE((solved->rig.find(matched.cameras[c].id)->colour_gain == matched.cameras[c].gain).all());
  const std::string page = calibration_report_html(*solved, input);
  EXPECT_THAT(page, HasSubstr("<h2>Colours</h2>"));
  EXPECT_THAT(page, HasSubstr("% before and"));

  input.whites.clear();
  const auto without = solve_calibration(input, {.refine_corners = false});
  ASSERT_TRUE(without);
  EXPECT_TRUE((without->rig.cameras[0].colour_gain == 1).all());
  EXPECT_EQ(calibration_report_html(*without, input).find("Colours"), std::string::npos);
}

TEST(SampleWhites, TakesNothingThatTheBlackReaches) {
  const Rig rig = fine_rig();
  const Image image = photograph(rig.cameras[1], synthetic::tilted_places(board, 1)[0], {1, 1, 1}, 0.4, 3);
  auto view = find_board("b1", 0, image, board);
  ASSERT_TRUE(view);
  const auto samples = sample_whites(*view, image, board);
  ASSERT_GE(samples.size(), 6U);
  for (const WhiteSample& sample : samples) {
    EXPECT_FALSE(sample.clipped);
    const double x = sample.square % board.squares_x + 0.5;
    const double wanted = 0.4 * (1 + 0.5 * x / board.squares_x);
    EXPECT_NEAR(static_cast<double>(sample.light[0]), wanted, 0.02 * wanted) << sample.square;
    EXPECT_NEAR(static_cast<double>(sample.light[2]), 0.8 * wanted, 0.02 * wanted) << sample.square;
  }
  view->blur_px = 100;  // then the black reaches everywhere
  EXPECT_THAT(sample_whites(*view, image, board), IsEmpty());
  view->corners.clear();
  EXPECT_THAT(sample_whites(*view, image, board), IsEmpty());
}

}  // namespace
}  // namespace booth
