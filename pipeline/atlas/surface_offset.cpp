#include "pipeline/atlas/surface_offset.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>

#include "pipeline/atlas/grey_image.h"
#include "pipeline/atlas/vertex_neighbours.h"
#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

/// Offsets that are tried: both sides of the surface, in steps of one pitch of the patches, at which the pictures of
/// two cameras 50° apart move by one sample against each other.
constexpr int steps = 6;
constexpr int offsets = 2 * steps + 1;
/// Samples on a patch's edge, and in it.
constexpr int patch_side = 7;
constexpr size_t patch_samples = static_cast<size_t>(patch_side) * patch_side;
using Patch = Eigen::Array<float, patch_samples, 1>;
/// Correlation at each offset.
using Scores = Eigen::Array<float, offsets, 1>;

constexpr size_t most_cameras = 4;

/// Bilinear, at a pixel of the image itself; its border goes on.
float sample_grey(const FloatImage& image, float x, float y) {
  const float u = std::clamp(x, 0.0F, static_cast<float>(image.width) - 1.001F);
  const float v = std::clamp(y, 0.0F, static_cast<float>(image.height) - 1.001F);
  const int u0 = static_cast<int>(u), v0 = static_cast<int>(v);
  const float fu = u - static_cast<float>(u0), fv = v - static_cast<float>(v0);
  const float* a = image.pixel(u0, v0);
  const float* b = a + image.width;
  return (1 - fv) * ((1 - fu) * a[0] + fu * a[1]) + fv * ((1 - fu) * b[0] + fu * b[1]);
}

/// A camera's grey image of the level whose pixels are nearest to the pitch at a vertex, and the patch's grid in it.
struct PatchView {
  const FloatImage* grey = nullptr;
  Eigen::Vector2f origin, across, along, outwards;  ///< pixels; the last three for one pitch
  float weight = 0;
};

class Correlator {
 public:
  Correlator(const Mesh& mesh, std::span<const PreparedView> views, const CameraRatings& ratings,
             std::span<const float> weights, std::span<const GreyLevels> greys, float pitch_m)
      : mesh_(mesh), views_(views), ratings_(ratings), weights_(weights), greys_(greys), pitch_m_(pitch_m) {}

  /// The damped correlation between the cameras that see the vertex best, at each offset; 0 where nothing can be said.
  Scores operator()(size_t v, const Eigen::Vector3f& normal) const {
    const auto [seen, count] = best_views(v, normal);
    Scores scores = Scores::Zero();
    if (count < 2) return scores;
    float total = 0, squares = 0;
    for (size_t i = 0; i < count; ++i) {
      total += seen[i].weight;
      squares += seen[i].weight * seen[i].weight;
    }
    for (int k = 0; k < offsets; ++k) {
      Patch sum = Patch::Zero();
      float own = 0;
      for (size_t i = 0; i < count; ++i) {
        const Patch patch = seen[i].weight * normalised(seen[i], static_cast<float>(k - steps));
        sum += patch;
        own += patch.square().sum();
      }
      // Of all pairs of different cameras: the square of the sum without each patch's product with itself.
      scores[k] = (sum.square().sum() - own) / (total * total - squares);
    }
    return scores;
  }

 private:
  std::pair<std::array<PatchView, most_cameras>, size_t> best_views(size_t v, const Eigen::Vector3f& normal) const {
    constexpr float good_share = 0.2F;  // of the best camera's weight
    const auto weight = weights_.subspan(v * views_.size(), views_.size());
    const float best = *std::max_element(weight.begin(), weight.end());
    std::array<PatchView, most_cameras> seen;
    size_t count = 0;
    if (!(best > 0)) return {seen, 0};
    std::vector<size_t> order;
    for (size_t c = 0; c < views_.size(); ++c)
      if (weight[c] > good_share * best) order.push_back(c);
    std::stable_sort(order.begin(), order.end(), [&](size_t l, size_t r) { return weight[l] > weight[r]; });
    const Eigen::Vector3f across = normal.unitOrthogonal(), along = normal.cross(across);
    for (const size_t c : order) {
      if (count == most_cameras) break;
      if (const auto view = patch_view(v, c, {across, along, normal})) {
        seen[count] = *view;
        seen[count++].weight = weight[c] / best;
      }
    }
    return {seen, count};
  }

