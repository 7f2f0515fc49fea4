#include "pipeline/face/head_fit.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>
#include <random>

namespace booth {
namespace {

using Deformation = Eigen::Vector3f (*)(const Eigen::Vector3f&);

Eigen::Vector3f nothing(const Eigen::Vector3f&) { return Eigen::Vector3f::Zero(); }

/// Another face: waves of some 4 mm and 12 cm.
Eigen::Vector3f smooth(const Eigen::Vector3f& p) {
  constexpr float wave = 50, amplitude_m = 0.004F;
  return amplitude_m * Eigen::Vector3f(std::sin(wave * p.x()) * std::cos(wave * p.y()), std::sin(wave * p.y() + 1),
                                       std::cos(wave * p.x()) * std::sin(wave * p.y()));
}

class HeadFit : public testing::Test {
 protected:
  static void SetUpTestSuite() { neutral_ = new NeutralHead(*parse_neutral_head(built_in_neutral_head())); }
  static void TearDownTestSuite() { delete neutral_; }

  /// A subject: the neutral head deformed, half a head higher than a metre, turned and a little larger.
  static std::vector<Eigen::Vector3f> subject(Deformation deformation) {
    const Eigen::AngleAxisf turn(0.4F, Eigen::Vector3f(0.2F, 1, 0.1F).normalized());
    std::vector<Eigen::Vector3f> positions;
    for (const Eigen::Vector3f& p : neutral_->mesh.positions)
      positions.push_back(turn * (1.08F * (p + deformation(p))) + Eigen::Vector3f(0.1F, 1.5F, -0.05F));
    return positions;
  }

  static FaceControlPoints controls_of(const std::vector<Eigen::Vector3f>& positions, double noise_m, uint32_t seed) {
    std::mt19937 random(seed);
    std::normal_distribution<double> noise(0, noise_m);
    FaceControlPoints controls;
    for (size_t i = 0; i < NeutralHead::landmark_count; ++i) {
      ControlPoint point;
      point.position = neutral_->landmark(i, positions).cast<double>();
      if (noise_m > 0) point.position += Eigen::Vector3d(noise(random), noise(random), noise(random));
      constexpr double least_m = 1e-4;
      point.covariance *= std::pow(std::max(least_m, noise_m), 2);
      point.views = 3;
      point.contour = is_contour_landmark(i);
      controls.points[i] = point;
    }
    return controls;
  }

  /// The part of the vertices between brows, ears and chin that are within `near_m` of the subject's.
  static double share_within(double near_m, const FittedHead& fitted, const std::vector<Eigen::Vector3f>& truth) {
    size_t near = 0, all = 0;
    constexpr float brows_m = 0.035F;
    for (size_t i = 0; i < truth.size(); ++i) {
      if (neutral_->face_front[i] == 0 || neutral_->mesh.positions[i].y() > brows_m) continue;
      ++all;
      near += (fitted.mesh.positions[i] - truth[i]).norm() < near_m ? 1 : 0;
    }
    return static_cast<double>(near) / static_cast<double>(all);
  }

