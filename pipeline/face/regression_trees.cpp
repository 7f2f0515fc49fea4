#include "pipeline/face/regression_trees.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <string>
#include <utility>

namespace booth {
namespace {

using Shape = RegressionTrees::Shape;

/// Numbers as dlib saves them. A whole number is a byte that holds how many follow and, in its highest bit, the sign,
/// then these bytes, the lowest first; any other one is a whole mantissa and a whole exponent of two.
/// After the first fault, which `failed` tells, they are zeros.
class DlibNumbers {
 public:
  explicit DlibNumbers(std::span<const uint8_t> bytes) : at_(bytes.data()), end_(bytes.data() + bytes.size()) {}

  bool failed() const { return failed_; }
  size_t bytes_left() const { return static_cast<size_t>(end_ - at_); }

  int64_t whole() {
    constexpr uint8_t sign = 0x80;
    constexpr int most_bytes = 7;  // what is larger is nonsense here
    if (at_ == end_) return fail();
    const uint8_t head = *at_++;
    const int bytes = head & ~sign;
    if (bytes > most_bytes || end_ - at_ < bytes) return fail();
    int64_t value = 0;
    for (int i = 0; i < bytes; ++i) value |= static_cast<int64_t>(*at_++) << (8 * i);
    return (head & sign) != 0 ? -value : value;
  }

  /// How many items follow, of a byte each at least.
  size_t count() {
    const int64_t value = whole();
    return value < 0 || value > end_ - at_ ? static_cast<size_t>(fail()) : static_cast<size_t>(value);
  }

  void floats(std::span<float> values) {
    for (size_t i = 0; i < values.size();) {
      i += usual_floats(values.subspan(i));
      if (i < values.size()) values[i++] = any_float();
    }
  }

  float one_float() {
    float value = 0;
    floats({&value, 1});
    return value;
  }

