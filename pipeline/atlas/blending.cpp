#include "pipeline/atlas/blending.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>

#include "pipeline/atlas/linear_light.h"
#include "pipeline/atlas/surface_diffusion.h"
#include "pipeline/atlas/view_sampling.h"

namespace booth {
namespace {

/// Texels around a triangle that get its colours, continued beyond its edges.
constexpr float band_texels = 2.0F;
/// More cameras than this at one triangle add nothing.
constexpr size_t most_cameras = 16;

struct Evidence {
  Eigen::Array3f light = Eigen::Array3f::Zero();
  float share = 0;  ///< 0 = nobody saw it, 1 = well seen
};

float smooth_step(float from, float to, float value) {
  const float t = std::clamp((value - from) / (to - from), 0.0F, 1.0F);
  return t * t * (3 - 2 * t);
}

/// What one camera knows about the point to be coloured.
struct Observation {
  size_t view = 0;
  float rating = 0;  ///< as a share of the usual one
  float x = 0, y = 0, depth_m = 0, lod = 0;
  bool certain = false;  ///< known to be visible and clear of outlines
};

class Blender {
 public:
  Blender(std::span<const PreparedView> views, std::span<const Eigen::Array3f> gains, Blending blending)
      : views_(views), gains_(gains), blending_(blending) {}

  Evidence operator()(std::span<const Observation> seen) const {
    // Below the first a camera's view is too oblique to be used if nothing else is known, from the second on it is
    // trusted fully; shares of the usual rating.
    constexpr float hardly_seen = 0.01F, well_seen = 0.06F;
    std::array<float, most_cameras> weight{};
    float total = 0, seen_rating = 0;
    for (size_t i = 0; i < seen.size(); ++i) {
      weight[i] = blending_ == Blending::rating_mean ? mean_weight(seen[i], &seen_rating)
                                                     : sharpened_weight(seen[i], &seen_rating);
      total += weight[i];
    }
    Evidence evidence;
    evidence.share = smooth_step(hardly_seen, well_seen, seen_rating);
    if (!(total > 0)) return {};
    // A camera below this share of the weights is not worth looking at; subtracted, so that it fades in.
    constexpr float negligible = 0.01F;
    float used = 0;
    for (size_t i = 0; i < seen.size(); ++i) {
      const float share = weight[i] / total - negligible;
      if (share <= 0) continue;
      used += share;
      const PreparedView& view = views_[seen[i].view];
      evidence.light += share * gains_[seen[i].view] * sample_pyramid(view.colours, seen[i].lod, seen[i].x, seen[i].y);
    }
    if (!(used > 0)) return {};
    evidence.light /= used;
    return evidence;
  }

 private:
  static float mean_weight(const Observation& o, float* seen_rating) {
    *seen_rating += o.rating;
    return o.rating;
  }
  float sharpened_weight(const Observation& o, float* seen_rating) const {
    const Trust trust = o.certain ? Trust{1, 1} : look_up(views_[o.view], o.x, o.y, o.depth_m);
    if (!(trust.visible > 0)) return 0;
    *seen_rating += o.rating * trust.visible;
    // Near outlines a camera still counts where no other sees the place.
    constexpr float least_confidence = 0.03F;
    const float base = o.rating * trust.visible * (least_confidence + (1 - least_confidence) * trust.confidence);
    const float square = base * base;
    return base * square;
  }