  std::optional<PatchView> patch_view(size_t v, size_t c, const std::array<Eigen::Vector3f, 3>& axes) const {
    const PreparedView& view = views_[c];
    const float pixels_a_pitch = pitch_m_ * std::sqrt(ratings_.vertex(v)[c]);
    const auto level = static_cast<size_t>(std::clamp(std::lround(std::log2(std::max(1.0F, pixels_a_pitch))),
                                                      static_cast<long>(GreyLevels::finest),
                                                      static_cast<long>(GreyLevels::finest + GreyLevels::count - 1)));
    const float scale = 1 / static_cast<float>(1 << level);
    PatchView patch;
    patch.grey = &greys_[c].level(level);
    if (patch.grey->width < 2 || patch.grey->height < 2) return {};
    patch.origin = on_level(view.projected[v].head<2>(), scale);
    std::array<Eigen::Vector2f, 3> steps_px;
    for (size_t k = 0; k < 3; ++k) {
      const auto pixel = project(*view.camera, (mesh_.positions[v] + pitch_m_ * axes[k]).cast<double>());
      if (!pixel) return {};
      steps_px[k] =
          scale * ((*pixel - Eigen::Vector2d(view.left, view.top)).cast<float>() - view.projected[v].head<2>());
    }
    patch.across = steps_px[0];
    patch.along = steps_px[1];
    patch.outwards = steps_px[2];
    return patch;
  }

  /// Mean 0; norm 1 where there is much more contrast than noise, less where there is not.
  static Patch normalised(const PatchView& view, float offset) {
    constexpr float noise = 2;  // of 255, of photographs at half their resolution and of their resampling
    const Eigen::Vector2f middle = view.origin + offset * view.outwards;
    Patch patch;
    Eigen::Index i = 0;
    for (int b = -patch_side / 2; b <= patch_side / 2; ++b)
      for (int a = -patch_side / 2; a <= patch_side / 2; ++a) {
        const Eigen::Vector2f p = middle + static_cast<float>(a) * view.across + static_cast<float>(b) * view.along;
        patch[i++] = sample_grey(*view.grey, p.x(), p.y());
      }
    patch -= patch.mean();
    return patch / std::sqrt(patch.square().sum() + noise * noise * static_cast<float>(patch_samples));
  }

  const Mesh& mesh_;
  std::span<const PreparedView> views_;
  const CameraRatings& ratings_;
  std::span<const float> weights_;
  std::span<const GreyLevels> greys_;
  float pitch_m_;
};

/// The place of a parabola's top through three values one apart, −0.5 … 0.5.
float parabola_top(float before, float here, float after) {
  const float bend = before - 2 * here + after;
  return bend < 0 ? std::clamp(0.5F * (before - after) / bend, -0.5F, 0.5F) : 0;
}

/// No vertex is moved against a neighbour by more than a part of the edge between them: towards the smaller offset.
void flatten_steep_changes(const Mesh& mesh, const VertexNeighbours& neighbours, std::vector<float>* offset) {
  constexpr float steepest = 0.5F;
  constexpr int sweeps = 6;
  for (int sweep = 0; sweep < sweeps; ++sweep)
    for (size_t v = 0; v < offset->size(); ++v)
      for (const uint32_t n : neighbours.of(v)) {
        const float most = std::abs((*offset)[n]) + steepest * (mesh.positions[v] - mesh.positions[n]).norm();
        (*offset)[v] = std::clamp((*offset)[v], -most, most);
      }
}

}  // namespace

std::vector<float> offset_limits(const Mesh& mesh, std::span<const PreparedView> views) {
  constexpr float least_m = 0.0005F, most_m = 0.020F;
  constexpr float pixels_a_third = 2.0F / 3;  // the map has half the resolution
  constexpr float hardly_turning = 0.05F;     // sine: a motion along the line of sight does not show
  const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
  std::vector<float> limits(mesh.positions.size(), most_m);
  for (const PreparedView& view : views) {
    const Eigen::Vector3f eye = view.camera->center().cast<float>();
    const auto focal_px = static_cast<float>(view.camera->intrinsics.fx);
    for (size_t v = 0; v < limits.size(); ++v) {
      const Eigen::Vector3f& p = view.projected[v];
      const int x = static_cast<int>(0.5F * p.x()), y = static_cast<int>(0.5F * p.y());
      if (!(p.z() > 0 && p.x() >= 0 && p.y() >= 0 && view.margin.contains(x, y))) continue;
      const float sine = (eye - mesh.positions[v]).normalized().cross(normals[v]).norm();
      const float margin_px = pixels_a_third * static_cast<float>(view.margin.at(x, y));
      limits[v] = std::min(limits[v], least_m + margin_px * p.z() / focal_px / std::max(sine, hardly_turning));
    }
  }
  return limits;
}

