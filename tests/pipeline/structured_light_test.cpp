#include "pipeline/structured_light/structured_light.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/structured_light.h"

namespace booth {
namespace {

using ::testing::HasSubstr;

const Eigen::Vector3d target(0, 1.5, 0);
/// Two balls, one before the other: a smooth surface and a leap in depth.
const synthetic::Body balls{
    {target, target, 0.1, 0.1},
    {target + Eigen::Vector3d(0.05, 0.04, 0.08), target + Eigen::Vector3d(0.05, 0.04, 0.08), 0.04, 0.04}};

struct Errors {
  size_t points = 0;
  double median_m = 0, p95_m = 0, worst_m = 0;
};
Errors errors_of(const StructuredLightScan& scan, const Eigen::Vector3d& moved = Eigen::Vector3d::Zero()) {
  std::vector<double> off;
  for (size_t i = 0; i < scan.scan.points.size(); ++i)
    if (scan.scan.measured(i))
      off.push_back(std::abs(synthetic::signed_distance(balls, scan.scan.points[i].cast<double>() - moved)));
  std::sort(off.begin(), off.end());
  if (off.empty()) return {};
  return {off.size(), off[off.size() / 2], off[off.size() * 95 / 100], off.back()};
}

Result<StructuredLightScan> scan(const Rig& rig, const GrayCodeCapture& capture) {
  return scan_structured_light(rig, capture, {}, rig.volume);
}

const Rig& rig() {
  static const Rig made = synthetic::scanner_rig(target);
  return made;
}
const GrayCodeCapture& clean() {
  static const GrayCodeCapture made = synthetic::render_gray_code(balls, rig());
  return made;
}

/// Removes one image of every camera.
void remove(GrayCodeCapture* capture, int index) { capture->sets[static_cast<size_t>(index)].frames.clear(); }

TEST(StructuredLight, MeasuresTheSurfaceToAFractionOfAPixel) {
  const auto result = scan(rig(), clean());
  ASSERT_TRUE(result.ok()) << result.error().message;
  EXPECT_TRUE(result->warnings.empty());
  const Errors errors = errors_of(*result);
  // A projector pixel is 1.3 mm wide there, a camera's 0.7 mm.
  EXPECT_GT(errors.points, 12000U);
  EXPECT_LT(errors.median_m, 0.00012);
  EXPECT_LT(errors.p95_m, 0.0006);
}

TEST(StructuredLight, FindsTheProjectorCoordinateOfAPixel) {
  std::vector<Frame> frames;
  for (const FrameSet& set : clean().sets) frames.push_back(set.frames.front());
  const auto decoded = decode_gray_code(frames, clean().pattern);
  ASSERT_TRUE(decoded.ok());
  EXPECT_NEAR(decoded->blur_px, 0.68, 0.12);  // the projector's blur and its pixels' width
  EXPECT_NEAR(decoded->noise, 1.0, 0.3);
  const RigCamera& camera = *rig().find(decoded->camera);
  std::vector<double> off;
  for (int y = 0; y < decoded->position.height; ++y)
    for (int x = 0; x < decoded->position.width; ++x) {
      const Eigen::Vector2d found(decoded->position.at(x, y, 0), decoded->position.at(x, y, 1));
      if (!found.allFinite()) continue;
      // March along the pixel's ray to the surface.
      Eigen::Vector3d p = camera.center();
      for (int i = 0; i < 60; ++i) p += world_ray(camera, {x, y}) * synthetic::signed_distance(balls, p);
      if (std::abs(synthetic::signed_distance(balls, p)) > 1e-4) continue;
      off.push_back((*project(*rig().projector, p) - found).norm());
    }
  ASSERT_GT(off.size(), 10000U);
  std::sort(off.begin(), off.end());
  EXPECT_LT(off[off.size() / 2], 0.05);
  EXPECT_LT(off[off.size() * 95 / 100], 0.8);  // at outlines a pixel sees two surfaces
}

TEST(StructuredLight, CopesWithAmbientLightAndDarkSkin) {
  const auto bright = scan(rig(), synthetic::render_gray_code(balls, rig(), {.ambient = 100, .contrast = 100}));
  ASSERT_TRUE(bright.ok());
  EXPECT_LT(errors_of(*bright).median_m, 0.00015);
  const auto dark = scan(rig(), synthetic::render_gray_code(balls, rig(), {.contrast = 15, .noise = 1.5}));
  ASSERT_TRUE(dark.ok());
  EXPECT_GT(errors_of(*dark).points, 9000U);
  EXPECT_LT(errors_of(*dark).median_m, 0.0005);
}

TEST(StructuredLight, NeedsNotEveryImage) {
  GrayCodeCapture capture = clean();
  for (const int index : {1, 6, 15, 17, 20, 31, 32}) remove(&capture, index);  // one of a pair each, and the lit image
  const auto result = scan(rig(), capture);
  ASSERT_TRUE(result.ok()) << result.error().message;
  const Errors errors = errors_of(*result);
  EXPECT_GT(errors.points, 11000U);
  EXPECT_LT(errors.median_m, 0.0002);
}

TEST(StructuredLight, SaysWhichBitIsMissing) {
  GrayCodeCapture capture = clean();
  remove(&capture, 4);
  remove(&capture, 5);
  const auto result = scan(rig(), capture);
  ASSERT_FALSE(result.ok());
  EXPECT_EQ(result.error().code, ErrorCode::no_subject);
  EXPECT_THAT(result.error().message, HasSubstr("column bit 2"));
}

TEST(StructuredLight, FindsAnImageThatStandsTwice) {
  GrayCodeCapture capture = clean();
  // The projector did not step: the finest column bit's inverse shows the pattern again.
  for (size_t c = 0; c < 2; ++c) capture.sets[15].frames[c].pixels = capture.sets[14].frames[c].pixels;
  const auto result = scan(rig(), capture);
  ASSERT_TRUE(result.ok()) << result.error().message;
  ASSERT_FALSE(result->warnings.empty());
  EXPECT_THAT(result->warnings.front(), HasSubstr("column bit 7"));
  EXPECT_LT(errors_of(*result).median_m, 0.0005);
}

TEST(StructuredLight, TellsMovementAndRefusesTooMuch) {
  const Eigen::Vector3d sway(0.002, 0, 0);
  const GrayCodeCapture capture = synthetic::render_gray_code(balls, rig(), {.sway_m = sway});
  const auto swayed = scan(rig(), capture);
  ASSERT_TRUE(swayed.ok()) << swayed.error().message;
  EXPECT_NEAR(swayed->motion_m, 0.002, 0.001);
  EXPECT_LT(errors_of(*swayed, 0.5 * sway).median_m, 0.001);
  StructuredLightOptions strict;
  strict.most_motion_m = 0.0005;
  const auto moved = scan_structured_light(rig(), capture, {}, rig().volume, strict);
  ASSERT_FALSE(moved.ok());
  EXPECT_THAT(moved.error().message, HasSubstr("moved"));
}

TEST(StructuredLight, WorksWithoutCalibratedProjectorAndWithOneCamera) {
  Rig uncalibrated = rig();
  uncalibrated.projector.reset();
  const auto by_cameras = scan(uncalibrated, clean());
  ASSERT_TRUE(by_cameras.ok()) << by_cameras.error().message;
  EXPECT_LT(errors_of(*by_cameras).median_m, 0.0003);

  GrayCodeCapture one = clean();
  for (FrameSet& set : one.sets) set.frames.pop_back();
  const auto by_projector = scan(rig(), one);
  ASSERT_TRUE(by_projector.ok()) << by_projector.error().message;
  EXPECT_LT(errors_of(*by_projector).median_m, 0.0003);

  EXPECT_EQ(scan(uncalibrated, one).error().code, ErrorCode::too_few_views);
}

TEST(StructuredLight, RefusesWhatIsNoScan) {
  EXPECT_EQ(scan(rig(), {clean().pattern, {}}).error().code, ErrorCode::no_subject);
  const auto unlit = scan(rig(), synthetic::render_gray_code(balls, rig(), {.contrast = 0}));
  ASSERT_FALSE(unlit.ok());
  EXPECT_THAT(unlit.error().message, HasSubstr("lit"));
  GrayCodeCapture other = clean();
  other.pattern.width = 128;
  EXPECT_FALSE(scan(rig(), other).ok());
}

TEST(StructuredLight, DoesNotDependOnThreadsOrOrder) {
  ThreadPool pool(4);
  const auto serial = scan(rig(), clean());
  GrayCodeCapture turned = clean();
  for (FrameSet& set : turned.sets) std::reverse(set.frames.begin(), set.frames.end());
  std::reverse(turned.sets.begin(), turned.sets.end());
  const auto parallel = scan_structured_light(rig(), turned, {}, rig().volume, {}, pool.work());
  ASSERT_TRUE(serial.ok() && parallel.ok());
  for (size_t i = 0; i < serial->scan.points.size(); ++i) {
    ASSERT_EQ(serial->scan.measured(i), parallel->scan.measured(i));
    if (serial->scan.measured(i)) {
      ASSERT_EQ(serial->scan.points[i], parallel->scan.points[i]);
    }
  }
}

}  // namespace
}  // namespace booth
