#include "pipeline/atlas/view_alignment.h"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>

#include "pipeline/atlas/grey_image.h"
#include "pipeline/atlas/vertex_neighbours.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// Pictures are compared at half their resolution: less noise, and motions of several pixels are found.
constexpr size_t level = 1;
constexpr float scale = 0.5F;
/// Samples on a patch's edge, and in it.
constexpr int patch_side = 5;
constexpr size_t patch_samples = static_cast<size_t>(patch_side) * patch_side;
using Patch = Eigen::Array<float, patch_samples, 1>;

constexpr float least_share = 0.05F;  ///< of the best camera's weight: cameras below are not compared
constexpr size_t most_cameras = 8;

float smooth_step(float from, float to, float value) {
  const float t = std::clamp((value - from) / (to - from), 0.0F, 1.0F);
  return t * t * (3 - 2 * t);
}

/// The grid of a patch in a camera's grey image.
struct PatchGrid {
  size_t view = 0;
  float weight = 0;
  Eigen::Vector2f origin, across, along;  ///< pixels of the level; the last two for one pitch
};

/// A patch and its derivatives by the pixels of the level, each less its mean.
struct Drawn {
  Patch value, by_x, by_y;
};

Drawn draw(const FloatImage& grey, const PatchGrid& grid, const Eigen::Vector2f& shift) {
  Drawn drawn;
  Eigen::Index i = 0;
  for (int b = -patch_side / 2; b <= patch_side / 2; ++b)
    for (int a = -patch_side / 2; a <= patch_side / 2; ++a, ++i) {
      const Eigen::Vector2f p =
          grid.origin + shift + static_cast<float>(a) * grid.across + static_cast<float>(b) * grid.along;
      const float u = std::clamp(p.x(), 0.0F, static_cast<float>(grey.width) - 1.001F);
      const float v = std::clamp(p.y(), 0.0F, static_cast<float>(grey.height) - 1.001F);
      const int u0 = static_cast<int>(u), v0 = static_cast<int>(v);
      const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
      const float* above = grey.pixel(u0, v0);
      const float* below = above + grey.width;
      const float left = (1 - fv) * above[0] + fv * below[0], right = (1 - fv) * above[1] + fv * below[1];
      drawn.value[i] = (1 - fu) * left + fu * right;
      drawn.by_x[i] = right - left;
      drawn.by_y[i] = (1 - fu) * (below[0] - above[0]) + fu * (below[1] - above[1]);
    }
  drawn.value -= drawn.value.mean();
  drawn.by_x -= drawn.by_x.mean();
  drawn.by_y -= drawn.by_y.mean();
  return drawn;
}

/// The normal equations of one camera's motion at one vertex.
struct Equations {
  float xx = 0, xy = 0, yy = 0, x = 0, y = 0, squares = 0, samples = 0;

  Equations& operator+=(const Equations& other) {
    xx += other.xx;
    xy += other.xy;
    yy += other.yy;
    x += other.x;
    y += other.y;
    squares += other.squares;
    samples += other.samples;
    return *this;
  }
  /// The motion, held back where the patches are noisy or differ by more than it explains.
  Eigen::Vector2f solve() const {
    if (!(samples > 0)) return Eigen::Vector2f::Zero();
    constexpr float noise = 2;         // of 255
    constexpr float usual_motion = 1;  // pixels of the level
    const float variance = std::max(noise * noise, squares / samples);
    const float held = variance * static_cast<float>(patch_samples) / (usual_motion * usual_motion) / patch_side;
    const float a = xx + held, c = yy + held, determinant = a * c - xy * xy;
    return Eigen::Vector2f(xy * y - c * x, xy * x - a * y) / determinant;
  }
};