std::vector<float> find_surface_offsets(const Mesh& mesh, std::span<const PreparedView> views,
                                        std::span<const GreyLevels> greys, const CameraRatings& ratings,
                                        std::span<const float> weights, std::span<const float> limits,
                                        const Work& work) {
  const float pitch_m = 2 / std::sqrt(usual_rating(ratings));  // two pixels of the usual camera
  const std::vector<Eigen::Vector3f> normals = vertex_normals(mesh);
  const Correlator correlate(mesh, views, ratings, weights, greys, pitch_m);
  std::vector<Scores> scores(mesh.positions.size(), Scores::Zero());
  work.parallel_for(scores.size(), 512, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v) scores[v] = correlate(v, normals[v]);
  });

  // A vertex's neighbours see about the same part of the surface: together their correlations are surer.
  const VertexNeighbours neighbours = neighbours_of(mesh);
  std::vector<Scores> summed = scores;
  for (size_t v = 0; v < scores.size(); ++v)
    for (const uint32_t n : neighbours.of(v)) summed[v] += scores[n] / static_cast<float>(neighbours.of(v).size());

  // Prices in units of correlation, lengths in pitches. An offset of one pitch, which is more than most of a refined
  // hull is off, must be worth what the noise of a correlation is; to differ from a neighbour by one pitch, ten times
  // that, for errors of a hull spread over many vertices.
  constexpr float offset_price = 0.03F, difference_price = 0.3F;
  constexpr float outline_price = 0.4F;  // inwards, of an outline that perhaps another part of the surface makes
  constexpr float roughness = 0.3F;      // by how much offsets differ for each pitch that vertices lie apart
  constexpr int sweeps = 8;
  std::vector<float> offset(scores.size(), 0.0F);
  // What it costs to differ from a neighbour, for each of neighbours.list.
  std::vector<float> stiffness;
  stiffness.reserve(neighbours.list.size());
  for (size_t v = 0; v < scores.size(); ++v)
    for (const uint32_t n : neighbours.of(v)) {
      const float soft = 1 + roughness * (mesh.positions[v] - mesh.positions[n]).norm() / pitch_m;
      stiffness.push_back(difference_price / (soft * soft));
    }
  for (int sweep = 0; sweep < sweeps; ++sweep)
    for (size_t v = 0; v < scores.size(); ++v) {
      // The neighbours' price of an offset x is total_stiffness x² − 2 pull x, but for what all offsets have in common.
      float total_stiffness = offset_price, pull = 0;
      const auto around = neighbours.of(v);
      const float* stiff = stiffness.data() + neighbours.first[v];
      for (size_t i = 0; i < around.size(); ++i) {
        total_stiffness += stiff[i];
        pull += stiff[i] * offset[around[i]];
      }
      const float limit = limits[v] / pitch_m;
      Scores total;
      for (int k = 0; k < offsets; ++k) {
        const auto at = static_cast<float>(k - steps);
        const float beyond = std::max(0.0F, std::abs(at) - limit);
        total[k] = summed[v][k] - (total_stiffness * at - 2 * pull) * at - outline_price * beyond * beyond;
      }
      Eigen::Index best = 0;
      total.maxCoeff(&best);
      offset[v] = static_cast<float>(best - steps);
      if (best > 0 && best + 1 < offsets) offset[v] += parabola_top(total[best - 1], total[best], total[best + 1]);
      offset[v] = std::min(offset[v], limits[v] / pitch_m);
      if (!(limits[v] > 0)) offset[v] = 0;
    }
  for (float& o : offset) o *= pitch_m;
  flatten_steep_changes(mesh, neighbours, &offset);
  return offset;
}

}  // namespace booth
