// The face scan of a recording from its 84 images to points, ours beside OpenCV's: processor time, and coverage and
// distances from the truth where the recording has one. The recording is named by BOOTH_RECORDING. Images are decoded
// before. "Head alone" is what a reconstruction asks for; freed memory is kept for all, as booth-reconstruct does.
//
// Peer: structured_light::GrayCodePattern::decode, its getProjPixel for every pixel it finds lit, undistortPoints and
// triangulatePoints between each camera and the projector; a projector pixel's points are averaged.

#include <benchmark/benchmark.h>
#include <malloc.h>

#include <cstdlib>
#include <iostream>
#include <opencv2/calib3d.hpp>
#include <opencv2/structured_light.hpp>
#include <string>
#include <vector>

#include "tests/quality/face_scan.h"

namespace booth {
namespace {

const quality::FaceRecording& recording() {
  static const quality::FaceRecording loaded = [] {
    const char* named = std::getenv("BOOTH_RECORDING");
    if (named == nullptr) {
      std::cerr << "BOOTH_RECORDING names no recording with a face scan\n";
      std::exit(1);
    }
    return quality::read_face_recording(named);
  }();
  return loaded;
}

void tell(const RangeScan& scan, benchmark::State* state) {
  const quality::ScanErrors errors = quality::compare(scan, recording().truth);
  state->counters["coverage"] = errors.coverage;
  state->counters["median_mm"] = 1000 * errors.median_m;
  state->counters["p95_mm"] = 1000 * errors.p95_m;
}

void scan_in(const Eigen::AlignedBox3d& region, benchmark::State* state) {
  const auto& in = recording();
  RangeScan scan;
  for ([[maybe_unused]] auto _ : *state) scan = scan_structured_light(in.rig, in.capture, {}, region).value().scan;
  tell(scan, state);
}
void ours_head_alone(benchmark::State& state) { scan_in(recording().region, &state); }
void ours_whole_images(benchmark::State& state) { scan_in(recording().rig.volume, &state); }

cv::Mat matrix_of(const Image& image) {
  return {image.height, image.width, CV_8UC1, const_cast<uint8_t*>(image.samples.data())};
}
cv::Matx33d camera_matrix(const Intrinsics& k) { return {k.fx, k.skew, k.cx, 0, k.fy, k.cy, 0, 0, 1}; }
cv::Mat distortion(const Intrinsics& k) {
  return cv::Mat(static_cast<int>(k.distortion.size()), 1, CV_64F, const_cast<double*>(k.distortion.data()));
}
cv::Matx34d projection(const CalibratedView& view) {
  cv::Matx34d p;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) p(row, column) = view.camera_from_world.matrix()(row, column);
  return p;
}

void opencv(benchmark::State& state) {
  const auto& in = recording();
  const GrayCodePattern& shown = in.capture.pattern;
  std::vector<const RigCamera*> cameras;
  for (const Frame& frame : in.capture.sets.front().frames) cameras.push_back(in.rig.find(frame.camera));
  std::vector<std::vector<cv::Mat>> images(cameras.size());
  std::vector<cv::Mat> white, black;
  for (size_t c = 0; c < cameras.size(); ++c)
    for (const FrameSet& set : in.capture.sets)
      for (const Frame& frame : set.frames)
        if (frame.camera == cameras[c]->id) {
          const cv::Mat image = matrix_of(*frame.pixels);
          const int last = pattern_count(shown) - 1;
          (set.index == last ? black : set.index == last - 1 ? white : images[c]).push_back(image);
        }
  RangeScan scan(shown.width, shown.height);
  for ([[maybe_unused]] auto _ : state) {
    const auto pattern = cv::structured_light::GrayCodePattern::create(shown.width, shown.height);
    cv::Mat disparity;
    pattern->decode(images, disparity, black, white, cv::structured_light::DECODE_3D_UNDERWORLD);
    std::vector<Eigen::Vector3d> sum(scan.points.size(), Eigen::Vector3d::Zero());
    std::vector<int> count(scan.points.size(), 0);
    for (size_t c = 0; c < cameras.size(); ++c) {
      std::vector<cv::Point2d> seen, lit;
      constexpr int least_contrast = 5;  // as the class's own default for what lies in shadow
      for (int y = 0; y < white[c].rows; ++y)
        for (int x = 0; x < white[c].cols; ++x) {
          cv::Point at;
          if (white[c].at<uint8_t>(y, x) - black[c].at<uint8_t>(y, x) <= least_contrast ||
              pattern->getProjPixel(images[c], x, y, at))
            continue;
          seen.emplace_back(x, y);
          lit.emplace_back(at);
        }
      if (seen.empty()) continue;
      std::vector<cv::Point2d> from_camera, from_projector;
      cv::undistortPoints(seen, from_camera, camera_matrix(cameras[c]->intrinsics), distortion(cameras[c]->intrinsics));
      cv::undistortPoints(lit, from_projector, camera_matrix(in.rig.projector->intrinsics),
                          distortion(in.rig.projector->intrinsics));
      cv::Mat points;
      cv::triangulatePoints(projection(*cameras[c]), projection(*in.rig.projector), from_camera, from_projector,
                            points);
      for (int i = 0; i < points.cols; ++i) {
        const cv::Vec4d p(points.at<double>(0, i), points.at<double>(1, i), points.at<double>(2, i),
                          points.at<double>(3, i));
        const size_t at = scan.index(static_cast<int>(lit[static_cast<size_t>(i)].x),
                                     static_cast<int>(lit[static_cast<size_t>(i)].y));
        sum[at] += Eigen::Vector3d(p[0], p[1], p[2]) / p[3];
        ++count[at];
      }
    }
    for (size_t i = 0; i < sum.size(); ++i)
      if (count[i] > 0) scan.points[i] = (sum[i] / count[i]).cast<float>();
  }
  tell(scan, &state);
}

BENCHMARK(ours_head_alone)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime();
BENCHMARK(ours_whole_images)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime();
BENCHMARK(opencv)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime();

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  constexpr int largest_kept_bytes = 32 << 20, most_kept_bytes = 512 << 20;
  mallopt(M_MMAP_THRESHOLD, largest_kept_bytes);
  mallopt(M_TRIM_THRESHOLD, most_kept_bytes);
  benchmark::Initialize(&argc, argv);
  benchmark::RunSpecifiedBenchmarks();
}