class Aligner {
 public:
  Aligner(const Mesh& mesh, std::span<const PreparedView> views, std::span<const GreyLevels> greys,
          const CameraRatings& ratings, std::span<const float> weights, const Work& work)
      : views_(views), grids_(mesh.positions.size()), greys_(greys), shifts_(weights.size(), Eigen::Vector2f::Zero()) {
    const float pitch_m = 2 / std::sqrt(usual_rating(ratings));  // two pixels of the usual camera
    const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
    work.parallel_for(grids_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t v = begin; v < end; ++v)
        grids_[v] =
            grids_at(v, mesh.positions[v], normals[v], pitch_m, weights.subspan(v * views.size(), views.size()));
    });
  }

  void step(const VertexNeighbours& neighbours, const Work& work) {
    constexpr float farthest = 3;  // pixels of the level
    const std::vector<Equations> equations = equations_everywhere(work);
    if (at_rest_.empty()) at_rest_ = disagreement(equations);
    work.parallel_for(grids_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t v = begin; v < end; ++v) {
        for (size_t c = 0; c < views_.size(); ++c) {
          Equations sum = equations[v * views_.size() + c];
          for (const uint32_t n : neighbours.of(v)) sum += equations[n * views_.size() + c];
          Eigen::Vector2f& shift = shifts_[v * views_.size() + c];
          shift += sum.solve();
          if (const float length = shift.norm(); length > farthest) shift *= farthest / length;
        }
        keep_the_mean(v);
      }
    });
  }

  /// Keeps the motions where they are worth it: where a ghost would show, and where most of the disagreement goes.
  void keep_what_helps(const VertexNeighbours& neighbours, const Work& work) {
    constexpr float invisible = 0.15F, visible = 0.45F;  // pixels of the level
    constexpr float too_little = 0.2F, enough = 0.5F;    // of the disagreement
    const std::vector<float> moved = disagreement(equations_everywhere(work));
    for (size_t v = 0; v < grids_.size(); ++v) {
      float before = at_rest_[v], after = moved[v], motion = 0, total = 0;
      for (const uint32_t n : neighbours.of(v)) {
        before += at_rest_[n];
        after += moved[n];
      }
      for (const PatchGrid& grid : grids_[v]) {
        motion += grid.weight * shifts_[v * views_.size() + grid.view].squaredNorm();
        total += grid.weight;
      }
      const float gone = before > 0 ? 1 - after / before : 0;
      const float share = smooth_step(too_little, enough, gone) *
                          smooth_step(invisible, visible, total > 0 ? std::sqrt(motion / total) : 0);
      for (size_t c = 0; c < views_.size(); ++c) shifts_[v * views_.size() + c] *= share;
    }
  }

  /// In pixels of level 0.
  std::vector<Eigen::Vector2f> shifts() && {
    for (Eigen::Vector2f& shift : shifts_) shift /= scale;
    return std::move(shifts_);
  }

 private:
  static constexpr size_t grain = 512;

  const FloatImage& grey(size_t view) const { return greys_[view].level(level); }

  std::vector<Equations> equations_everywhere(const Work& work) const {
    std::vector<Equations> equations(shifts_.size());
    work.parallel_for(grids_.size(), grain, [&](size_t begin, size_t end) {
      for (size_t v = begin; v < end; ++v) add_equations(v, equations);
    });
    return equations;
  }

  /// Of each vertex, between its cameras: grey values squared.
  std::vector<float> disagreement(std::span<const Equations> equations) const {
    std::vector<float> sums(grids_.size(), 0.0F);
    for (size_t v = 0; v < grids_.size(); ++v)
      for (const PatchGrid& grid : grids_[v]) sums[v] += grid.weight * equations[v * views_.size() + grid.view].squares;
    return sums;
  }

  std::vector<PatchGrid> grids_at(size_t v, const Eigen::Vector3f& position, const Eigen::Vector3f& normal,
                                  float pitch_m, std::span<const float> weights) const {
    std::vector<PatchGrid> grids;
    const float best = *std::max_element(weights.begin(), weights.end());
    if (!(best > 0)) return grids;
    std::vector<size_t> order;
    for (size_t c = 0; c < weights.size(); ++c)
      if (weights[c] > least_share * best && grey(c).width > 1 && grey(c).height > 1) order.push_back(c);
    std::stable_sort(order.begin(), order.end(), [&](size_t l, size_t r) { return weights[l] > weights[r]; });
    order.resize(std::min(order.size(), most_cameras));
    const Eigen::Vector3f across = normal.unitOrthogonal(), along = normal.cross(across);
    for (const size_t c : order) {
      const PreparedView& view = views_[c];
      const auto step_px = [&](const Eigen::Vector3f& axis) -> std::optional<Eigen::Vector2f> {
        const auto pixel = project(*view.camera, (position + pitch_m * axis).cast<double>());
        if (!pixel) return std::nullopt;
        return scale * ((*pixel - Eigen::Vector2d(view.left, view.top)).cast<float>() - view.projected[v].head<2>());
      };
      const auto right = step_px(across), up = step_px(along);
      if (right && up)
        grids.push_back({c, weights[c] / best, on_level(view.projected[v].head<2>(), scale), *right, *up});
    }
    return grids;
  }

  void add_equations(size_t v, std::vector<Equations>& equations) const {
    const std::vector<PatchGrid>& grids = grids_[v];
    if (grids.size() < 2) return;
    std::array<Drawn, most_cameras> drawn;
    Patch mean = Patch::Zero();
    float total = 0;
    for (size_t i = 0; i < grids.size(); ++i) {
      drawn[i] = draw(grey(grids[i].view), grids[i], shifts_[v * views_.size() + grids[i].view]);
      mean += grids[i].weight * drawn[i].value;
      total += grids[i].weight;
    }
    mean /= total;
    for (size_t i = 0; i < grids.size(); ++i) {
      const Drawn& own = drawn[i];
      const Patch difference = own.value - mean;
      equations[v * views_.size() + grids[i].view] = {(own.by_x * own.by_x).sum(),      (own.by_x * own.by_y).sum(),
                                                      (own.by_y * own.by_y).sum(),      (own.by_x * difference).sum(),
                                                      (own.by_y * difference).sum(),    difference.square().sum(),
                                                      static_cast<float>(patch_samples)};
    }
  }

  /// What all cameras have in common is no disagreement: on the surface, the mean of the motions is none.
  void keep_the_mean(size_t v) {
    Eigen::Vector2f sum = Eigen::Vector2f::Zero();
    float total = 0;
    const auto surface_to_pixels = [](const PatchGrid& grid) {
      Eigen::Matrix2f matrix;
      matrix << grid.across, grid.along;
      return matrix;
    };
    for (const PatchGrid& grid : grids_[v]) {
      sum += grid.weight * (surface_to_pixels(grid).inverse() * shifts_[v * views_.size() + grid.view]);
      total += grid.weight;
    }
    if (!(total > 0) || !sum.allFinite()) return;
    for (const PatchGrid& grid : grids_[v])
      shifts_[v * views_.size() + grid.view] -= surface_to_pixels(grid) * sum / total;
  }

  std::span<const PreparedView> views_;
  std::vector<std::vector<PatchGrid>> grids_;  ///< of each vertex
  std::span<const GreyLevels> greys_;
  std::vector<Eigen::Vector2f> shifts_;  ///< pixels of the level
  std::vector<float> at_rest_;           ///< disagreement before any motion
};

}  // namespace

std::vector<Eigen::Vector2f> align_views(const Mesh& mesh, std::span<const PreparedView> views,
                                         std::span<const GreyLevels> greys, const CameraRatings& ratings,
                                         std::span<const float> weights, const Work& work) {
  constexpr int steps = 3;
  const VertexNeighbours neighbours = neighbours_of(mesh);
  Aligner aligner(mesh, views, greys, ratings, weights, work);
  for (int step = 0; step < steps; ++step) aligner.step(neighbours, work);
  aligner.keep_what_helps(neighbours, work);
  return std::move(aligner).shifts();
}

}  // namespace booth
