// The masks of a recording's body frames, ours beside OpenCV's background subtraction and GrabCut on the same frames:
// processor time of all frames together and, where the recording has a truth, the mean IoU with it. The recording is
// named by BOOTH_RECORDING, the small one of the repository by default.
//
// Peers: MOG2 (Z. Zivkovic, 2004) is shown each background frame, then the body frame, with shadow detection on;
// GrabCut (C. Rother et al., 2004) starts from MOG2's mask, certain 20 pixels off its outline, as a rectangle alone
// takes half a minute a frame.

#include <benchmark/benchmark.h>
#include <malloc.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/background_segm.hpp>
#include <optional>
#include <vector>

#include "pipeline/image/codec.h"
#include "pipeline/segmentation/segmentation.h"
#include "replay/recording.h"
#include "tests/benchmarks/benchmarking.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

struct CameraFrames {
  std::vector<Frame> background;
  Frame body;
  std::optional<Image> true_coverage;
};

std::vector<CameraFrames> load() {
  const char* named = std::getenv("BOOTH_RECORDING");
  const fs::path folder = named != nullptr ? named : BOOTH_SOURCE_DIR "/replay/recordings/mini";
  const Recording recording = must(read_recording(folder));
  const LoadedShot background = load_shot(recording, *recording.find(ShotRole::background));
  const LoadedShot body = load_shot(recording, *recording.find(ShotRole::body));
  std::vector<CameraFrames> cameras;
  for (const Frame& frame : body.sets.at(0).frames) {
    // Those of one size and task, so that times compare.
    if (recording.rig.find(frame.camera)->role != CameraRole::body) continue;
    CameraFrames camera{{}, frame, std::nullopt};
    for (const FrameSet& set : background.sets)
      for (const Frame& empty : set.frames)
        if (empty.camera == frame.camera) camera.background.push_back(empty);
    const fs::path mask = folder / "truth/masks" / (frame.camera + ".png");
    if (std::ifstream stream(mask, std::ios::binary); stream) {
      const std::vector<uint8_t> bytes{std::istreambuf_iterator<char>(stream), {}};
      camera.true_coverage = must(decode_image(bytes));
    }
    cameras.push_back(std::move(camera));
  }
  return cameras;
}

const std::vector<CameraFrames>& cameras() {
  static const std::vector<CameraFrames> loaded = load();
  return loaded;
}

/// The frame's samples as a matrix; they stay where they are.
cv::Mat matrix_of(const Image& image) {
  return {image.height, image.width, image.channels == 3 ? CV_8UC3 : CV_8UC1,
          const_cast<uint8_t*>(image.samples.data())};
}

/// 255 where the subject is.
using Method = std::function<cv::Mat(const CameraFrames&)>;

cv::Mat ours(const CameraFrames& camera) {
  const Segmentation made = must(segment(camera.background, camera.body, {}));
  return matrix_of(made.silhouette.coverage).clone();
}

cv::Mat mog2(const CameraFrames& camera) {
  constexpr bool detect_shadows = true;
  const auto subtractor = cv::createBackgroundSubtractorMOG2(500, 16, detect_shadows);
  cv::Mat mask;
  for (const Frame& frame : camera.background)
    subtractor->apply(matrix_of(*frame.pixels), mask, 1.0 / static_cast<double>(camera.background.size()));
  constexpr double learn_nothing = 0;
  subtractor->apply(matrix_of(*camera.body.pixels), mask, learn_nothing);
  return mask;
}

cv::Mat grab_cut(const CameraFrames& camera) {
  const cv::Mat first = mog2(camera) > 200;
  const cv::Mat reach = cv::getStructuringElement(cv::MORPH_ELLIPSE, {41, 41});
  cv::Mat opened, inner, outer, labels(first.size(), CV_8UC1, cv::Scalar(cv::GC_BGD)), background, foreground;
  cv::morphologyEx(first, opened, cv::MORPH_OPEN, cv::getStructuringElement(cv::MORPH_ELLIPSE, {5, 5}));
  cv::erode(opened, inner, reach);
  cv::dilate(opened, outer, reach);
  labels.setTo(cv::GC_PR_BGD, outer);
  labels.setTo(cv::GC_PR_FGD, opened);
  labels.setTo(cv::GC_FGD, inner);
  constexpr int rounds = 1;
  cv::grabCut(matrix_of(*camera.body.pixels), labels, {}, background, foreground, rounds, cv::GC_INIT_WITH_MASK);
  return (labels == cv::GC_FGD) | (labels == cv::GC_PR_FGD);
}

double iou(const cv::Mat& mask, const Image& truth) {
  const cv::Mat made = mask >= 128, wanted = matrix_of(truth) >= 128;
  return static_cast<double>(cv::countNonZero(made & wanted)) / static_cast<double>(cv::countNonZero(made | wanted));
}

void run(benchmark::State& state, const Method& method) {
  cv::setNumThreads(1);
  std::vector<cv::Mat> masks(cameras().size());
  for (auto _ : state)
    for (size_t i = 0; i < masks.size(); ++i) masks[i] = method(cameras()[i]);
  state.counters["frames"] = static_cast<double>(masks.size());
  double sum = 0, worst = 1;
  for (size_t i = 0; i < masks.size(); ++i) {
    if (!cameras()[i].true_coverage) return;
    // MOG2 marks shadows with 127.
    const double one = iou(masks[i], *cameras()[i].true_coverage);
    sum += one;
    worst = std::min(worst, one);
  }
  state.counters["mean_IoU"] = sum / static_cast<double>(masks.size());
  state.counters["worst_IoU"] = worst;
}

BENCHMARK_CAPTURE(run, ours, ours)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime();
BENCHMARK_CAPTURE(run, MOG2, mog2)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime();
BENCHMARK_CAPTURE(run, GrabCut, grab_cut)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime()->Iterations(1);

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  // As booth-reconstruct does, for the peers as well: freed rasters are kept.
  constexpr int largest_kept_bytes = 32 << 20;
  constexpr int most_kept_bytes = 1 << 30;
  mallopt(M_MMAP_THRESHOLD, largest_kept_bytes);
  mallopt(M_TRIM_THRESHOLD, most_kept_bytes);
  benchmark::Initialize(&argc, argv);
  benchmark::RunSpecifiedBenchmarks();
}
