#include "pipeline/surface/smoothing.h"

#include <gtest/gtest.h>

#include <numbers>
#include <random>

#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

constexpr double radius_m = 0.2;
const Eigen::Vector3f center(0, static_cast<float>(radius_m), 0);

/// A ball whose vertices are moved along their radius by up to that much.
Mesh rough_sphere(double noise_m) {
  Mesh mesh = extract_surface(synthetic::sample_field(synthetic::sphere(radius_m), 0.01));
  std::mt19937 random(5);
  std::uniform_real_distribution<double> noise(-noise_m, noise_m);
  for (Eigen::Vector3f& p : mesh.positions) p += (p - center).normalized() * static_cast<float>(noise(random));
  return mesh;
}

double roughness_m(const Mesh& mesh) {
  double sum = 0;
  for (const Eigen::Vector3f& p : mesh.positions) {
    const double off = static_cast<double>((p - center).norm()) - radius_m;
    sum += off * off;
  }
  return std::sqrt(sum / static_cast<double>(mesh.positions.size()));
}

TEST(HcSmoothing, RemovesNoiseAndKeepsTheVolume) {
  const Mesh rough = rough_sphere(0.002);
  const Mesh smooth = smooth_hc(rough, {.iterations = 10});
  EXPECT_EQ(smooth.triangles, rough.triangles);
  EXPECT_LT(roughness_m(smooth), 0.5 * roughness_m(rough));
  const double volume = topology(rough).signed_volume_m3;
  EXPECT_NEAR(topology(smooth).signed_volume_m3, volume, 0.003 * volume);
}

TEST(HcSmoothing, ShrinksLessThanTheLaplacianThatItCorrects) {
  const Mesh rough = rough_sphere(0);
  const double volume = topology(rough).signed_volume_m3;
  // With beta = 1 a vertex is pushed back by all it was moved: nothing changes. The plain Laplacian pushes nothing
  // back.
  Mesh plain = rough;
  constexpr int iterations = 20;
  for (int i = 0; i < iterations; ++i) {
    std::vector<Eigen::Vector3f> sum(plain.positions.size(), Eigen::Vector3f::Zero());
    std::vector<float> count(plain.positions.size(), 0);
    for (const auto& [a, b, c] : plain.triangles)
      for (const auto& [v, other] : {std::pair{a, b}, std::pair{b, c}, std::pair{c, a}}) {
        sum[v] += plain.positions[other];
        ++count[v];
      }
    for (size_t v = 0; v < sum.size(); ++v) plain.positions[v] = sum[v] / count[v];
  }
  const Mesh corrected = smooth_hc(rough, {.iterations = iterations});
  const double lost_plain = volume - topology(plain).signed_volume_m3;
  const double lost_corrected = std::abs(volume - topology(corrected).signed_volume_m3);
  EXPECT_GT(lost_plain, 0.02 * volume);
  EXPECT_LT(lost_corrected, 0.1 * lost_plain);
}

TEST(HcSmoothing, FullCorrectionChangesNothing) {
  const Mesh rough = rough_sphere(0.002);
  const Mesh same = smooth_hc(rough, {.iterations = 4, .alpha = 0, .beta = 1});
  for (size_t v = 0; v < rough.positions.size(); ++v) EXPECT_LT((same.positions[v] - rough.positions[v]).norm(), 1e-6F);
}

TEST(HcSmoothing, WithoutIterationsOrTrianglesTheMeshStays) {
  const Mesh rough = rough_sphere(0.002);
  EXPECT_EQ(smooth_hc(rough, {.iterations = 0}).positions, rough.positions);
  EXPECT_TRUE(smooth_hc({}, {}).positions.empty());
  const Mesh lonely{{Eigen::Vector3f(1, 2, 3)}, {}};
  EXPECT_EQ(smooth_hc(lonely, {}).positions, lonely.positions);
}

TEST(HcSmoothing, ThreadsDoNotChangeTheResult) {
  const Mesh rough = rough_sphere(0.002);
  ThreadPool pool(8);
  EXPECT_EQ(smooth_hc(rough, {}).positions, smooth_hc(rough, {}, pool.work()).positions);
}

}  // namespace
}  // namespace booth
