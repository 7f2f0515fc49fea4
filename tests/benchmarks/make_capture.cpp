// Writes a recording of a synthetic person in a ring of cameras: make_capture CAMERAS MEGAPIXELS PARENT. Its folder is
// PARENT/capture. With it the cost of a job can be measured against the number of cameras and of pixels.

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <opencv2/imgproc.hpp>
#include <random>
#include <string>

#include "pipeline/thread_pool.h"
#include "replay/recording_writer.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

constexpr int background_frames = 3;
/// Rays are cast for one pixel in so many along both axes; the rest is interpolated.
constexpr int reduction = 4;

void require(const Result<void>& done) {
  if (done) return;
  std::cerr << "make_capture: " << done.error().message << "\n";
  std::exit(1);
}

/// Enlarged to the camera's size, with the noise of a sensor.
Frame photograph(const Image& small, const RigCamera& camera, int index, uint32_t seed) {
  Image large(camera.intrinsics.width, camera.intrinsics.height, small.channels);
  const cv::Mat from(small.height, small.width, CV_8UC3, const_cast<uint8_t*>(small.samples.data()));
  cv::Mat to(large.height, large.width, CV_8UC3, large.samples.data());
  cv::resize(from, to, to.size(), 0, 0, cv::INTER_LINEAR);
  constexpr float sigma = 2;
  std::mt19937 random(seed);
  std::normal_distribution<float> noise(0, sigma);
  for (uint8_t& sample : large.samples)
    sample = static_cast<uint8_t>(std::clamp(static_cast<float>(sample) + noise(random), 0.0F, 255.0F));
  return {.camera = camera.id,
          .index = index,
          .timestamp_ns = 1,
          .frame_id = 1,
          .exposure_us = 8000,
          .pixels = std::make_shared<const Image>(std::move(large))};
}

int make(int cameras, double megapixels, const std::string& parent) {
  // Upright pictures of 3 : 4, whose sides the reduction divides.
  const int unit = static_cast<int>(std::lround(std::sqrt(megapixels * 1e6 / 12) / reduction)) * reduction;
  synthetic::RigOptions ring{.cameras = cameras, .width = 3 * unit, .height = 4 * unit};
  const Rig rig = synthetic::ring_rig(ring);
  ring.width /= reduction;
  ring.height /= reduction;
  const Rig small = synthetic::ring_rig(ring);
  const synthetic::Body body = synthetic::person().body;

  auto writer = RecordingWriter::begin(parent, {.id = "capture", .created = "2026-11-22T10:15:00Z"}, rig,
                                       {.format = SpoolOptions::Format::jpeg});
  if (!writer) require(writer.error());
  require((*writer)->begin_shot({.name = "background", .role = ShotRole::background}));
  require((*writer)->begin_shot({.name = "body", .role = ShotRole::body}));
  ThreadPool pool;
  pool.run(rig.cameras.size(), 1, [&](size_t begin, size_t end) {
    for (size_t c = begin; c < end; ++c) {
      const auto seed = static_cast<uint32_t>(c * (background_frames + 1));
      const Frame empty = synthetic::render_photograph({}, small.cameras[c], 1);
      for (int i = 0; i < background_frames; ++i)
        require((*writer)->add("background",
                               photograph(*empty.pixels, rig.cameras[c], i, seed + static_cast<uint32_t>(i))));
      const auto dark_cloth = [](const Eigen::Vector3d& p) -> Eigen::Vector3d { return 0.5 * synthetic::cloth_at(p); };
      const Frame subject = synthetic::render_photograph(body, small.cameras[c], 1, dark_cloth);
      require((*writer)->add("body", photograph(*subject.pixels, rig.cameras[c], 0, seed + background_frames)));
    }
  });
  require((*writer)->commit());
  return 0;
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  const int cameras = argc == 4 ? std::atoi(argv[1]) : 0;
  const double megapixels = argc == 4 ? std::atof(argv[2]) : 0;
  if (cameras < 3 || cameras > 200 || !(megapixels >= 0.1 && megapixels <= 50)) {
    std::cerr << "usage: make_capture CAMERAS MEGAPIXELS PARENT, with 3 … 200 cameras of 0.1 … 50 megapixels\n";
    return 2;
  }
  return booth::make(cameras, megapixels, argv[3]);
}
