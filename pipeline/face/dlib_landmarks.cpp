#include <dlib/image_processing.h>
#include <dlib/image_processing/frontal_face_detector.h>

#include <algorithm>
#include <exception>
#include <istream>

#include "pipeline/face/landmark_predictor.h"

namespace booth {
namespace {

dlib::array2d<unsigned char> to_dlib(const Image& grey) {
  dlib::array2d<unsigned char> image(grey.height, grey.width);
  for (int y = 0; y < grey.height; ++y) std::copy_n(grey.pixel(0, y), grey.width, &image[y][0]);
  return image;
}

class DlibLandmarks : public LandmarkPredictor {
 public:
  DlibLandmarks(dlib::frontal_face_detector detector, dlib::shape_predictor predictor)
      : detector_(std::move(detector)), predictor_(std::move(predictor)) {}

  std::vector<DetectedFace> detect(const Image& grey) const override {
    // Faces that are turned or badly lit score below the detector's own threshold, as do things that are no faces;
    // several cameras together tell them apart.
    constexpr double below_threshold = -0.5;
    dlib::frontal_face_detector detector = detector_;  // it keeps its scratch space within
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
    const auto whole = [](double value) { return std::lround(value); };
    const dlib::rectangle face(whole(box.min().x()), whole(box.min().y()), whole(box.max().x()), whole(box.max().y()));
    const dlib::full_object_detection shape = predictor_(to_dlib(grey), face);
    FaceLandmarks landmarks;
    for (size_t i = 0; i < landmarks.size(); ++i) {
      const dlib::point& part = shape.part(i);
      landmarks[i] = {static_cast<double>(part.x()), static_cast<double>(part.y())};
    }
    return landmarks;
  }

 private:
  dlib::frontal_face_detector detector_;
  dlib::shape_predictor predictor_;
};

}  // namespace

Result<std::unique_ptr<LandmarkPredictor>> read_dlib_landmarks(std::istream& model) {
  dlib::shape_predictor predictor;
  try {
    dlib::deserialize(predictor, model);
  } catch (const std::exception& fault) {
    return Error{ErrorCode::invalid_file, std::string("no shape predictor of dlib's: ") + fault.what()};
  }
  if (predictor.num_parts() != face_landmarks)
    return Error{ErrorCode::invalid_file, "the shape predictor has " + std::to_string(predictor.num_parts()) +
                                              " landmarks, expected " + std::to_string(face_landmarks)};
  return std::unique_ptr<LandmarkPredictor>(
      std::make_unique<DlibLandmarks>(dlib::get_frontal_face_detector(), std::move(predictor)));
}

}  // namespace booth
