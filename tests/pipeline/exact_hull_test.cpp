// The visual hull of balls and capsules against the exact one, whose surface is known by formula: a point is outside
// as soon as one camera's ray through it passes every capsule.

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <ostream>
#include <string>
#include <vector>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/hull/visual_hull.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

/// A ray's closest approach to a capsule of one radius: how far it passes the surface, and where along the ray.
struct Approach {
  double passes_by_m, along_m;
};

Approach approach(const synthetic::Capsule& capsule, const Eigen::Vector3d& from, const Eigen::Vector3d& direction) {
  const Eigen::Vector3d axis = capsule.to - capsule.from, to_from = from - capsule.from;
  const double length2 = axis.squaredNorm(), across = axis.dot(direction);
  const double determinant = length2 - across * across;
  double share = 0;
  if (determinant > 1e-12) share = (axis.dot(to_from) - across * direction.dot(to_from)) / determinant;
  share = std::clamp(share, 0.0, 1.0);
  const Eigen::Vector3d nearest = capsule.from + share * axis;
  const double along_m = direction.dot(nearest - from);
  return {(from + along_m * direction - nearest).norm() - capsule.from_radius_m, along_m};
}

/// By how much a camera's ray passes the body's surface where it does by least, seen at one metre; negative through it.
struct Miss {
  double at_one_metre = std::numeric_limits<double>::infinity();
  size_t capsule = 0;
};

Miss miss(const synthetic::Body& body, const Eigen::Vector3d& from, const Eigen::Vector3d& direction) {
  Miss least;
  for (size_t n = 0; n < body.size(); ++n) {
    const Approach found = approach(body[n], from, direction);
    if (found.passes_by_m / found.along_m < least.at_one_metre) least = {found.passes_by_m / found.along_m, n};
  }
  return least;
}

Silhouette exact_silhouette(const synthetic::Body& body, const RigCamera& camera) {
  const Intrinsics& k = camera.intrinsics;
  Silhouette silhouette{camera.id, Image(k.width, k.height, 1)};
  const Eigen::Vector3d center = camera.center();
  for (int y = 0; y < k.height; ++y)
    for (int x = 0; x < k.width; ++x) {
      const double outside_px = k.fx * miss(body, center, world_ray(camera, {x, y})).at_one_metre;
      silhouette.coverage.at(x, y) = static_cast<uint8_t>(std::lround(255 * std::clamp(0.5 - outside_px, 0.0, 1.0)));
    }
  return silhouette;
}

/// The exact hull at a point: its distance, right in the first order beside the surface, and who decides it.
struct ExactDistance {
  double m = -std::numeric_limits<double>::infinity();
  size_t camera = 0, capsule = 0;
};

ExactDistance exact_distance(const synthetic::Body& body, const Rig& rig, const Eigen::Vector3d& p) {
  ExactDistance farthest;
  for (size_t c = 0; c < rig.cameras.size(); ++c) {
    const Eigen::Vector3d center = rig.cameras[c].center(), to_p = p - center;
    const Miss found = miss(body, center, to_p.normalized());
    const double distance_m = found.at_one_metre * to_p.norm();
    if (distance_m > farthest.m) farthest = {distance_m, c, found.capsule};
  }
  return farthest;
}

/// Whether somebody else decides within a voxel of the point: the surface has a crease there.
bool is_at_crease(const synthetic::Body& body, const Rig& rig, const Eigen::Vector3d& p, const ExactDistance& at_p,
                  double voxel_m) {
  for (int axis = 0; axis < 3; ++axis)
    for (const double side : {-voxel_m, voxel_m}) {
      const ExactDistance beside = exact_distance(body, rig, p + side * Eigen::Vector3d::Unit(axis));
      if (beside.camera != at_p.camera || beside.capsule != at_p.capsule) return true;
    }
  return false;
}

struct Case {
  const char* name;
  synthetic::Body body;
};
void PrintTo(const Case& tried, std::ostream* out) { *out << tried.name; }

synthetic::Capsule capsule(const Eigen::Vector3d& from, const Eigen::Vector3d& to, double radius_m) {
  return {from, to, radius_m, radius_m};
}

class ExactHull : public testing::TestWithParam<Case> {};

TEST_P(ExactHull, IsMetToATwentiethOfAVoxel) {
  // A pixel is as large as a voxel: sub-voxel exactness takes sub-pixel outlines.
  const Rig rig = synthetic::ring_rig({.cameras = 10, .width = 480, .height = 640});
  constexpr double voxel_m = 0.005;
  std::vector<Silhouette> silhouettes;
  for (const RigCamera& camera : rig.cameras) silhouettes.push_back(exact_silhouette(GetParam().body, camera));
  ThreadPool pool;
  const auto hull = carve_visual_hull(rig, silhouettes, {.voxel_m = voxel_m}, pool.work());
  ASSERT_TRUE(hull.ok()) << hull.error().message;
  const Mesh mesh = extract_surface(hull->field);
  double sum_m = 0, signed_sum_m = 0;
  size_t measured = 0;
  for (const Eigen::Vector3f& p : mesh.positions) {
    const ExactDistance exact = exact_distance(GetParam().body, rig, p.cast<double>());
    if (is_at_crease(GetParam().body, rig, p.cast<double>(), exact, voxel_m)) continue;
    sum_m += std::abs(exact.m);
    signed_sum_m += exact.m;
    ++measured;
  }
  ASSERT_GT(measured, mesh.positions.size() / 2) << "too little lies away from creases";
  const double mean_voxels = sum_m / static_cast<double>(measured) / voxel_m;
  RecordProperty("mean_error_voxels", std::to_string(mean_voxels));
  EXPECT_LE(mean_voxels, 0.05);
  EXPECT_LE(std::abs(signed_sum_m) / static_cast<double>(measured) / voxel_m, 0.03) << "too large or too small";
}

INSTANTIATE_TEST_SUITE_P(
    Bodies, ExactHull,
    testing::Values(Case{"ball", synthetic::sphere(0.35)},
                    Case{"capsule", {capsule({-0.25, 0.5, 0.1}, {0.3, 1.4, -0.1}, 0.2)}},
                    Case{"capsules",
                         {capsule({0, 0.3, 0}, {0, 1.3, 0}, 0.18), capsule({0, 1.3, 0}, {0.5, 0.9, 0}, 0.08),
                          capsule({0, 1.3, 0}, {-0.5, 0.9, 0.1}, 0.08), capsule({0, 1.7, 0}, {0, 1.7, 0}, 0.15)}}),
    [](const auto& tried) { return tried.param.name; });

}  // namespace
}  // namespace booth
