#include "pipeline/atlas/blending.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "pipeline/atlas/surface_diffusion.h"
#include "pipeline/atlas/triangle_views.h"
#include "pipeline/atlas/view_sampling.h"

namespace booth {
namespace {

/// Below the first, of the usual rating, all cameras together see a place too obliquely for it to be known; from the
/// second on it is.
constexpr float hardly_seen = 0.01F, well_seen = 0.06F;

float smooth_step(float from, float to, float value) {
  const float t = std::clamp((value - from) / (to - from), 0.0F, 1.0F);
  return t * t * (3 - 2 * t);
}

/// Near outlines a camera still counts where no other sees the place.
float weight_of(const Trust& trust) {
  constexpr float least_confidence = 0.03F;
  return trust.visible * (least_confidence + (1 - least_confidence) * trust.confidence);
}

/// What all vertices know about each view.
struct VertexBands {
  std::vector<Eigen::Array3f> low;  ///< of each vertex: what all cameras make of its surroundings
  std::vector<Eigen::Array3f>
      correction;  ///< vertex by vertex, one a view: the factor that makes its low band that one
};

/// The mean of the cameras' colours, in which one that is brighter than the others by a highlight counts less.
Eigen::Array3f consensus(std::span<const Eigen::Array3f> colours, std::span<const float> weights) {
  // A power mean of the lights: of two equal cameras, one that is twice as bright as the other gets a fifth.
  constexpr float darkest = 1e-3F;
  Eigen::Array3f sum = Eigen::Array3f::Zero();
  float total = 0;
  for (size_t c = 0; c < colours.size(); ++c) {
    if (!(weights[c] > 0)) continue;
    const float light = std::max(darkest, colours[c].mean());
    const float weight = weights[c] / (light * light);
    sum += weight * colours[c];
    total += weight;
  }
  return total > 0 ? Eigen::Array3f(sum / total) : sum;
}

VertexBands make_bands(const Mesh& mesh, std::span<const PreparedView> views, std::span<const float> weights,
                       const Work& work) {
  constexpr size_t low_level = 3;  // eight pixels, about the distance between vertices
  // Black has no factor; beyond the bounds it is no highlight but another thing that a camera sees.
  constexpr float black = 0.01F, least = 0.5F, most = 2.0F;
  const size_t cameras = views.size(), vertices = mesh.positions.size();
  VertexBands bands;
  bands.low.assign(vertices, Eigen::Array3f::Zero());
  bands.correction.assign(vertices * cameras, Eigen::Array3f::Ones());
  work.parallel_for(vertices, 1024, [&](size_t begin, size_t end) {
    std::vector<Eigen::Array3f> colours(cameras);
    for (size_t v = begin; v < end; ++v) {
      const auto weight = weights.subspan(v * cameras, cameras);
      for (size_t c = 0; c < cameras; ++c) {
        if (!(weight[c] > 0)) continue;
        const Eigen::Vector3f& p = views[c].projected[v];
        colours[c] = sample_level(views[c].colours, std::min(low_level, views[c].colours.size() - 1), p.x(), p.y());
      }
      bands.low[v] = consensus(colours, weight);
      for (size_t c = 0; c < cameras; ++c)
        if (weight[c] > 0)
          bands.correction[v * cameras + c] = ((bands.low[v] + black) / (colours[c] + black)).max(least).min(most);
    }
  });
  return bands;
}

/// The low band, diffused over the surface where no camera sees it.
std::vector<Eigen::Array3f> colours_around(const Mesh& mesh, std::span<const Eigen::Array3f> low,
                                           std::span<const float> weights, size_t cameras) {
  std::vector<Eigen::Array3f> colours(low.begin(), low.end());
  std::vector<uint8_t> known(low.size(), 0);
  for (size_t v = 0; v < low.size(); ++v) {
    float seen = 0;
    for (size_t c = 0; c < cameras; ++c) seen += weights[v * cameras + c];
    constexpr float half = 0.5F;
    known[v] = smooth_step(hardly_seen, well_seen, seen) > half ? 1 : 0;
  }
  diffuse_colours(mesh, colours, known);
  return colours;
}

/// One camera's contribution to a triangle.
struct DetailView {
  TriangleView view;
  std::array<float, 3> weight{};
  std::array<Eigen::Array3f, 3> correction;
};

/// A corner that the camera does not see has no correction of its own: it takes the others'.
void complete_corners(DetailView* of) {
  Eigen::Array3f correction = Eigen::Array3f::Zero();
  float count = 0;
  for (size_t k = 0; k < 3; ++k) {
    if (!(of->weight[k] > 0)) continue;
    correction += of->correction[k];
    ++count;
  }
  if (!(count > 0)) return;
  for (size_t k = 0; k < 3; ++k)
    if (!(of->weight[k] > 0)) of->correction[k] = correction / count;
}

class DetailPainter {
 public:
  DetailPainter(const std::array<uint32_t, 3>& triangle, std::span<const TriangleView> seen, const VertexBands& bands,
                std::span<const float> weights, std::span<const Eigen::Array3f> around,
                std::span<const PreparedView> views)
      : views_(views) {
    for (size_t k = 0; k < 3; ++k) around_[k] = around[triangle[k]];
    for (const TriangleView& view : seen) {
      DetailView& of = cameras_.emplace_back();
      of.view = view;
      for (size_t k = 0; k < 3; ++k) {
        const size_t i = triangle[k] * views.size() + view.view;
        of.weight[k] = weights[i];
        of.correction[k] = bands.correction[i];
      }
      complete_corners(&of);
    }
  }

