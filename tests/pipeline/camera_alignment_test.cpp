#include "pipeline/hull/camera_alignment.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "pipeline/geometry/camera_model.h"
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
    Capture made{synthetic::ring_rig({.cameras = 9, .width = 300, .height = 400}), {}};
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

/// Where a camera sees a point beside the subject's middle.
Eigen::Vector2d seen_point(const CalibratedView& camera) {
  return project(camera, Eigen::Vector3d(0.1, 1.2, 0)).value();
}

TEST(CameraAlignment, MeasuresHowFarACameraIsOff) {
  const Eigen::Vector2d off_px(2.0, -1.5);
  constexpr size_t moved = 4;
  Capture capture = with_moved_camera(moved, off_px);
  SilhouetteViews views;
  for (size_t i = 0; i < capture.silhouettes.size(); ++i)
    views.push_back(std::make_unique<SilhouetteView>(capture.rig.cameras[i], capture.silhouettes[i].coverage));
  const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
  ASSERT_TRUE(hull.ok());
  const auto deviations = realign_cameras(capture.rig, views, hull->field);
  ASSERT_EQ(deviations.size(), views.size());
  for (size_t v = 0; v < views.size(); ++v) EXPECT_EQ(deviations[v].moved, v == moved) << v;
  EXPECT_LT((seen_point(capture.rig.cameras[moved]) - seen_point(exact_capture().rig.cameras[moved])).norm(), 1.0);
  EXPECT_GT(deviations[moved].offset_px, 0.8);
}

TEST(CameraAlignment, ACameraThatWasTurnedOrCarriedIsPutBack) {
  constexpr double turn_rad = 0.01, carry_m = 0.03;  // three pixels and more of these small pictures
  for (int axis = 0; axis < 5; ++axis) {
    Capture capture = exact_capture();
    constexpr size_t moved = 3;
    Eigen::Isometry3d motion = Eigen::Isometry3d::Identity();
    if (axis < 3)
      motion.linear() = Eigen::AngleAxisd(turn_rad, Eigen::Vector3d::Unit(axis)).toRotationMatrix();
    else
      motion.translation() = carry_m * Eigen::Vector3d::Unit(axis - 3);
    Eigen::Isometry3d& pose = capture.rig.cameras[moved].camera_from_world;
    pose = motion * pose;
    const auto hull = carve_visual_hull(capture.rig, capture.silhouettes, coarse);
    ASSERT_TRUE(hull.ok());
    for (size_t i = 0; i < hull->agreement.size(); ++i)
      EXPECT_EQ(hull->agreement[i].moved, i == moved) << axis << " " << i << ": " << hull->agreement[i].deviation;
    const double off_px =
        (seen_point(hull->rig->cameras[moved]) - seen_point(exact_capture().rig.cameras[moved])).norm();
    EXPECT_LT(off_px, 1.2) << axis;
  }
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
      const Eigen::Vector2d found = seen_point(hull->rig->cameras[other]);
      EXPECT_LT((found - seen_point(exact_capture().rig.cameras[other])).norm(), 1.2) << camera << " " << other;
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
      EXPECT_TRUE(hull->rig->cameras[i].camera_from_world.isApprox(capture.rig.cameras[i].camera_from_world, 0));
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