 private:
  /// Reads as long as mantissas have three bytes and exponents one, as nearly all do. @return how many
  size_t usual_floats(std::span<float> values) {
    constexpr int64_t word_bytes = 8, float_bytes = 6;
    constexpr uint64_t lengths = 0x7f'0000'007f, usual = 0x01'0000'0003;
    constexpr int32_t bias = 127, mantissa_bits = 23;
    if constexpr (std::endian::native != std::endian::little) return 0;
    const uint8_t* at = at_;
    size_t i = 0;
    for (; i < values.size() && end_ - at >= word_bytes; ++i, at += float_bytes) {
      uint64_t word = 0;
      std::memcpy(&word, at, word_bytes);
      if ((word & lengths) != usual) break;
      const auto mantissa = static_cast<float>(static_cast<int32_t>(word >> 8 & 0xff'ffff));
      const auto size = static_cast<int32_t>(word >> 40 & 0xff);
      const int32_t exponent = (word >> 39 & 1) != 0 ? -size : size;
      if (exponent <= -bias || exponent > bias) break;
      const auto power = std::bit_cast<float>((exponent + bias) << mantissa_bits);
      values[i] = ((word >> 7 & 1) != 0 ? -mantissa : mantissa) * power;
    }
    at_ = at;
    return i;
  }

  float any_float() {
    const int64_t mantissa = whole(), exponent = whole();
    constexpr int64_t largest_exponent = 200;  // beyond are dlib's signs for what is not finite
    if (std::abs(exponent) > largest_exponent) return static_cast<float>(fail());
    const double value = std::ldexp(static_cast<double>(mantissa), static_cast<int>(exponent));
    if (std::abs(value) > static_cast<double>(std::numeric_limits<float>::max())) return static_cast<float>(fail());
    return static_cast<float>(value);
  }

  int fail() {
    failed_ = true;
    at_ = end_;
    return 0;
  }

  const uint8_t *at_, *end_;
  bool failed_ = false;
};

Error damaged(const std::string& how) { return {ErrorCode::invalid_file, "no shape predictor of dlib's: " + how}; }
Error cut_off() { return damaged("it ends early"); }

/// A column of coordinates, of which dlib writes the sizes negated.
Result<void> read_shape(DlibNumbers& numbers, std::span<float, RegressionTrees::coordinates> shape) {
  const int64_t rows = std::abs(numbers.whole()), columns = std::abs(numbers.whole());
  if (numbers.failed()) return cut_off();
  if (rows != static_cast<int64_t>(shape.size()) || columns != 1)
    return Error{ErrorCode::invalid_file, "the shape predictor has " + std::to_string(rows / 2) +
                                              " landmarks, expected " + std::to_string(face_landmarks)};
  numbers.floats(shape);
  return {};
}

/// An index that is checked when it is known of how many.
uint32_t read_index(DlibNumbers& numbers) {
  const int64_t value = numbers.whole();
  return value < 0 ? std::numeric_limits<uint32_t>::max()
                   : static_cast<uint32_t>(std::min<int64_t>(value, std::numeric_limits<uint32_t>::max()));
}

Result<void> read_tree(DlibNumbers& numbers, size_t tree, size_t* splits_of_tree, RegressionTrees::Level& level) {
  const size_t splits = numbers.count();
  if (numbers.failed()) return cut_off();
  constexpr size_t most_splits = 1023;
  if (!std::has_single_bit(splits + 1) || splits < 1 || splits > most_splits)
    return damaged("a tree has " + std::to_string(splits) + " splits");
  if (*splits_of_tree == 0) *splits_of_tree = splits;
  if (splits != *splits_of_tree) return damaged("its trees have several sizes");
  for (size_t i = 0; i < splits; ++i) {
    const uint32_t first = read_index(numbers), second = read_index(numbers);
    level.splits.push_back({first, second, numbers.one_float()});
  }
  const size_t leaves = numbers.count();
  if (numbers.failed()) return cut_off();
  if (leaves != splits + 1) return damaged("a tree has " + std::to_string(leaves) + " leaves");
  const size_t steps = leaves * RegressionTrees::coordinates;
  if (!level.leaves) {
    constexpr size_t least_bytes = 4;  // of a number in the file
    if (level.trees > numbers.bytes_left() / (least_bytes * steps) + 1) return cut_off();
    level.leaves = std::make_unique_for_overwrite<float[]>(level.trees * steps);
  }
  for (size_t leaf = 0; leaf < leaves; ++leaf) {
    float* const begin = level.leaves.get() + tree * steps + leaf * RegressionTrees::coordinates;
    const auto read =
        read_shape(numbers, std::span<float, RegressionTrees::coordinates>(begin, begin + Shape().size()));
    if (!read) return read;
  }
  return {};
}

/// The pixels that the levels look at: of all levels, first the landmarks they go with, then their offsets.
Result<void> read_features(DlibNumbers& numbers, std::vector<RegressionTrees::Level>& levels) {
  if (numbers.count() != levels.size()) return damaged("its levels do not fit");
  for (RegressionTrees::Level& level : levels) {
    level.features.resize(numbers.count());
    for (RegressionTrees::Feature& feature : level.features) {
      feature.landmark = read_index(numbers);
      if (feature.landmark >= face_landmarks) return damaged("a feature goes with no landmark");
    }
  }
  if (numbers.count() != levels.size()) return damaged("its levels do not fit");
  for (RegressionTrees::Level& level : levels) {
    if (numbers.count() != level.features.size()) return damaged("its features do not fit");
    for (RegressionTrees::Feature& feature : level.features) {
      const float x = numbers.one_float();
      feature.offset = {x, numbers.one_float()};
    }
    const auto known = [&](const RegressionTrees::Split& split) {
      return split.first < level.features.size() && split.second < level.features.size();
    };
    if (!std::all_of(level.splits.begin(), level.splits.end(), known)) return damaged("a split knows no such feature");
  }
  return numbers.failed() ? Result<void>(cut_off()) : Result<void>();
}

Eigen::Vector2f landmark(const Shape& shape, size_t index) { return {shape[2 * index], shape[2 * index + 1]}; }

/// The turn and scale that bring the mean shape nearest to this one.
Eigen::Matrix2f turn_of(const Shape& mean, const Shape& shape) {
  Eigen::Vector2d mean_middle = Eigen::Vector2d::Zero(), middle = Eigen::Vector2d::Zero();
  for (size_t l = 0; l < face_landmarks; ++l) {
    mean_middle += landmark(mean, l).cast<double>() / static_cast<double>(face_landmarks);
    middle += landmark(shape, l).cast<double>() / static_cast<double>(face_landmarks);
  }
  double along = 0, across = 0, squares = 0;
  for (size_t l = 0; l < face_landmarks; ++l) {
    const Eigen::Vector2d from = landmark(mean, l).cast<double>() - mean_middle;
    const Eigen::Vector2d to = landmark(shape, l).cast<double>() - middle;
    along += from.dot(to);
    across += from.x() * to.y() - from.y() * to.x();
    squares += from.squaredNorm();
  }
  if (!(squares > 0)) return Eigen::Matrix2f::Identity();
  Eigen::Matrix2d turn;
  turn << along, -across, across, along;
  return (turn / squares).cast<float>();
}

/// The pixels that a level looks at, 0 outside the image.
void look(const RegressionTrees::Level& level, const Eigen::Matrix2f& turn, const Shape& shape, const Image& grey,
          const Eigen::AlignedBox2d& box, std::vector<float>* values) {
  values->resize(level.features.size());
  for (size_t i = 0; i < level.features.size(); ++i) {
    const RegressionTrees::Feature& feature = level.features[i];
    const Eigen::Vector2f in_box = turn * feature.offset + landmark(shape, feature.landmark);
    const Eigen::Vector2d pixel = box.min() + in_box.cast<double>().cwiseProduct(box.sizes());
    const double x = std::floor(pixel.x() + 0.5), y = std::floor(pixel.y() + 0.5);
    const bool inside = x >= 0 && y >= 0 && x < grey.width && y < grey.height;
    (*values)[i] = inside ? static_cast<float>(*grey.pixel(static_cast<int>(x), static_cast<int>(y))) : 0;
  }
}

}  // namespace

Result<RegressionTrees> read_regression_trees(std::span<const uint8_t> file) {
  DlibNumbers numbers(file);
  constexpr int known_version = 1;
  if (numbers.whole() != known_version) return damaged("it does not begin as one");
  RegressionTrees trees;
  if (const auto read = read_shape(numbers, trees.mean); !read) return read.error();
  trees.levels.resize(numbers.count());
  for (RegressionTrees::Level& level : trees.levels) {
    level.trees = numbers.count();
    for (size_t tree = 0; tree < level.trees; ++tree)
      if (const auto read = read_tree(numbers, tree, &trees.splits_of_tree, level); !read) return read.error();
  }
  if (numbers.failed()) return cut_off();
  if (const auto read = read_features(numbers, trees.levels); !read) return read.error();
  return trees;
}

FaceLandmarks predict_landmarks(const RegressionTrees& trees, const Image& grey, const Eigen::AlignedBox2d& box) {
  Shape shape = trees.mean;
  std::vector<float> values;
  for (const RegressionTrees::Level& level : trees.levels) {
    look(level, turn_of(trees.mean, shape), shape, grey, box, &values);
    const RegressionTrees::Split* splits = level.splits.data();
    const float* leaves = level.leaves.get();
    for (size_t tree = 0; tree < level.trees; ++tree) {
      size_t at = 0;
      while (at < trees.splits_of_tree) {
        const RegressionTrees::Split& split = splits[at];
        at = 2 * at + (values[split.first] - values[split.second] > split.threshold ? 1 : 2);
      }
      const float* const steps = leaves + (at - trees.splits_of_tree) * RegressionTrees::coordinates;
      for (size_t c = 0; c < RegressionTrees::coordinates; ++c) shape[c] += steps[c];
      splits += trees.splits_of_tree;
      leaves += (trees.splits_of_tree + 1) * RegressionTrees::coordinates;
    }
  }
  FaceLandmarks landmarks;
  for (size_t l = 0; l < face_landmarks; ++l)
    landmarks[l] = box.min() + landmark(shape, l).cast<double>().cwiseProduct(box.sizes());
  return landmarks;
}

}  // namespace booth
