#include "pipeline/atlas/blending.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "pipeline/atlas/surface_diffusion.h"
#include "pipeline/atlas/triangle_views.h"
#include "pipeline/atlas/view_sampling.h"
#include "pipeline/types/vector_clones.h"

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
      correction;  ///< vertex by vertex, one a view: the factor, balance included, that makes its low band that one
};

/// The mean of the cameras' colours, in which one that is brighter than the others by a highlight counts less.
Eigen::Array3f consensus(std::span<const Eigen::Array3f> colours, std::span<const float> weights) {
  // The harmonic mean of the lights: of two equal cameras, one that is twice as bright as the other gets a third.
  constexpr float darkest = 1e-3F;
  Eigen::Array3f sum = Eigen::Array3f::Zero();
  float total = 0;
  for (size_t c = 0; c < colours.size(); ++c) {
    if (!(weights[c] > 0)) continue;
    const float light = std::max(darkest, colours[c].mean());
    const float weight = weights[c] / light;
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
  bands.correction.resize(vertices * cameras);
  for (size_t i = 0; i < bands.correction.size(); ++i) bands.correction[i] = views[i % cameras].balance.gain;
  work.parallel_for(vertices, 1024, [&](size_t begin, size_t end) {
    std::vector<Eigen::Array3f> colours(cameras);
    for (size_t v = begin; v < end; ++v) {
      const auto weight = weights.subspan(v * cameras, cameras);
      for (size_t c = 0; c < cameras; ++c) {
        if (!(weight[c] > 0)) continue;
        const Eigen::Vector3f& p = views[c].projected[v];
        const Eigen::Array3f balance = views[c].correction_at(p.x(), p.y());
        colours[c] =
            balance * sample_level(views[c].colours, std::min(low_level, views[c].colours.size() - 1), p.x(), p.y());
        bands.correction[v * cameras + c] = balance;
      }
      bands.low[v] = consensus(colours, weight);
      for (size_t c = 0; c < cameras; ++c)
        if (weight[c] > 0)
          bands.correction[v * cameras + c] *= ((bands.low[v] + black) / (colours[c] + black)).max(least).min(most);
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

Eigen::Array4f padded(const Eigen::Array3f& colour) { return {colour[0], colour[1], colour[2], 0}; }

/// One camera's contribution to a triangle.
struct DetailView {
  TriangleView view;
  std::array<float, 3> weight{};
  std::array<Eigen::Array4f, 3> correction;
};

/// A corner that the camera does not see has no correction of its own: it takes the others'.
void complete_corners(DetailView* of) {
  Eigen::Array4f correction = Eigen::Array4f::Zero();
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
    for (size_t k = 0; k < 3; ++k) around_[k] = padded(around[triangle[k]]);
    cameras_.reserve(seen.size());
    for (const TriangleView& view : seen) {
      DetailView& of = cameras_.emplace_back();
      of.view = view;
      for (size_t k = 0; k < 3; ++k) {
        const size_t i = triangle[k] * views.size() + view.view;
        of.weight[k] = weights[i];
        of.correction[k] = padded(bands.correction[i]);
      }
      complete_corners(&of);
    }
  }

  void operator()(TexelBatch& batch) const {
    std::array<Look, most_views_of_triangle> looks;
    Each total{}, seen{};
    for (size_t c = 0; c < cameras_.size(); ++c) {
      look(cameras_[c].view, views_[cameras_[c].view.view], batch, &looks[c]);
      for (size_t i = 0; i < batch.count; ++i) {
        seen[i] += looks[c].seen[i];
        total[i] += looks[c].weight[i];
      }
    }
    fade({looks.data(), cameras_.size()}, total, batch.count);
    for (size_t i = 0; i < batch.count; ++i) batch.light[i].setZero();
    for (size_t c = 0; c < cameras_.size(); ++c) add(cameras_[c], looks[c], batch);
    for (size_t i = 0; i < batch.count; ++i) {
      const float share = total[i] > 0 ? smooth_step(hardly_seen, well_seen, seen[i]) : 0;
      if (share < 1) batch.light[i] = share * batch.light[i] + (1 - share) * at(batch, i, around_);
    }
  }

 private:
  using Each = TexelBatch::Each<float>;
  /// What a camera has to say about each texel of a batch.
  struct Look {
    Each x, y;    ///< pixel
    Each seen;    ///< rating, 0 where the texel is hidden
    Each weight;  ///< first against the others', then its share of the colour
  };

  static Eigen::Array4f at(const TexelBatch& batch, size_t i, const std::array<Eigen::Array4f, 3>& corners) {
    const auto& [a, b, c] = batch.corner_weights;
    return a[i] * corners[0] + b[i] * corners[1] + c[i] * corners[2];
  }

  static void look(const TriangleView& triangle, const PreparedView& view, const TexelBatch& batch, Look* result);
  static void fade(std::span<Look> looks, const Each& total, size_t count);

  void add(const DetailView& of, const Look& look, TexelBatch& batch) const {
    // Of a camera with a smaller share than this, the finest detail is hardly seen, and costs most.
    constexpr float small_share = 0.2F;
    const LightPyramid& colours = views_[of.view.view].colours;
    for (size_t i = 0; i < batch.count; ++i) {
      if (!(look.weight[i] > 0)) continue;
      const Sharpness sharpness = look.weight[i] < small_share ? Sharpness::usual : Sharpness::full;
      batch.light[i] += look.weight[i] * sample_pyramid(colours, of.view.lod, look.x[i], look.y[i], sharpness) *
                        at(batch, i, of.correction);
    }
  }

  std::span<const PreparedView> views_;
  std::vector<DetailView> cameras_;
  std::array<Eigen::Array4f, 3> around_;
};

BOOTH_VECTOR_CLONES
void DetailPainter::look(const TriangleView& triangle, const PreparedView& view, const TexelBatch& batch,
                         Look* result) {
  Each depth;
  triangle.for_each(batch.corner_weights, batch.count, &result->seen, &result->x, &result->y, &depth);
  if (triangle.certain) {
    result->weight = result->seen;
    return;
  }
  const TrustCell* cells = view.trust.samples.data();
  const int width = view.trust.width, height = view.trust.height;
  Each visible, worth;  // of its own, so that the compiler knows that nothing written here is read there
  for (size_t i = 0; i < batch.count; ++i) {
    const Trust trust = look_up(cells, width, height, result->x[i], result->y[i], depth[i]);
    visible[i] = trust.visible;
    worth[i] = weight_of(trust);
  }
  for (size_t i = 0; i < batch.count; ++i) {
    result->weight[i] = result->seen[i] * worth[i];
    result->seen[i] *= visible[i];
  }
}

/// From weights to shares whose sum is 1.
BOOTH_VECTOR_CLONES
void DetailPainter::fade(std::span<Look> looks, const Each& total, size_t count) {
  // A camera below this share is not worth looking at; subtracted, so that it fades in. With at most sixteen cameras
  // one is always above.
  constexpr float negligible = 0.02F;
  Each scale, flat{}, used{};
  for (size_t i = 0; i < count; ++i) scale[i] = total[i] > 0 ? 1 / total[i] : 0;
  // The power of 3/4: the others' pictures are nearly as good as the best one, and noise goes down with their number.
  for (Look& look : looks)
    for (size_t i = 0; i < count; ++i) {
      const float share = look.weight[i] * scale[i];
      look.weight[i] = std::sqrt(share * std::sqrt(share));
      flat[i] += look.weight[i];
    }
  for (size_t i = 0; i < count; ++i) scale[i] = flat[i] > 0 ? 1 / flat[i] : 0;
  for (Look& look : looks)
    for (size_t i = 0; i < count; ++i) {
      look.weight[i] = std::max(0.0F, look.weight[i] * scale[i] - negligible);
      used[i] += look.weight[i];
    }
  for (size_t i = 0; i < count; ++i) scale[i] = used[i] > 0 ? 1 / used[i] : 0;
  for (Look& look : looks)
    for (size_t i = 0; i < count; ++i) look.weight[i] *= scale[i];
}

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
                          const CameraRatings& ratings, std::span<const float> weights,
                          std::span<const Eigen::Vector2f> shifts, const Work& work) {
  const float usual = usual_rating(ratings);
  const VertexBands bands = make_bands(mesh, views, weights, work);
  const std::vector<Eigen::Array3f> around = colours_around(mesh, bands.low, weights, views.size());
  return paint_texels(
      packing, size,
      [&](size_t t) -> TrianglePainter {
        const auto seen = views_of_triangle(mesh, packing, t, views, ratings, usual, shifts);
        return DetailPainter(mesh.triangles[t], seen, bands, weights, around, views);
      },
      work);
}

}  // namespace booth