  std::span<const PreparedView> views_;
  std::span<const Eigen::Array3f> gains_;
  Blending blending_;
};

/// The rating of a place that is seen well: the median over vertices of their best camera's.
float usual_rating(const CameraRatings& ratings, size_t vertices) {
  std::vector<float> best;
  for (size_t v = 0; v < vertices; ++v) {
    const auto rating = ratings.vertex(v);
    if (const float most = *std::max_element(rating.begin(), rating.end()); most > 0) best.push_back(most);
  }
  if (best.empty()) return 1;
  std::nth_element(best.begin(), best.begin() + static_cast<std::ptrdiff_t>(best.size() / 2), best.end());
  return best[best.size() / 2];
}

float lod_of(float rating_px_per_m2, float texels_per_m2) {
  return texels_per_m2 > 0 && rating_px_per_m2 > 0 ? 0.5F * std::log2(rating_px_per_m2 / texels_per_m2) : 0;
}

/// Linear light of every vertex, diffused over the surface where no camera sees it.
std::vector<Eigen::Array3f> colour_vertices(const Mesh& mesh, std::span<const PreparedView> views,
                                            const CameraRatings& ratings, const Blender& blend, float usual) {
  constexpr float blurred = 2;  // levels: a vertex stands for its surroundings
  constexpr float known_from = 0.5F;
  std::vector<Eigen::Array3f> colours(mesh.positions.size(), Eigen::Array3f::Zero());
  std::vector<uint8_t> known(mesh.positions.size(), 0);
  std::vector<Observation> seen;
  for (size_t v = 0; v < colours.size(); ++v) {
    seen.clear();
    const auto rating = ratings.vertex(v);
    for (size_t c = 0; c < views.size() && seen.size() < most_cameras; ++c) {
      const Eigen::Vector3f& p = views[c].projected[v];
      if (rating[c] > 0 && p.z() > 0) seen.push_back({c, rating[c] / usual, p.x(), p.y(), p.z(), blurred});
    }
    const Evidence evidence = blend(seen);
    colours[v] = evidence.light;
    known[v] = evidence.share > known_from ? 1 : 0;
  }
  diffuse_colours(mesh, colours, known);
  return colours;
}

/// Whether the camera sees all of the triangle and its surroundings, far from any outline or depth step: then there
/// is no need to look at every texel.
bool certainly_seen(const PreparedView& view, const std::array<uint32_t, 3>& triangle) {
  Eigen::Array2f low = Eigen::Array2f::Constant(std::numeric_limits<float>::infinity()), high = -low;
  for (const uint32_t v : triangle) {
    const Eigen::Vector3f& p = view.projected[v];
    if (look_up(view, p.x(), p.y(), p.z()).visible < 1) return false;
    low = low.min(p.head<2>().array());
    high = high.max(p.head<2>().array());
  }
  // In pixels of the confidence map, with one more for interpolation and the band around the triangle.
  const int x0 = static_cast<int>(std::floor(0.5F * low.x())) - 1, x1 = static_cast<int>(0.5F * high.x()) + 1;
  const int y0 = static_cast<int>(std::floor(0.5F * low.y())) - 1, y1 = static_cast<int>(0.5F * high.y()) + 1;
  if (!view.confidence.contains(x0, y0) || !view.confidence.contains(x1, y1)) return false;
  for (int y = y0; y <= y1; ++y) {
    const uint8_t* row = view.confidence.pixel(0, y);
    if (std::any_of(row + x0, row + x1 + 1, [](uint8_t confidence) { return confidence < 255; })) return false;
  }
  return true;
}

/// One triangle, ready to colour its texels.
class TrianglePainter {
 public:
  TrianglePainter(const Mesh& mesh, size_t t, const std::array<Eigen::Vector2d, 3>& corners,
                  std::span<const PreparedView> views, const CameraRatings& ratings,
                  std::span<const Eigen::Array3f> fallback, float usual) {
    const auto& triangle = mesh.triangles[t];
    for (size_t k = 0; k < 3; ++k) fallback_[k] = fallback[triangle[k]];
    const Eigen::Vector2d ab = corners[1] - corners[0], ac = corners[2] - corners[0];
    const float area_texels = 0.5F * static_cast<float>(std::abs(ab.x() * ac.y() - ab.y() * ac.x()));
    const Eigen::Vector3f e = mesh.positions[triangle[1]] - mesh.positions[triangle[0]];
    const Eigen::Vector3f f = mesh.positions[triangle[2]] - mesh.positions[triangle[0]];
    const float area_m2 = 0.5F * e.cross(f).norm();
    const float texels_per_m2 = area_m2 > 0 ? area_texels / area_m2 : 0;
    for (size_t c = 0; c < views.size(); ++c) {
      Camera camera;
      camera.view = c;
      bool usable = true;
      for (size_t k = 0; k < 3; ++k) {
        const Eigen::Vector3f& p = views[c].projected[triangle[k]];
        usable = usable && p.z() > 0;
        camera.rating[k] = ratings.vertex(triangle[k])[c] / usual;
        camera.depth[k] = p.z();
        camera.x_depth[k] = p.x() * p.z();
        camera.y_depth[k] = p.y() * p.z();
      }
      camera.most = *std::max_element(camera.rating.begin(), camera.rating.end());
      if (!usable || !(camera.most > 0)) continue;
      camera.lod = lod_of((camera.rating[0] + camera.rating[1] + camera.rating[2]) / 3 * usual, texels_per_m2);
      camera.certain = certainly_seen(views[c], triangle);
      cameras_.push_back(camera);
    }
    if (cameras_.size() > most_cameras) {
      std::stable_sort(cameras_.begin(), cameras_.end(),
                       [](const Camera& l, const Camera& r) { return l.most > r.most; });
      cameras_.resize(most_cameras);
    }
  }