  static NeutralHead* neutral_;
};
NeutralHead* HeadFit::neutral_ = nullptr;

TEST_F(HeadFit, FindsTheSimilarityOfAnUndeformedHead) {
  const auto truth = subject(nothing);
  for (const HeadFitMethod method : {HeadFitMethod::smooth, HeadFitMethod::pyramids}) {
    const auto fitted = fit_neutral_head(*neutral_, controls_of(truth, 0, 1), {}, {}, Field(), {.method = method});
    ASSERT_TRUE(fitted.ok()) << fitted.error().message;
    EXPECT_NEAR(fitted->scale, 1.08, 1e-4);
    EXPECT_EQ(fitted->features, 51);
    EXPECT_GT(share_within(1e-4, *fitted, truth), 0.999);
  }
}

TEST_F(HeadFit, PyramidsMeetTheControlPoints) {
  const auto truth = subject(smooth);
  const auto controls = controls_of(truth, 0, 1);
  const auto fitted = fit_neutral_head(*neutral_, controls, {}, {}, Field(), {.method = HeadFitMethod::pyramids});
  ASSERT_TRUE(fitted.ok());
  EXPECT_LT(fitted->feature_median_m, 3e-4);
  EXPECT_GT(share_within(0.004, *fitted, truth), 0.8);
  // Removed is what lies outside all pyramids: the forehead above the brows.
  const size_t left = static_cast<size_t>(std::count(fitted->face.begin(), fitted->face.end(), 1));
  EXPECT_GT(left, 1500U);
  EXPECT_LT(left, 4500U);
}

TEST_F(HeadFit, SmoothFitRecoversAnotherFaceFromItsLandmarks) {
  const auto truth = subject(smooth);
  const auto fitted = fit_neutral_head(*neutral_, controls_of(truth, 0.0003, 2), {}, {}, Field());
  ASSERT_TRUE(fitted.ok());
  EXPECT_GT(share_within(0.003, *fitted, truth), 0.85);
  const auto rigid =
      fit_neutral_head(*neutral_, controls_of(truth, 0.0003, 2), {}, {}, Field(), {.variation_m = 0.0005});
  ASSERT_TRUE(rigid.ok());
  EXPECT_GT(share_within(0.002, *fitted, truth), share_within(0.002, *rigid, truth));
}

TEST_F(HeadFit, AFewWrongPointsDoLittle) {
  const auto truth = subject(nothing);
  FaceControlPoints controls = controls_of(truth, 0.0005, 3);
  for (const size_t wrong : {36U, 48U, 30U}) controls.points[wrong]->position += Eigen::Vector3d(0.03, 0.02, -0.04);
  const auto fitted = fit_neutral_head(*neutral_, controls, {}, {}, Field());
  ASSERT_TRUE(fitted.ok());
  EXPECT_GT(share_within(0.0025, *fitted, truth), 0.97);
}

TEST_F(HeadFit, MissingPointsArePredicted) {
  const auto truth = subject(smooth);
  for (const HeadFitMethod method : {HeadFitMethod::smooth, HeadFitMethod::pyramids}) {
    FaceControlPoints controls = controls_of(truth, 0.0003, 4);
    for (size_t i = 0; i < 68; i += 3) controls.points[i].reset();
    const auto fitted = fit_neutral_head(*neutral_, controls, {}, {}, Field(), {.method = method});
    ASSERT_TRUE(fitted.ok());
    EXPECT_GT(share_within(0.005, *fitted, truth), 0.85);
  }
}

TEST_F(HeadFit, RefusesTooFewPointsAndShapesThatAreNoFace) {
  const auto truth = subject(nothing);
  FaceControlPoints few = controls_of(truth, 0, 5);
  for (size_t i = 17; i < 60; ++i) few.points[i].reset();
  const auto refused = fit_neutral_head(*neutral_, few, {}, {}, Field());
  ASSERT_FALSE(refused.ok());
  EXPECT_EQ(refused.error().code, ErrorCode::no_subject);
  EXPECT_NE(refused.error().message.find("only 8 landmarks"), std::string::npos) << refused.error().message;

  FaceControlPoints scattered = controls_of(truth, 0.05, 6);
  EXPECT_FALSE(fit_neutral_head(*neutral_, scattered, {}, {}, Field()).ok());
  EXPECT_FALSE(fit_neutral_head(*neutral_, {}, {}, {}, Field()).ok());

  std::vector<Eigen::Vector3f> tiny = truth;
  for (Eigen::Vector3f& p : tiny) p *= 0.3F;
  EXPECT_FALSE(fit_neutral_head(*neutral_, controls_of(tiny, 0, 7), {}, {}, Field()).ok());
}

}  // namespace
}  // namespace booth
