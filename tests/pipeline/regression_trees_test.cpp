// Cascades of random trees, written and evaluated by dlib, against ours.

#include "pipeline/face/regression_trees.h"

#include <dlib/image_processing.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <sstream>
#include <string>

namespace booth {
namespace {

using ::testing::HasSubstr;

struct Sizes {
  size_t landmarks = face_landmarks, levels = 3, trees = 12, depth = 3, features = 40;
};

struct RandomModel {
  explicit RandomModel(const Sizes& sizes) : mean(static_cast<long>(2 * sizes.landmarks)) {
    for (float& value : mean) value = inside(random);
    forests.resize(sizes.levels);
    pixels.resize(sizes.levels);
    for (auto& level : pixels)
      for (size_t i = 0; i < sizes.features; ++i) level.emplace_back(inside(random), inside(random));
    for (auto& forest : forests)
      for (size_t i = 0; i < sizes.trees; ++i) forest.push_back(tree(sizes));
  }

  dlib::shape_predictor predictor() const { return {mean, forests, pixels}; }
  std::vector<uint8_t> saved() const {
    std::ostringstream out;
    dlib::serialize(predictor(), out);
    const std::string text = out.str();
    return {text.begin(), text.end()};
  }

  dlib::impl::regression_tree tree(const Sizes& sizes) {
    dlib::impl::regression_tree made;
    const size_t leaves = size_t{1} << sizes.depth;
    std::uniform_int_distribution<unsigned long> feature(0, sizes.features - 1);
    std::uniform_real_distribution<float> threshold(-100, 100), step(-0.02F, 0.02F);
    made.splits.resize(leaves - 1);
    for (auto& split : made.splits) {
      split.idx1 = feature(random);
      split.idx2 = feature(random);
      split.thresh = threshold(random);
    }
    made.leaf_values.resize(leaves);
    for (auto& leaf : made.leaf_values) {
      leaf.set_size(mean.size());
      for (float& value : leaf) value = step(random);
    }
    return made;
  }

  std::mt19937 random{7};
  std::uniform_real_distribution<float> inside{0, 1};
  dlib::matrix<float, 0, 1> mean;
  std::vector<std::vector<dlib::impl::regression_tree>> forests;
  std::vector<std::vector<dlib::vector<float, 2>>> pixels;
};

Image random_picture(std::mt19937& random) {
  std::uniform_int_distribution<int> grey(0, 255);
  Image picture(120, 90, 1);
  for (uint8_t& sample : picture.samples) sample = static_cast<uint8_t>(grey(random));
  return picture;
}

TEST(RegressionTrees, PlaceLandmarksWhereDlibDoes) {
  RandomModel model({});
  const dlib::shape_predictor expected = model.predictor();
  const auto trees = read_regression_trees(model.saved());
  ASSERT_TRUE(trees) << trees.error().message;
  for (const auto& [left, top, side] : {std::array{30, 20, 50}, {-20, 40, 90}, {100, 70, 60}}) {  // some reach beyond
    const Image picture = random_picture(model.random);
    dlib::array2d<unsigned char> same(picture.height, picture.width);
    for (int y = 0; y < picture.height; ++y) std::copy_n(picture.pixel(0, y), picture.width, &same[y][0]);
    const auto theirs = expected(same, dlib::rectangle(left, top, left + side, top + side));
    const FaceLandmarks ours =
        predict_landmarks(*trees, picture, {Eigen::Vector2d(left, top), Eigen::Vector2d(left + side, top + side)});
    for (size_t l = 0; l < face_landmarks; ++l) {
      constexpr double rounding = 0.5001;  // to whole pixels, as dlib gives them
      EXPECT_NEAR(ours[l].x(), static_cast<double>(theirs.part(l).x()), rounding);
      EXPECT_NEAR(ours[l].y(), static_cast<double>(theirs.part(l).y()), rounding);
    }
  }
}

TEST(RegressionTrees, HoldEveryNumberExactly) {
  RandomModel model({});
  const std::vector<float> numbers{0, 1, -1, 0.1F, -3e-5F, 1e-30F, -1e-44F, 256, 65536, 3e38F, 0.5F};
  auto& leaf = model.forests[1][5].leaf_values[2];
  for (size_t i = 0; i < numbers.size(); ++i) leaf(static_cast<long>(i)) = numbers[i];
  const auto trees = read_regression_trees(model.saved());
  ASSERT_TRUE(trees) << trees.error().message;
  const size_t leaves = trees->splits_of_tree + 1;
  const float* const read = trees->levels[1].leaves.get() + (5 * leaves + 2) * RegressionTrees::coordinates;
  for (size_t i = 0; i < RegressionTrees::coordinates; ++i) EXPECT_EQ(read[i], leaf(static_cast<long>(i))) << i;
}

std::string complaint(const std::vector<uint8_t>& file) {
  const auto trees = read_regression_trees(file);
  if (trees) return "none";
  EXPECT_EQ(trees.error().code, ErrorCode::invalid_file);
  return trees.error().message;
}

TEST(RegressionTrees, AreRefusedWhereTheFileIsCutOff) {
  const std::vector<uint8_t> whole = RandomModel({.levels = 2, .trees = 2, .depth = 1, .features = 3}).saved();
  ASSERT_EQ(complaint(whole), "none");
  for (size_t bytes = 0; bytes < whole.size(); ++bytes)
    ASSERT_NE(complaint({whole.begin(), whole.begin() + static_cast<std::ptrdiff_t>(bytes)}), "none") << bytes;
}

TEST(RegressionTrees, BearDamagedFiles) {
  RandomModel model({.levels = 2, .trees = 2, .depth = 1, .features = 3});
  const std::vector<uint8_t> whole = model.saved();
  const Image picture = random_picture(model.random);
  for (size_t i = 0; i < whole.size(); ++i)
    for (const int other : {0x00, 0x08, 0x81, 0xff}) {
      std::vector<uint8_t> file = whole;
      file[i] = static_cast<uint8_t>(other);
      if (const auto trees = read_regression_trees(file))
        predict_landmarks(*trees, picture, {Eigen::Vector2d(30, 20), Eigen::Vector2d(80, 70)});
    }
}

TEST(RegressionTrees, AreRefusedWhereTheyDoNotFit) {
  EXPECT_THAT(complaint({}), HasSubstr("does not begin as one"));
  EXPECT_THAT(complaint({'h', 'e', 'l', 'l', 'o'}), HasSubstr("does not begin as one"));
  EXPECT_THAT(complaint(RandomModel({.landmarks = 5}).saved()), HasSubstr("has 5 landmarks, expected 68"));
  RandomModel uneven({});
  uneven.forests[2][3] = uneven.tree({.depth = 2});
  EXPECT_THAT(complaint(uneven.saved()), HasSubstr("several sizes"));
  RandomModel unfinished({});
  unfinished.forests[0][1].leaf_values.pop_back();
  EXPECT_THAT(complaint(unfinished.saved()), HasSubstr("7 leaves"));
  RandomModel unknown({});
  unknown.forests[0][1].splits[0].idx2 = 40;
  EXPECT_THAT(complaint(unknown.saved()), HasSubstr("a split knows no such feature"));
  for (const float no_number : {std::numeric_limits<float>::infinity(), std::numeric_limits<float>::quiet_NaN()}) {
    RandomModel odd({});
    odd.forests[0][1].leaf_values[0](9) = no_number;
    EXPECT_NE(complaint(odd.saved()), "none");
  }
}

}  // namespace
}  // namespace booth
