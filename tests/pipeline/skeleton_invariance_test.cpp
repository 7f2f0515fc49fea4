// The skeleton depends on the body alone: not on how it stands, how large it is, how finely it is meshed, or on noise.

#include <gtest/gtest.h>

#include <cmath>
#include <map>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/skeleton/skeleton_fit.h"
#include "pipeline/surface/decimation.h"
#include "pipeline/surface/marching_cubes.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/people.h"

namespace booth {
namespace {

using Eigen::Vector3d;

using Places = std::map<std::string, Vector3d>;

Places joints_of(const Mesh& mesh) {
  Places places;
  const auto fitted = fit_skeleton(mesh, {});
  EXPECT_TRUE(fitted) << fitted.error().message;
  if (!fitted) return places;
  const auto world = world_from_joints(fitted->skeleton);
  for (size_t j = 0; j < world.size(); ++j) places[fitted->skeleton.joints[j].name] = world[j].translation();
  return places;
}

/// The body's surface with some 60,000 triangles.
Mesh finely_meshed(const synthetic::Body& body) {
  constexpr double voxel_m = 0.0095;
  return extract_surface(synthetic::sample_field(body, voxel_m));
}

struct Variation {
  Eigen::Affine3d moved = Eigen::Affine3d::Identity();
  double noise_m = 0;
};

Variation random_variation(std::mt19937& random) {
  const auto between = [&](double low, double high) { return std::uniform_real_distribution(low, high)(random); };
  constexpr double few_degrees = 0.09;
  Variation variation;
  variation.moved.linear() =
      between(0.6, 1.2) * (Eigen::AngleAxisd(between(-few_degrees, few_degrees), Vector3d::UnitX()) *
                           Eigen::AngleAxisd(between(-few_degrees, few_degrees), Vector3d::UnitY()) *
                           Eigen::AngleAxisd(between(-few_degrees, few_degrees), Vector3d::UnitZ()))
                              .toRotationMatrix();
  variation.moved.translation() = Vector3d(between(-0.2, 0.2), between(0, 0.1), between(-0.2, 0.2));
  variation.noise_m = between(0, 0.002);
  return variation;
}

/// By how much the worst joint leaves its place when the body is varied.
double worst_move(Mesh mesh, const Places& places, const Variation& variation, std::mt19937& random, std::string& who) {
  std::normal_distribution<double> noise(0, variation.noise_m + 1e-9);
  for (auto& p : mesh.positions)
    p = (variation.moved * p.cast<double>() + Vector3d(noise(random), noise(random), noise(random))).cast<float>();
  double worst = 0;
  for (const auto& [name, p] : joints_of(mesh)) {
    const double move = (p - variation.moved * places.at(name)).norm();
    if (move > worst) who = name;
    worst = std::max(worst, move);
  }
  return worst;
}

TEST(SkeletonInvariance, JointsMoveWithTheBodyAndBy10MmAtMostBesides) {
  const std::vector<std::pair<std::string, synthetic::Person>> people{
      {"A-pose", synthetic::person()},
      {"T-pose", synthetic::person({.arm_angle_rad = 1.5})},
      {"child", synthetic::child(1.75)},
      {"heavy", synthetic::heavy_person()},
      {"bag", synthetic::with_shoulder_bag()}};
  std::mt19937 random(7);
  for (const auto& [name, person] : people) {
    const Mesh fine = finely_meshed(person.body);
    const Places places = joints_of(decimate(fine, {.triangles = 20'000}));
    ASSERT_FALSE(places.empty()) << name;
    for (const Mesh& mesh : {decimate(fine, {.triangles = 5'000}), fine})
      for (int n = 0; n < 5; ++n) {
        const Variation variation = random_variation(random);
        std::string who;
        EXPECT_LT(worst_move(mesh, places, variation, random, who), 0.010)
            << name << ", variation " << n << " of " << mesh.triangles.size() << " triangles, " << who << ", noise "
            << variation.noise_m;
      }
  }
}

TEST(SkeletonInvariance, BonesOfBothSidesAreEquallyLong) {
  synthetic::Person person = synthetic::person();
  person.body.push_back({{0.13, 0.9, 0.05}, {0.15, 0.8, 0.05}, 0.08, 0.09});  // asymmetric: a bag
  const Places places = joints_of(finely_meshed(person.body));
  ASSERT_FALSE(places.empty());
  for (const auto& [from, to] : std::vector<std::pair<std::string, std::string>>{
           {"Arm", "ForeArm"}, {"ForeArm", "Hand"}, {"UpLeg", "Leg"}, {"Leg", "Foot"}}) {
    const double left = (places.at("Left" + from) - places.at("Left" + to)).norm();
    const double right = (places.at("Right" + from) - places.at("Right" + to)).norm();
    EXPECT_NEAR(left / right, 1, 0.03) << from;
  }
}

}  // namespace
}  // namespace booth
