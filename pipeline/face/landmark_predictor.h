#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "pipeline/face/control_points.h"
#include "pipeline/types/image.h"
#include "pipeline/types/result.h"

namespace booth {

/// A face in an upright image: a square box from the brows to the chin, pixels.
struct DetectedFace {
  Eigen::AlignedBox2d box;
  double score = 0;  ///< higher is surer; 0 is where the detector itself draws the line
};

using FaceLandmarks = std::array<Eigen::Vector2d, face_landmarks>;

/// Finds faces and their landmarks in one image. Behind it may be any model that was trained on upright faces.
/// Safe to use from several threads at once.
class LandmarkPredictor {
 public:
  virtual ~LandmarkPredictor() = default;

  /// Faces in a grey image, the surest first. Such of at least 80 pixels are found.
  virtual std::vector<DetectedFace> detect(const Image& grey) const = 0;

  /// The landmarks of the face in `box`, in iBUG's order, pixels of the image. Says nothing about whether there is one.
  virtual FaceLandmarks predict(const Image& grey, const Eigen::AlignedBox2d& box) const = 0;
};

/// dlib's frontal face detector, which is part of the library, with a shape predictor of 68 landmarks in dlib's own
/// format, which is evaluated here. Less than a tenth of a second to load, and 70 MB.
///
/// @param model  the bytes of the predictor, such as shape_predictor_68_face_landmarks.dat; not needed afterwards
/// @error invalid_file  as read_regression_trees
/// Source: V. Kazemi, J. Sullivan, "One millisecond face alignment with an ensemble of regression trees", CVPR 2014;
/// N. Dalal, B. Triggs, "Histograms of oriented gradients for human detection", CVPR 2005.
Result<std::unique_ptr<LandmarkPredictor>> read_dlib_landmarks(std::span<const uint8_t> model);

}  // namespace booth
