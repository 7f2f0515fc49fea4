#include <dlib/image_processing/object_detector.h>
#include <dlib/image_processing/scan_fhog_pyramid.h>
#include <dlib/image_transforms/image_pyramid.h>

#include <algorithm>
#include <sstream>
#include <string>
#include <utility>

#include "pipeline/face/landmark_predictor.h"
#include "pipeline/face/regression_trees.h"

// The detector as the assembler put it into the program (frontal_detector_data.S).
extern "C" {
extern const char booth_frontal_detector[], booth_frontal_detector_end[];
}

namespace booth {
namespace {

/// dlib's frontal_face_detector, without the header that holds its weights.
using FrontalDetector = dlib::object_detector<dlib::scan_fhog_pyramid<dlib::pyramid_down<6>>>;

FrontalDetector frontal_detector() {
  std::istringstream saved(std::string(booth_frontal_detector, booth_frontal_detector_end));
  FrontalDetector detector;
  dlib::deserialize(detector, saved);
  return detector;
}

dlib::array2d<unsigned char> to_dlib(const Image& grey) {
  dlib::array2d<unsigned char> image(grey.height, grey.width);
  for (int y = 0; y < grey.height; ++y) std::copy_n(grey.pixel(0, y), grey.width, &image[y][0]);
  return image;
}

class DlibLandmarks : public LandmarkPredictor {
 public:
  DlibLandmarks(FrontalDetector detector, RegressionTrees trees)
      : detector_(std::move(detector)), trees_(std::move(trees)) {}

  std::vector<DetectedFace> detect(const Image& grey) const override {
    // Faces that are turned or badly lit score below the detector's own threshold, as do things that are no faces;
    // several cameras together tell them apart.
    constexpr double below_threshold = -0.5;
    FrontalDetector detector = detector_;  // it keeps its scratch space within
    std::vector<std::pair<double, dlib::rectangle>> found;
    detector(to_dlib(grey), found, below_threshold);
    std::vector<DetectedFace> faces;
    for (const auto& [score, box] : found)
      faces.push_back(
          {Eigen::AlignedBox2d(Eigen::Vector2d(static_cast<double>(box.left()), static_cast<double>(box.top())),
                               Eigen::Vector2d(static_cast<double>(box.right()), static_cast<double>(box.bottom()))),
           score});
    std::stable_sort(faces.begin(), faces.end(),
                     [](const DetectedFace& a, const DetectedFace& b) { return a.score > b.score; });
    return faces;
  }

  FaceLandmarks predict(const Image& grey, const Eigen::AlignedBox2d& box) const override {
    return predict_landmarks(trees_, grey, box);
  }

 private:
  FrontalDetector detector_;
  RegressionTrees trees_;
};

}  // namespace

Result<std::unique_ptr<LandmarkPredictor>> read_dlib_landmarks(std::span<const uint8_t> model) {
  auto trees = read_regression_trees(model);
  if (!trees) return trees.error();
  return std::unique_ptr<LandmarkPredictor>(std::make_unique<DlibLandmarks>(frontal_detector(), std::move(*trees)));
}

}  // namespace booth
