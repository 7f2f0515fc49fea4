// From masks to a mesh of the budget, on the recording named by BOOTH_RECORDING (the small one of the repository by
// default): our stages together, how their cost grows with finer voxels, and what Open3D takes for a part of it where
// its package (libopen3d-dev) is installed.

#include <benchmark/benchmark.h>

#ifdef BOOTH_HAVE_OPEN3D
#include <open3d/camera/PinholeCameraParameters.h>
#include <open3d/geometry/Image.h>
#include <open3d/geometry/TriangleMesh.h>
#include <open3d/geometry/VoxelGrid.h>
#endif

#include <array>
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/hull/visual_hull.h"
#include "pipeline/reconstruct.h"
#include "pipeline/refine/handle_removal.h"
#include "pipeline/refine/shape_refinement.h"
#include "pipeline/segmentation/segmentation.h"
#include "pipeline/surface/decimation.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/surface/smoothing.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/benchmarks/benchmarking.h"

namespace booth {
namespace {

struct Inputs {
  ThreadPool pool;
  Work work = pool.work();
  ReconstructionOptions options;
  Rig rig;
  FrameSet body;
  std::vector<Silhouette> silhouettes;

  Inputs() {
    const char* named = std::getenv("BOOTH_RECORDING");
    const Recording recording =
        must(read_recording(named != nullptr ? named : BOOTH_SOURCE_DIR "/replay/recordings/mini"));
    rig = recording.rig;
    const auto background = load_shot(recording, *recording.find(ShotRole::background), work).sets;
    body = load_shot(recording, *recording.find(ShotRole::body), work).sets.front();
    silhouettes.resize(body.frames.size());
    work.parallel_for(silhouettes.size(), 1, [&](size_t begin, size_t end) {
      for (size_t i = begin; i < end; ++i) {
        std::vector<Frame> empty;
        for (const FrameSet& set : background)
          for (const Frame& frame : set.frames)
            if (frame.camera == body.frames[i].camera) empty.push_back(frame);
        silhouettes[i] = must(segment(empty, body.frames[i], options.segmentation)).silhouette;
      }
    });
  }
};

const Inputs& inputs() {
  static const Inputs made;
  return made;
}

VisualHull carve(double voxel_m) {
  const Inputs& in = inputs();
  VisualHullOptions options = in.options.hull;
  options.voxel_m = voxel_m;
  return must(carve_visual_hull(in.rig, in.silhouettes, options, in.work));
}

double cpu_s() {
  timespec now{};
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

void masks_to_mesh(benchmark::State& state) {
  const Inputs& in = inputs();
  size_t triangles = 0;
  for (auto _ : state) {
    VisualHull hull = carve(in.options.hull.voxel_m);
    Field shape = refine_shape(std::move(hull.field), hull.views, in.body.frames, in.options.refinement, in.work);
    remove_small_handles(shape, in.options.handles, in.work);
    const Mesh surface = smooth_hc(extract_surface(shape, in.work), in.options.smoothing, in.work);
    triangles = decimate(surface, in.options.decimation, in.work).triangles.size();
  }
  state.counters["triangles"] = static_cast<double>(triangles);
}
BENCHMARK(masks_to_mesh)->MeasureProcessCPUTime()->UseRealTime()->Unit(benchmark::kMillisecond);

/// Carving and extraction at 8, 4, 2 and 1 mm: the exponent e of the law cost ~ voxel^-e through the four costs, and
/// each step's own.
void surface_law(benchmark::State& state) {
  constexpr std::array<double, 4> voxels_m{0.008, 0.004, 0.002, 0.001};
  const Inputs& in = inputs();
  for (auto _ : state) {
    std::array<double, voxels_m.size()> logs{};
    for (size_t n = 0; n < voxels_m.size(); ++n) {
      const double before_s = cpu_s();
      benchmark::DoNotOptimize(extract_surface(carve(voxels_m[n]).field, in.work));
      const double took_s = cpu_s() - before_s;
      logs[n] = std::log2(took_s);
      state.counters[std::to_string(1 << (voxels_m.size() - 1 - n)) + "mm_cpu_s"] = took_s;
    }
    // Least squares over equal steps in log2.
    state.counters["exponent"] = (3 * (logs[3] - logs[0]) + (logs[2] - logs[1])) / 10;
    state.counters["last_step"] = logs[3] - logs[2];
  }
}
BENCHMARK(surface_law)->Iterations(1)->MeasureProcessCPUTime()->UseRealTime()->Unit(benchmark::kMillisecond);

#ifdef BOOTH_HAVE_OPEN3D
open3d::camera::PinholeCameraParameters parameters(const RigCamera& camera) {
  const Intrinsics& k = camera.intrinsics;
  open3d::camera::PinholeCameraParameters made;
  made.intrinsic_ = {k.width, k.height, k.fx, k.fy, k.cx, k.cy};
  made.extrinsic_ = camera.camera_from_world.matrix();
  return made;
}

/// The same masks and voxels: a dense grid, carved by one camera after the other (through pinholes: it knows no lens
/// distortion), binary; then its quadric decimation of the surface of these voxels, which our marching cubes extract.
void open3d_masks_to_mesh(benchmark::State& state) {
  const Inputs& in = inputs();
  const double voxel_m = in.options.hull.voxel_m;
  const Eigen::Vector3d sizes = in.rig.volume.sizes();
  size_t triangles = 0;
  for (auto _ : state) {
    const auto grid = open3d::geometry::VoxelGrid::CreateDense(in.rig.volume.min(), Eigen::Vector3d::Zero(), voxel_m,
                                                               sizes.x(), sizes.y(), sizes.z());
    for (const Silhouette& silhouette : in.silhouettes) {
      const Image& coverage = silhouette.coverage;
      open3d::geometry::Image mask;
      mask.Prepare(coverage.width, coverage.height, 1, 4);
      for (int y = 0; y < coverage.height; ++y)
        for (int x = 0; x < coverage.width; ++x) *mask.PointerAt<float>(x, y) = coverage.at(x, y) >= 128 ? 1.0F : 0.0F;
      grid->CarveSilhouette(mask, parameters(*in.rig.find(silhouette.camera)), true);
    }
    Grid samples;
    samples.origin = in.rig.volume.min() - Eigen::Vector3d::Constant(voxel_m);
    samples.voxel_m = voxel_m;
    for (int axis = 0; axis < 3; ++axis)
      samples.size[static_cast<size_t>(axis)] = static_cast<int>(sizes[axis] / voxel_m) + 4;
    Field field(samples);
    size_t blocks = 0;
    const auto each_brick = [&](const auto& visit) {
      for (const auto& voxel : grid->voxels_) {
        const Eigen::Vector3i at = voxel.first + Eigen::Vector3i::Ones();
        visit(field.brick_index(at.x() / Field::brick_side, at.y() / Field::brick_side, at.z() / Field::brick_side),
              at);
      }
    };
    each_brick([&](size_t brick, const Eigen::Vector3i&) {
      if (field.brick(brick) == Field::all_outside) field.set_brick(brick, static_cast<int32_t>(blocks++));
    });
    field.allocate_blocks(blocks);
    each_brick([&](size_t brick, const Eigen::Vector3i& at) {
      const Eigen::Vector3i in_brick = at.unaryExpr([](int place) { return place % Field::brick_side; });
      field.block(field.brick(
          brick))[(in_brick.z() * Field::brick_side + in_brick.y()) * Field::brick_side + in_brick.x()] = -1;
    });
    const Mesh surface = extract_surface(field, in.work);
    open3d::geometry::TriangleMesh mesh;
    for (const Eigen::Vector3f& p : surface.positions) mesh.vertices_.push_back(p.cast<double>());
    for (const auto& triangle : surface.triangles)
      mesh.triangles_.emplace_back(static_cast<int>(triangle[0]), static_cast<int>(triangle[1]),
                                   static_cast<int>(triangle[2]));
    constexpr double anything = std::numeric_limits<double>::infinity();
    triangles = mesh.SimplifyQuadricDecimation(static_cast<int>(in.options.decimation.triangles), anything, 1.0)
                    ->triangles_.size();
  }
  state.counters["triangles"] = static_cast<double>(triangles);
}
BENCHMARK(open3d_masks_to_mesh)->Iterations(1)->MeasureProcessCPUTime()->UseRealTime()->Unit(benchmark::kMillisecond);
#endif

}  // namespace
}  // namespace booth

BENCHMARK_MAIN();