  Eigen::Array3f colour(const Eigen::Vector3f& barycentric, const Blender& blend) const {
    std::array<Observation, most_cameras> seen;
    size_t count = 0;
    const auto at = [&](const std::array<float, 3>& corner) {
      return barycentric[0] * corner[0] + barycentric[1] * corner[1] + barycentric[2] * corner[2];
    };
    for (const Camera& camera : cameras_) {
      const float rating = at(camera.rating), depth = at(camera.depth);
      if (!(rating > 0) || !(depth > 0)) continue;
      seen[count++] = {camera.view, rating,        at(camera.x_depth) / depth, at(camera.y_depth) / depth, depth,
                       camera.lod,  camera.certain};
    }
    const Evidence evidence = blend(std::span(seen).first(count));
    if (evidence.share >= 1) return evidence.light;
    const Eigen::Array3f diffused =
        barycentric[0] * fallback_[0] + barycentric[1] * fallback_[1] + barycentric[2] * fallback_[2];
    return evidence.share * evidence.light + (1 - evidence.share) * diffused;
  }

 private:
  struct Camera {
    size_t view = 0;
    std::array<float, 3> rating{}, depth{}, x_depth{}, y_depth{};  ///< at the corners
    float most = 0, lod = 0;
    bool certain = false;
  };
  std::vector<Camera> cameras_;
  std::array<Eigen::Array3f, 3> fallback_;
};

/// A triangle in the atlas: which texels it has, and where on it they lie.
struct FlatTriangle {
  std::array<Eigen::Vector2f, 3> corners;          ///< so that a texel's centre is a whole number
  Eigen::Matrix3f barycentric_from_texel;          ///< applied to (x, y, 1)
  int left = 0, right = -1, top = 0, bottom = -1;  ///< with the band, inclusive; not cropped to the atlas
  bool flat = false;                               ///< too thin to hold a texel

  explicit FlatTriangle(const std::array<Eigen::Vector2d, 3>& placed) {
    Eigen::Matrix3d corner_columns;
    Eigen::Array2d low = placed[0], high = placed[0];
    for (size_t k = 0; k < 3; ++k) {
      const Eigen::Vector2d p = placed[k] - Eigen::Vector2d::Constant(0.5);
      corners[k] = p.cast<float>();
      corner_columns.col(static_cast<Eigen::Index>(k)) << p, 1;
      low = low.min(p.array());
      high = high.max(p.array());
    }
    constexpr double least_area = 1e-4;  // texels²
    flat = std::abs(corner_columns.determinant()) < least_area;
    barycentric_from_texel =
        flat ? Eigen::Matrix3f(Eigen::Matrix3f::Zero()) : Eigen::Matrix3f(corner_columns.inverse().cast<float>());
    if (flat) barycentric_from_texel.col(2).setConstant(1.0F / 3);
    left = static_cast<int>(std::ceil(low.x() - static_cast<double>(band_texels)));
    right = static_cast<int>(std::floor(high.x() + static_cast<double>(band_texels)));
    top = static_cast<int>(std::ceil(low.y() - static_cast<double>(band_texels)));
    bottom = static_cast<int>(std::floor(high.y() + static_cast<double>(band_texels)));
  }

  Eigen::Vector3f barycentric(int x, int y) const {
    return barycentric_from_texel * Eigen::Vector3f(static_cast<float>(x), static_cast<float>(y), 1);
  }
  /// To the nearest edge.
  float squared_distance(int x, int y) const {
    const Eigen::Vector2f p(static_cast<float>(x), static_cast<float>(y));
    float nearest = std::numeric_limits<float>::infinity();
    for (size_t k = 0; k < 3; ++k) {
      const Eigen::Vector2f edge = corners[(k + 1) % 3] - corners[k], to_p = p - corners[k];
      const float length2 = edge.squaredNorm();
      const float t = length2 > 0 ? std::clamp(to_p.dot(edge) / length2, 0.0F, 1.0F) : 0;
      nearest = std::min(nearest, (to_p - t * edge).squaredNorm());
    }
    return nearest;
  }
};

/// Rows of the atlas that are coloured in one piece.
class Stripe {
 public:
  Stripe(int size, int first_row, int rows)
      : size_(size),
        first_row_(first_row),
        rows_(rows),
        owner_(static_cast<size_t>(size) * static_cast<size_t>(rows), nobody),
        distance2_(owner_.size(), std::numeric_limits<float>::infinity()) {}

