// Each stage of a reconstruction by itself, on the recording named by BOOTH_RECORDING (the small one of the
// repository by default): wall time, processor time and the peak of the process's memory while the stage ran.

#include <benchmark/benchmark.h>

#include <cstdlib>
#include <filesystem>

#include "daemon/reconstruct_job.h"
#include "pipeline/atlas/texture_atlas.h"
#include "pipeline/export/avatar_files.h"
#include "pipeline/hull/visual_hull.h"
#include "pipeline/reconstruct.h"
#include "pipeline/segmentation/segmentation.h"
#include "pipeline/skeleton/skeleton_fit.h"
#include "pipeline/skin/skinning.h"
#include "pipeline/surface/decimation.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/surface/smoothing.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/benchmarks/benchmarking.h"

namespace booth {
namespace {

/// What every stage starts from, made once by the stages before it.
struct Inputs {
  ThreadPool pool;
  Work work = pool.work();
  ReconstructionOptions options;
  Recording recording;
  std::vector<FrameSet> background;
  FrameSet body;
  std::vector<Silhouette> silhouettes;
  VisualHull hull;
  Field shape;
  Mesh surface, mesh;
  Avatar avatar;

  Inputs() {
    const char* named = std::getenv("BOOTH_RECORDING");
    recording = must(read_recording(named != nullptr ? named : BOOTH_SOURCE_DIR "/replay/recordings/mini"));
    load();
    segment_all();
    hull = must(carve_visual_hull(recording.rig, silhouettes, options.hull, work));
    shape = refine_shape(hull.field, hull.views, body.frames, options.refinement, work);
    remove_small_handles(shape, options.handles, work);
    surface = smooth_hc(extract_surface(shape, work), options.smoothing, work);
    mesh = decimate(surface, options.decimation, work);
    avatar.mesh = mesh;
    avatar.atlas = must(build_texture_atlas(mesh, recording.rig, body.frames, silhouettes, options.atlas, work)).atlas;
    avatar.skeleton = must(fit_skeleton(mesh, options.skeleton, work)).skeleton;
    avatar.skin = must(compute_skin(mesh, avatar.skeleton, options.skinning, work));
  }

  void load() {
    background = load_shot(recording, *recording.find(ShotRole::background), work).sets;
    body = load_shot(recording, *recording.find(ShotRole::body), work).sets.front();
  }

  void segment_all() {
    std::vector<Silhouette> made(body.frames.size());
    work.parallel_for(made.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        std::vector<Frame> empty;
        for (const FrameSet& set : background)
          for (const Frame& frame : set.frames)
            if (frame.camera == body.frames[i].camera) empty.push_back(frame);
        made[i] = must(segment(empty, body.frames[i], options.segmentation, work)).silhouette;
      }
    });
    silhouettes = std::move(made);
  }
};

Inputs& inputs() {
  static Inputs made;
  return made;
}

template <class Stage>
void run(benchmark::State& state, const Stage& stage) {
  Inputs& in = inputs();
  PeakMemory::reset();
  for (auto _ : state) stage(in);
  state.counters["peak_MiB"] = PeakMemory::mebibytes();
}

void whole_job(Inputs& in) {
  const std::filesystem::path folder = std::filesystem::temp_directory_path() / "booth-benchmark";
  std::filesystem::remove_all(folder);
  RecordingSource recording(in.recording.folder);
  benchmark::DoNotOptimize(must(reconstruct_recording(recording, folder / "avatar", in.options, {}, {}, in.work)));
  std::filesystem::remove_all(folder);
}

#define BOOTH_STAGE(name, ...)                   \
  void name(benchmark::State& state) {           \
    run(state, [](Inputs& in) { __VA_ARGS__; }); \
  }                                              \
  BENCHMARK(name)->Unit(benchmark::kMillisecond)->MeasureProcessCPUTime()->UseRealTime()

BOOTH_STAGE(load, in.load());
BOOTH_STAGE(segmentation, in.segment_all());
BOOTH_STAGE(hull,
            benchmark::DoNotOptimize(carve_visual_hull(in.recording.rig, in.silhouettes, in.options.hull, in.work)));
BOOTH_STAGE(shape_refinement, benchmark::DoNotOptimize(refine_shape(in.hull.field, in.hull.views, in.body.frames,
                                                                    in.options.refinement, in.work)));
BOOTH_STAGE(handle_removal, Field shape = in.shape;
            benchmark::DoNotOptimize(remove_small_handles(shape, in.options.handles, in.work)));
BOOTH_STAGE(surface_extraction, benchmark::DoNotOptimize(extract_surface(in.shape, in.work)));
BOOTH_STAGE(surface_decimation, benchmark::DoNotOptimize(decimate(in.surface, in.options.decimation, in.work)));
BOOTH_STAGE(atlas, benchmark::DoNotOptimize(build_texture_atlas(in.mesh, in.recording.rig, in.body.frames,
                                                                in.silhouettes, in.options.atlas, in.work)));
BOOTH_STAGE(skeleton, benchmark::DoNotOptimize(fit_skeleton(in.mesh, in.options.skeleton, in.work)));
BOOTH_STAGE(skin, benchmark::DoNotOptimize(compute_skin(in.mesh, in.avatar.skeleton, in.options.skinning, in.work)));
BOOTH_STAGE(export_files, benchmark::DoNotOptimize(make_avatar_files(in.avatar, {}, {}, in.work)));
BOOTH_STAGE(whole_job, whole_job(in));

}  // namespace
}  // namespace booth

BENCHMARK_MAIN();
