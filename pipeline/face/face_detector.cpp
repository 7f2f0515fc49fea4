#include "pipeline/face/face_detector.h"

#include <algorithm>
#include <istream>
#include <iterator>
#include <mutex>
#include <numeric>
#include <opencv2/core.hpp>
#include <opencv2/objdetect.hpp>
#include <string>
#include <utility>

namespace booth {
namespace {

class FaceCascade : public FaceDetector {
 public:
  explicit FaceCascade(cv::CascadeClassifier cascade) : cascade_(std::move(cascade)) {}

  std::vector<Eigen::AlignedBox2d> detect(const Image& grey, int least_px, int most_px) const override {
    const cv::Mat image(grey.height, grey.width, CV_8UC1, const_cast<uint8_t*>(grey.samples.data()));
    constexpr double step = 1.1;      // from one size of faces to the next
    constexpr int least_windows = 3;  // that overlap before they count as a face
    std::vector<cv::Rect> boxes;
    std::vector<int> windows;
    {
      const std::lock_guard lock(mutex_);
      // OpenCV's own threads would find the windows in another order each time; within a loop of its own it uses none.
      cv::parallel_for_({0, 1}, [&](const cv::Range&) {
        cascade_.detectMultiScale(image, boxes, windows, step, least_windows, 0, {least_px, least_px},
                                  {most_px, most_px});
      });
    }
    std::vector<size_t> order(boxes.size());
    std::iota(order.begin(), order.end(), size_t{0});
    std::stable_sort(order.begin(), order.end(), [&](size_t a, size_t b) { return windows[a] > windows[b]; });
    std::vector<Eigen::AlignedBox2d> faces;
    for (const size_t i : order) {
      const Eigen::Vector2d corner(boxes[i].x, boxes[i].y), size(boxes[i].width - 1, boxes[i].height - 1);
      faces.emplace_back(corner, Eigen::Vector2d(corner + size));
    }
    return faces;
  }

 private:
  mutable std::mutex mutex_;  ///< held while the cascade runs: it keeps its scratch space within
  mutable cv::CascadeClassifier cascade_;
};

}  // namespace

Result<std::unique_ptr<FaceDetector>> read_face_cascade(std::istream& file) {
  const std::string text{std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>()};
  cv::CascadeClassifier cascade;
  try {
    const cv::FileStorage storage(text, cv::FileStorage::READ | cv::FileStorage::MEMORY);
    if (storage.isOpened() && cascade.read(storage.getFirstTopLevelNode()) && !cascade.empty())
      return std::unique_ptr<FaceDetector>(std::make_unique<FaceCascade>(std::move(cascade)));
  } catch (const cv::Exception&) {
    // What OpenCV's parser says names its own source lines, which tell an operator nothing.
  }
  return Error{ErrorCode::invalid_file, "no cascade of classifiers as OpenCV stores them"};
}

}  // namespace booth
