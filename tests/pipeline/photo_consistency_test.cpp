#include "pipeline/refine/photo_consistency.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <random>

#include "pipeline/hull/visual_hull.h"
#include "pipeline/refine/shape_refinement.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

/// A wall between two columns: no silhouette shows how far it lies behind them.
synthetic::Body columns() {
  const auto upright = [](double x, double radius_m) {
    return synthetic::Capsule{{x, 0.4, 0}, {x, 1.1, 0}, radius_m, radius_m};
  };
  synthetic::Body body{upright(-0.17, 0.1), upright(0.17, 0.1)};
  for (int i = -3; i <= 3; ++i) body.push_back(upright(0.04 * i, 0.08));
  return body;
}

Eigen::Vector3d plain_at(const Eigen::Vector3d& /*p*/) { return {0.4, 0.3, 0.6}; }

struct Scene {
  synthetic::Body body = columns();
  Rig rig = synthetic::ring_rig({.cameras = 8, .width = 360, .height = 480});
  VisualHull hull;
  std::vector<Frame> frames;

  explicit Scene(const synthetic::Paint& paint) {
    const auto silhouettes = synthetic::render_silhouettes(body, rig, 2);
    hull = carve_visual_hull(rig, silhouettes, {.voxel_m = 0.008}).value();
    for (const RigCamera& camera : rig.cameras) frames.push_back(synthetic::render_photograph(body, camera, 1, paint));
  }
  Field refined(const std::vector<Frame>& photographs, const Work& work = {}) const {
    return refine_shape(hull.field, hull.views, photographs, {}, work);
  }
};

const Scene& cloth() {
  static const Scene scene(synthetic::cloth_at);
  return scene;
}

struct Errors {
  double mean_m = 0, p95_m = 0;
};

/// Of the columns' sides; cameras see their ends slanting.
Errors errors_of(const Field& field, const synthetic::Body& body) {
  std::vector<double> distances;
  for (const Eigen::Vector3f& p : extract_surface(field).positions)
    if (p.y() > 0.45F && p.y() < 1.05F)
      distances.push_back(std::abs(synthetic::signed_distance(body, p.cast<double>())));
  std::sort(distances.begin(), distances.end());
  Errors errors;
  for (const double distance : distances) errors.mean_m += distance / static_cast<double>(distances.size());
  errors.p95_m = distances[distances.size() * 95 / 100];
  return errors;
}

bool same(const Field& a, const Field& b) {
  const Mesh of_a = extract_surface(a), of_b = extract_surface(b);
  return of_a.positions == of_b.positions && of_a.triangles == of_b.triangles;
}

TEST(PhotoConsistency, FindsHollowsThatNoSilhouetteShows) {
  const Errors without = errors_of(cloth().refined({}), cloth().body);
  const Errors with = errors_of(cloth().refined(cloth().frames), cloth().body);
  EXPECT_LT(with.mean_m, 0.5 * without.mean_m) << without.mean_m;
  EXPECT_LT(with.p95_m, 0.5 * without.p95_m) << without.p95_m;
}

TEST(PhotoConsistency, DoesNotCareHowBrightEachPictureIs) {
  std::vector<Frame> uneven = cloth().frames;
  for (size_t i = 0; i < uneven.size(); ++i) {
    auto image = std::make_shared<Image>(*uneven[i].pixels);
    const double gain = 0.6 + 0.05 * static_cast<double>(i);
    for (uint8_t& sample : image->samples) sample = static_cast<uint8_t>(std::lround(gain * sample + 10));
    uneven[i].pixels = std::move(image);
  }
  EXPECT_NEAR(errors_of(cloth().refined(uneven), cloth().body).mean_m,
              errors_of(cloth().refined(cloth().frames), cloth().body).mean_m, 0.0003);
}

TEST(PhotoConsistency, ReadsGreyPictures) {
  std::vector<Frame> grey = cloth().frames;
  for (Frame& frame : grey) {
    auto image = std::make_shared<Image>(frame.pixels->width, frame.pixels->height, 1);
    for (size_t i = 0; i < image->samples.size(); ++i) image->samples[i] = frame.pixels->samples[3 * i];
    frame.pixels = std::move(image);
  }
  EXPECT_NEAR(errors_of(cloth().refined(grey), cloth().body).mean_m,
              errors_of(cloth().refined(cloth().frames), cloth().body).mean_m, 0.0003);
}

TEST(PhotoConsistency, LeavesWhatHasNoTexture) {
  const Scene plain(plain_at);
  EXPECT_TRUE(same(plain.refined(plain.frames), plain.refined({})));
}

TEST(PhotoConsistency, IsNotMisledByPicturesOfNothing) {
  std::vector<Frame> noise = cloth().frames;
  std::minstd_rand random(7);
  for (Frame& frame : noise) {
    auto image = std::make_shared<Image>(*frame.pixels);
    for (uint8_t& sample : image->samples) sample = static_cast<uint8_t>(random() >> 8);
    frame.pixels = std::move(image);
  }
  EXPECT_LT(errors_of(cloth().refined(noise), cloth().body).mean_m,
            1.05 * errors_of(cloth().refined({}), cloth().body).mean_m);
}

TEST(PhotoConsistency, IgnoresPicturesOfAnotherSize) {
  std::vector<Frame> small = cloth().frames;
  for (Frame& frame : small) frame.pixels = std::make_shared<Image>(36, 48, 3);
  EXPECT_TRUE(same(cloth().refined(small), cloth().refined({})));
}

TEST(PhotoConsistency, StaysWithinTheHull) {
  const Field refined = cloth().refined(cloth().frames);
  const auto& size = refined.grid().size;
  for (int k = 0; k < size[2]; ++k)
    for (int j = 0; j < size[1]; ++j)
      for (int i = 0; i < size[0]; ++i)
        ASSERT_FALSE(refined.at(i, j, k) < 0 && cloth().hull.field.at(i, j, k) >= 0) << i << ' ' << j << ' ' << k;
  EXPECT_TRUE(topology(extract_surface(refined)).closed_manifold());
}

TEST(PhotoConsistency, IsTheSameWithAnyThreadsAndOrderOfPictures) {
  const Field serial = cloth().refined(cloth().frames);
  ThreadPool pool(3);
  std::vector<Frame> turned = cloth().frames;
  std::reverse(turned.begin(), turned.end());
  EXPECT_TRUE(same(serial, cloth().refined(turned, pool.work())));
}

}  // namespace
}  // namespace booth
