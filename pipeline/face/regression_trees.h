#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "pipeline/face/landmark_predictor.h"
#include "pipeline/types/image.h"
#include "pipeline/types/result.h"

namespace booth {

/// A cascade of regression trees that places a face's landmarks: each level looks at differences of pixels about where
/// the landmarks are so far, and every tree of it adds a step to all of them.
struct RegressionTrees {
  static constexpr size_t coordinates = 2 * face_landmarks;
  /// x and y by turns, in a box from (0, 0) to (1, 1).
  using Shape = std::array<float, coordinates>;

  /// A pixel that a level looks at.
  struct Feature {
    uint32_t landmark = 0;  ///< which it goes with
    Eigen::Vector2f offset = Eigen::Vector2f::Zero();
  };
  /// On to the first child where feature `first` is brighter than `second` by more than the threshold.
  struct Split {
    uint32_t first = 0, second = 0;
    float threshold = 0;
  };
  struct Level {
    std::vector<Feature> features;
    size_t trees = 0;
    std::vector<Split> splits;        ///< tree by tree, a split's children where a heap has them
    std::unique_ptr<float[]> leaves;  ///< tree by tree, the steps of each leaf
  };

  Shape mean{};
  size_t splits_of_tree = 0;  ///< it has a leaf more
  std::vector<Level> levels;
};

/// The trees of a file in which dlib saved a shape predictor.
/// @error invalid_file  no such file, or damaged, or of another number of landmarks, or with trees of several sizes
/// Cost: some hundredths of a second for 100 MB, a sixth of what dlib takes.
Result<RegressionTrees> read_regression_trees(std::span<const uint8_t> file);

/// The landmarks of the face in `box`, pixels of the image. The same as dlib's, which it rounds to whole pixels.
/// Source: V. Kazemi, J. Sullivan, "One millisecond face alignment with an ensemble of regression trees", CVPR 2014.
FaceLandmarks predict_landmarks(const RegressionTrees& trees, const Image& grey, const Eigen::AlignedBox2d& box);

}  // namespace booth
