#include "pipeline/hull/camera_alignment.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "pipeline/hull/visual_hull.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;

constexpr VisualHullOptions coarse{.voxel_m = 0.016};

struct Capture {
  Rig rig;
  std::vector<Silhouette> silhouettes;
};

/// A person in a ring of nine cameras whose calibration is exact.
const Capture& exact_capture() {
  static const Capture capture = [] {
    Capture made{synthetic::ring_rig({.cameras = 9, .width = 150, .height = 200}), {}};
    made.silhouettes = synthetic::render_silhouettes(synthetic::person().body, made.rig);
    return made;
  }();
  return capture;
}

Capture with_moved_camera(size_t camera, const Eigen::Vector2d& by_px) {
  Capture capture = exact_capture();
  capture.rig.cameras[camera].intrinsics.cx += by_px.x();
  capture.rig.cameras[camera].intrinsics.cy += by_px.y();
  return capture;
}

TEST(CameraAlignment, MeasuresHowFarACameraIsOff) {
  const Eigen::Vector2d off_px(2.0, -1.5);
  constexpr size_t moved = 4;
  const Capture capture = with_moved_camera(moved, off_px);
  SilhouetteViews views;
  for (size_t i = 0; i < capture.silhouettes.size(); ++i)
    views.push_back(std::make_unique<SilhouetteView>(capture.rig.cameras[i], capture.silhouettes[i].coverage));
  const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
  ASSERT_TRUE(hull.ok());
  const auto offsets = measure_camera_offsets(views, hull->field);
  ASSERT_EQ(offsets.size(), views.size());
  EXPECT_LT((offsets[moved].shift_px + off_px).norm(), 1.0) << offsets[moved].shift_px.transpose();
  EXPECT_GT(offsets[moved].support, 50U);
}

TEST(CameraAlignment, AnyMovedCameraIsRealignedAndNamed) {
  for (size_t camera = 0; camera < exact_capture().rig.cameras.size(); camera += 2) {
    const double angle = 1.1 * static_cast<double>(camera);
    const Eigen::Vector2d off_px = 3 * Eigen::Vector2d(std::cos(angle), std::sin(angle));
    const Capture capture = with_moved_camera(camera, off_px);
    const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
    ASSERT_TRUE(hull.ok());
    EXPECT_THAT(hull->warnings, ElementsAre(HasSubstr(capture.rig.cameras[camera].id)));
    for (size_t other = 0; other < capture.rig.cameras.size(); ++other) {
      const Intrinsics& found = hull->rig->cameras[other].intrinsics;
      const Intrinsics& truth = exact_capture().rig.cameras[other].intrinsics;
      EXPECT_LT(std::hypot(found.cx - truth.cx, found.cy - truth.cy), 1.2) << camera << " " << other;
    }
  }
}

TEST(CameraAlignment, WellCalibratedCamerasStayWhereTheyAre) {
  Capture capture = exact_capture();
  for (const size_t cameras : {9U, 7U, 5U}) {
    capture.silhouettes.resize(cameras);
    const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
    ASSERT_TRUE(hull.ok());
    EXPECT_THAT(hull->warnings, IsEmpty()) << cameras;
    for (size_t i = 0; i < capture.rig.cameras.size(); ++i)
      EXPECT_EQ(hull->rig->cameras[i].intrinsics.cx, capture.rig.cameras[i].intrinsics.cx);
  }
}

TEST(CameraAlignment, AMissingLimbIsNotTakenForAMovedCamera) {
  Capture capture = exact_capture();
  Image& coverage = capture.silhouettes[2].coverage;
  for (int y = 3 * coverage.height / 4; y < coverage.height; ++y)
    std::fill_n(coverage.pixel(0, y), coverage.width / 2, uint8_t{0});
  const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
  ASSERT_TRUE(hull.ok());
  EXPECT_THAT(hull->warnings,
              ElementsAre(testing::AllOf(HasSubstr(capture.silhouettes[2].camera), HasSubstr("lacks a part"))));
}

TEST(CameraAlignment, WhatOneCameraAloneShowsIsReported) {
  Capture capture = exact_capture();
  Image& coverage = capture.silhouettes[5].coverage;
  for (int y = coverage.height / 3; y < coverage.height; ++y)
    std::fill_n(coverage.pixel(0, y), coverage.width / 8, uint8_t{255});
  const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
  ASSERT_TRUE(hull.ok());
  EXPECT_THAT(hull->warnings,
              ElementsAre(testing::AllOf(HasSubstr(capture.silhouettes[5].camera), HasSubstr("do not confirm"))));
}

TEST(CameraAlignment, GivesTheSameForAnyOrderOfCamerasAndNumberOfThreads) {
  Capture capture = with_moved_camera(1, {-2.5, 1.5});
  const auto first = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
  ASSERT_TRUE(first.ok());
  std::rotate(capture.silhouettes.begin(), capture.silhouettes.begin() + 4, capture.silhouettes.end());
  std::swap(capture.silhouettes[0], capture.silhouettes[2]);
  ThreadPool pool(3);
  const auto second = carve_visual_hull(capture.rig, capture.silhouettes, coarse, pool.work());
  ASSERT_TRUE(second.ok());
  EXPECT_EQ(first->warnings, second->warnings);
  ASSERT_EQ(first->field.blocks(), second->field.blocks());
  EXPECT_EQ(std::memcmp(first->field.block(0), second->field.block(0),
                        first->field.blocks() * Field::samples_per_brick * sizeof(float)),
            0);
}

}  // namespace
}  // namespace booth
