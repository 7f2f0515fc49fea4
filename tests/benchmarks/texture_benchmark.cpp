// Everything after the mesh, and of it unwrapping and packing alone: a synthetic person of 20,000 triangles before 12
// cameras of 2 megapixels, an atlas of 2048². Wall time, processor time, the peak of the process's memory meanwhile,
// and how much of the atlas the charts use.

#include <benchmark/benchmark.h>

#include <algorithm>
#include <memory>
#include <opencv2/imgproc.hpp>
#include <random>
#include <utility>
#include <vector>

#include "pipeline/atlas/packing.h"
#include "pipeline/atlas/texture_atlas.h"
#include "pipeline/export/avatar_files.h"
#include "pipeline/skeleton/skeleton_fit.h"
#include "pipeline/skin/skinning.h"
#include "pipeline/surface/decimation.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/surface/smoothing.h"
#include "pipeline/thread_pool.h"
#include "tests/benchmarks/benchmarking.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

/// Enlarged, with the noise of a sensor if asked for.
Image enlarged(const Image& small, int width, int height, bool noisy, uint32_t seed) {
  Image large(width, height, small.channels);
  const int type = small.channels == 3 ? CV_8UC3 : CV_8UC1;
  const cv::Mat from(small.height, small.width, type, const_cast<uint8_t*>(small.samples.data()));
  cv::Mat to(height, width, type, large.samples.data());
  cv::resize(from, to, to.size(), 0, 0, cv::INTER_LINEAR);
  if (!noisy) return large;
  constexpr double sigma = 2;
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, sigma);
  for (uint8_t& sample : large.samples)
    sample = static_cast<uint8_t>(std::clamp(static_cast<double>(sample) + noise(random), 0.0, 255.0));
  return large;
}

struct Inputs {
  ThreadPool pool;
  Work work = pool.work();
  Mesh mesh;
  Rig rig;
  std::vector<Frame> frames;
  std::vector<Silhouette> silhouettes;

  Inputs() {
    constexpr int width = 1248, height = 1664, reduction = 4;
    const synthetic::Body body = synthetic::person().body;
    mesh = decimate(smooth_hc(extract_surface(synthetic::sample_field(body, 0.005), work), {}, work), {}, work);
    synthetic::RigOptions ring{.cameras = 12, .width = width / reduction, .height = height / reduction};
    const Rig small = synthetic::ring_rig(ring);
    frames.resize(small.cameras.size());
    silhouettes.resize(small.cameras.size());
    work.parallel_for(small.cameras.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        Frame frame = synthetic::render_photograph(body, small.cameras[i], 1);
        frame.pixels = std::make_shared<Image>(enlarged(*frame.pixels, width, height, true, static_cast<uint32_t>(i)));
        frames[i] = std::move(frame);
        const Silhouette outline = synthetic::render_silhouette(body, small.cameras[i], 1);
        silhouettes[i] = {outline.camera, enlarged(outline.coverage, width, height, false, 0)};
      }
    });
    ring.width = width;
    ring.height = height;
    rig = synthetic::ring_rig(ring);
  }
};

Inputs& inputs() {
  static Inputs made;
  return made;
}

void unwrapping_and_packing(benchmark::State& state) {
  Inputs& in = inputs();
  constexpr int size = 2048, gutter_texels = 4;
  constexpr double clearance_m = 0.002;
  PeakMemory::reset();
  size_t charts_made = 0;
  for (auto _ : state) {
    const std::vector<Chart> charts = cut_into_charts(in.mesh, Charting::flattening, clearance_m, in.work);
    const std::vector<double> density(charts.size(), 1.0);
    benchmark::DoNotOptimize(
        pack_charts(charts, in.mesh.triangles.size(), density, size, gutter_texels, in.work).texels_per_m);
    charts_made = charts.size();
  }
  state.counters["triangles"] = static_cast<double>(in.mesh.triangles.size());
  state.counters["charts"] = static_cast<double>(charts_made);
  state.counters["peak_MiB"] = PeakMemory::mebibytes();
}

void texturing(benchmark::State& state, TextureMethod method) {
  Inputs& in = inputs();
  PeakMemory::reset();
  double used = 0;
  for (auto _ : state)
    used =
        must(build_texture_atlas(in.mesh, in.rig, in.frames, in.silhouettes, {.method = method}, in.work)).used_share;
  state.counters["used"] = used;
  state.counters["peak_MiB"] = PeakMemory::mebibytes();
}

void everything_after_the_mesh(benchmark::State& state) {
  Inputs& in = inputs();
  PeakMemory::reset();
  for (auto _ : state) {
    Avatar avatar;
    avatar.mesh = in.mesh;
    TextureAtlas textured = must(build_texture_atlas(in.mesh, in.rig, in.frames, in.silhouettes, {}, in.work));
    avatar.mesh.positions = std::move(textured.positions);
    avatar.atlas = std::move(textured.atlas);
    avatar.skeleton = must(fit_skeleton(avatar.mesh, {}, in.work)).skeleton;
    avatar.skin = must(compute_skin(avatar.mesh, avatar.skeleton, {}, in.work));
    benchmark::DoNotOptimize(make_avatar_files(avatar, {}, {}, in.work).size());
  }
  state.counters["peak_MiB"] = PeakMemory::mebibytes();
}

BENCHMARK(unwrapping_and_packing)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime()->UseRealTime();
BENCHMARK_CAPTURE(texturing, best_view, TextureMethod::best_view)
    ->Unit(benchmark::kMillisecond)
    ->MeasureProcessCPUTime()
    ->UseRealTime();
BENCHMARK_CAPTURE(texturing, blend, TextureMethod::blend)
    ->Unit(benchmark::kMillisecond)
    ->MeasureProcessCPUTime()
    ->UseRealTime();
BENCHMARK_CAPTURE(texturing, full, TextureMethod::full)
    ->Unit(benchmark::kMillisecond)
    ->MeasureProcessCPUTime()
    ->UseRealTime();
BENCHMARK(everything_after_the_mesh)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime()->UseRealTime();

}  // namespace
}  // namespace booth

BENCHMARK_MAIN();