  Eigen::Array3f operator()(const Eigen::Vector3f& at) const {
    std::array<Contribution, most_views_of_triangle> contributions;
    size_t count = 0;
    float total = 0, seen = 0;
    for (const DetailView& of : cameras_) {
      const float rating = of.view.rating_at(at);
      if (!(rating > 0)) continue;
      const Eigen::Vector3f pixel = of.view.pixel_at(at);
      const Trust trust =
          of.view.certain ? Trust{1, 1} : look_up(views_[of.view.view], pixel.x(), pixel.y(), pixel.z());
      seen += rating * trust.visible;
      const float weight = rating * weight_of(trust);
      if (!(weight > 0)) continue;
      total += weight;
      contributions[count++] = {&of, weight, pixel.head<2>()};
    }
    const float share = total > 0 ? smooth_step(hardly_seen, well_seen, seen) : 0;
    const Eigen::Array3f diffused = at[0] * around_[0] + at[1] * around_[1] + at[2] * around_[2];
    if (!(share > 0)) return diffused;
    return share * mean({contributions.data(), count}, total, at) + (1 - share) * diffused;
  }

 private:
  struct Contribution {
    const DetailView* of = nullptr;
    float weight = 0;
    Eigen::Vector2f pixel;
  };

  Eigen::Array3f mean(std::span<const Contribution> contributions, float total, const Eigen::Vector3f& at) const {
    // A camera below this share of the weights is not worth looking at; subtracted, so that it fades in. With at most
    // sixteen cameras one is always above.
    constexpr float negligible = 0.02F;
    Eigen::Array3f light = Eigen::Array3f::Zero();
    float used = 0;
    for (const Contribution& one : contributions) {
      const float share = one.weight / total - negligible;
      if (share <= 0) continue;
      used += share;
      const DetailView& of = *one.of;
      light += share * sample_pyramid(views_[of.view.view].colours, of.view.lod, one.pixel.x(), one.pixel.y()) *
               (at[0] * of.correction[0] + at[1] * of.correction[1] + at[2] * of.correction[2]);
    }
    return light / used;
  }

  std::span<const PreparedView> views_;
  std::vector<DetailView> cameras_;
  std::array<Eigen::Array3f, 3> around_;
};

}  // namespace

std::vector<float> weigh_views(const Mesh& mesh, std::span<const PreparedView> views, const CameraRatings& ratings) {
  const float usual = usual_rating(ratings);
  std::vector<float> weights(ratings.of_vertex.size(), 0.0F);
  for (size_t v = 0; v < mesh.positions.size(); ++v)
    for (size_t c = 0; c < views.size(); ++c) {
      const float rating = ratings.vertex(v)[c];
      const Eigen::Vector3f& p = views[c].projected[v];
      if (rating > 0 && p.z() > 0)
        weights[v * views.size() + c] = rating / usual * weight_of(look_up(views[c], p.x(), p.y(), p.z()));
    }
  return weights;
}

TexelColours blend_texels(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                          const CameraRatings& ratings, std::span<const float> weights, const Work& work) {
  const float usual = usual_rating(ratings);
  const VertexBands bands = make_bands(mesh, views, weights, work);
  const std::vector<Eigen::Array3f> around = colours_around(mesh, bands.low, weights, views.size());
  return paint_texels(
      packing, size,
      [&](size_t t) -> TrianglePainter {
        const auto seen = views_of_triangle(mesh, packing, t, views, ratings, usual);
        return DetailPainter(mesh.triangles[t], seen, bands, weights, around, views);
      },
      work);
}

}  // namespace booth