  /// Texels with their centre in the triangle; of two triangles that share the centre on an edge, the first.
  void claim_inside(int32_t t, const FlatTriangle& triangle) {
    if (triangle.flat) return;
    for_each_texel(triangle, [&](int x, int y, size_t i) {
      if (owner_[i] != nobody || !(triangle.barycentric(x, y).minCoeff() >= 0)) return;
      owner_[i] = t;
      distance2_[i] = 0;
      ++inside_;
    });
  }
  /// Texels around, for the nearest triangle.
  void claim_band(int32_t t, const FlatTriangle& triangle) {
    for_each_texel(triangle, [&](int x, int y, size_t i) {
      if (!(distance2_[i] > 0)) return;
      const float distance2 = triangle.squared_distance(x, y);
      if (!(distance2 <= band_texels * band_texels) || !(distance2 < distance2_[i])) return;
      owner_[i] = t;
      distance2_[i] = distance2;
    });
  }
  /// Calls paint(x, y) for the triangle's texels.
  template <class Paint>
  void for_each_owned(int32_t t, const FlatTriangle& triangle, const Paint& paint) const {
    for_each_texel(triangle, [&](int x, int y, size_t i) {
      if (owner_[i] == t) paint(x, y);
    });
  }
  size_t inside() const { return inside_; }

 private:
  static constexpr int32_t nobody = -1;

  template <class Visitor>
  void for_each_texel(const FlatTriangle& triangle, const Visitor& visit) const {
    const int y0 = std::max(triangle.top, first_row_), y1 = std::min(triangle.bottom, first_row_ + rows_ - 1);
    const int x0 = std::max(triangle.left, 0), x1 = std::min(triangle.right, size_ - 1);
    for (int y = y0; y <= y1; ++y)
      for (int x = x0; x <= x1; ++x)
        visit(x, y, static_cast<size_t>(y - first_row_) * static_cast<size_t>(size_) + static_cast<size_t>(x));
  }

  int size_, first_row_, rows_;
  std::vector<int32_t> owner_;
  std::vector<float> distance2_;
  size_t inside_ = 0;
};

/// Continued far beyond a thin triangle, a point would lie anywhere: keep to its surroundings.
Eigen::Vector3f near_triangle(Eigen::Vector3f barycentric) {
  constexpr float beyond = 0.5F;
  barycentric = barycentric.cwiseMax(-beyond).cwiseMin(1 + beyond);
  return barycentric / barycentric.sum();
}

}  // namespace

TexelColours blend_texels(const Mesh& mesh, const Packing& packing, int size, std::span<const PreparedView> views,
                          const CameraRatings& ratings, std::span<const Eigen::Array3f> gains, Blending blending,
                          const Work& work) {
  const Blender blend(views, gains, blending);
  const float usual = usual_rating(ratings, mesh.positions.size());
  const std::vector<Eigen::Array3f> fallback = colour_vertices(mesh, views, ratings, blend, usual);

  constexpr int stripe_rows = 32;
  const auto stripes = static_cast<size_t>((size + stripe_rows - 1) / stripe_rows);
  std::vector<std::vector<int32_t>> triangles_of(stripes);
  for (size_t t = 0; t < mesh.triangles.size(); ++t) {
    const FlatTriangle triangle(packing.corners[t]);
    const int first = std::clamp(triangle.top, 0, size - 1) / stripe_rows;
    const int last = std::clamp(triangle.bottom, 0, size - 1) / stripe_rows;
    for (int s = first; s <= last; ++s) triangles_of[static_cast<size_t>(s)].push_back(static_cast<int32_t>(t));
  }

  TexelColours result{Image(size, size, 3), Image(size, size, 1), 0};
  std::vector<size_t> inside(stripes, 0);
  work.parallel_for(stripes, 1, [&](size_t begin, size_t end) {
    for (size_t s = begin; s < end; ++s) {
      const int first_row = static_cast<int>(s) * stripe_rows;
      Stripe stripe(size, first_row, std::min(stripe_rows, size - first_row));
      std::vector<FlatTriangle> flat;
      for (const int32_t t : triangles_of[s]) flat.emplace_back(packing.corners[static_cast<size_t>(t)]);
      for (size_t i = 0; i < flat.size(); ++i) stripe.claim_inside(triangles_of[s][i], flat[i]);
      for (size_t i = 0; i < flat.size(); ++i) stripe.claim_band(triangles_of[s][i], flat[i]);
      for (size_t i = 0; i < flat.size(); ++i) {
        const auto t = static_cast<size_t>(triangles_of[s][i]);
        const TrianglePainter painter(mesh, t, packing.corners[t], views, ratings, fallback, usual);
        stripe.for_each_owned(triangles_of[s][i], flat[i], [&](int x, int y) {
          const Eigen::Array3f light = painter.colour(near_triangle(flat[i].barycentric(x, y)), blend);
          for (int c = 0; c < 3; ++c) result.image.at(x, y, c) = srgb_from_linear(light[c]);
          result.painted.at(x, y) = 255;
        });
      }
      inside[s] = stripe.inside();
    }
  });
  size_t used = 0;
  for (const size_t count : inside) used += count;
  result.used_share = static_cast<double>(used) / (static_cast<double>(size) * size);
  return result;
}

}  // namespace booth
