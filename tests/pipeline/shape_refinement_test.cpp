#include "pipeline/refine/shape_refinement.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "pipeline/hull/visual_hull.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

struct Errors {
  double mean_m = 0, bias_m = 0, p95_m = 0;
};

Errors errors_of(const Field& field, const synthetic::Body& body) {
  std::vector<double> distances;
  double sum = 0;
  for (const Eigen::Vector3f& p : extract_surface(field).positions) {
    const double distance = synthetic::signed_distance(body, p.cast<double>());
    sum += distance;
    distances.push_back(std::abs(distance));
  }
  std::sort(distances.begin(), distances.end());
  const auto count = static_cast<double>(distances.size());
  return {std::accumulate(distances.begin(), distances.end(), 0.0) / count, sum / count,
          distances[distances.size() * 95 / 100]};
}

constexpr double voxel_m = 0.008;

struct Scene {
  synthetic::Body body = synthetic::person().body;
  Rig rig;
  std::vector<Silhouette> silhouettes;
  VisualHull hull;

  explicit Scene(int cameras, synthetic::Body subject = synthetic::person().body) : body(std::move(subject)) {
    rig = synthetic::ring_rig({.cameras = cameras});
    silhouettes = synthetic::render_silhouettes(body, rig, 2);
    hull = carve_visual_hull(rig, silhouettes, {.voxel_m = voxel_m}).value();
  }
  Field refined(const Work& work = {}) const { return refine_shape(hull.field, hull.views, {}, {}, work); }
};

bool same(const Field& a, const Field& b) {
  const auto& size = a.grid().size;
  if (size != b.grid().size) return false;
  for (int k = 0; k < size[2]; ++k)
    for (int j = 0; j < size[1]; ++j)
      for (int i = 0; i < size[0]; ++i)
        if (a.at(i, j, k) != b.at(i, j, k)) return false;
  return true;
}

class ShapeRefinementByCameras : public testing::TestWithParam<int> {};

TEST_P(ShapeRefinementByCameras, IsCloserToThePersonThanTheHull) {
  const Scene scene(GetParam());
  const Errors hull = errors_of(scene.hull.field, scene.body), refined = errors_of(scene.refined(), scene.body);
  EXPECT_LT(refined.mean_m, hull.mean_m);
  EXPECT_LT(refined.p95_m, hull.p95_m);
  EXPECT_LT(std::abs(refined.bias_m), hull.bias_m);
}

TEST_P(ShapeRefinementByCameras, NeverLeavesTheHull) {
  const Scene scene(GetParam());
  const Field refined = scene.refined();
  const auto& size = refined.grid().size;
  for (int k = 0; k < size[2]; ++k)
    for (int j = 0; j < size[1]; ++j)
      for (int i = 0; i < size[0]; ++i)
        ASSERT_FALSE(refined.at(i, j, k) < 0 && scene.hull.field.at(i, j, k) >= 0) << i << ' ' << j << ' ' << k;
}

INSTANTIATE_TEST_SUITE_P(Rings, ShapeRefinementByCameras, testing::Values(4, 6, 8, 14));

TEST(ShapeRefinement, ChangesABallThatManyCamerasSeeByLessThanATenthOfAVoxel) {
  const Scene scene(14, synthetic::sphere(0.3));
  EXPECT_LT(errors_of(scene.refined(), scene.body).mean_m,
            errors_of(scene.hull.field, scene.body).mean_m + 0.1 * voxel_m);
  const MeshTopology shape = topology(extract_surface(scene.refined()));
  EXPECT_TRUE(shape.closed_manifold());
  EXPECT_EQ(shape.euler_number, 2);
}

TEST(ShapeRefinement, ReturnsTheHullWhenDisabled) {
  const Scene scene(4);
  EXPECT_TRUE(same(refine_shape(scene.hull.field, scene.hull.views, {}, {.enabled = false}), scene.hull.field));
}

TEST(ShapeRefinement, IsTheSameWithAnyThreadsAndOrderOfCameras) {
  Scene scene(6);
  const Field serial = scene.refined();
  ThreadPool pool(3);
  EXPECT_TRUE(same(serial, scene.refined(pool.work())));
  std::reverse(scene.hull.views.begin(), scene.hull.views.end());
  EXPECT_TRUE(same(serial, scene.refined()));
}

TEST(ShapeRefinement, TakesAnEmptyField) { EXPECT_EQ(refine_shape(Field(), {}, {}, {}).blocks(), 0U); }

}  // namespace
}  // namespace booth
