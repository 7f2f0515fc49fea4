#include "pipeline/atlas/texel_painting.h"

#include <Eigen/LU>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "pipeline/atlas/linear_light.h"

namespace booth {
namespace {

/// Texels around a triangle that get its colours, continued beyond its edges.
constexpr float band_texels = 2.0F;

/// A triangle in the atlas: which texels it has, and where on it they lie.
struct FlatTriangle {
  /// Points p with inwards · p + offset ≥ −d lie at most d outside an edge's line.
  struct HalfPlane {
    Eigen::Vector2f inwards = Eigen::Vector2f::Zero();
    float offset = 0;
  };
  std::array<Eigen::Vector2f, 3> corners;  ///< so that a texel's centre is a whole number
  std::array<HalfPlane, 3> edges;
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
    if (!flat) set_edges();
    left = static_cast<int>(std::ceil(low.x() - static_cast<double>(band_texels)));
    right = static_cast<int>(std::floor(high.x() + static_cast<double>(band_texels)));
    top = static_cast<int>(std::ceil(low.y() - static_cast<double>(band_texels)));
    bottom = static_cast<int>(std::floor(high.y() + static_cast<double>(band_texels)));
  }

  /// The columns of a row, inclusive, outside of which no texel lies within `reach` of all edges' lines.
  std::pair<int, int> columns(int y, float reach) const {
    constexpr float rounding = 0.01F;  // texels
    float from = static_cast<float>(left), to = static_cast<float>(right);
    for (const HalfPlane& edge : edges) {
      const float at_zero = edge.inwards.y() * static_cast<float>(y) + edge.offset + reach + rounding;
      if (edge.inwards.x() > steep)
        from = std::max(from, -at_zero / edge.inwards.x() - rounding);
      else if (edge.inwards.x() < -steep)
        to = std::min(to, -at_zero / edge.inwards.x() + rounding);
    }
    return {static_cast<int>(std::ceil(from)), static_cast<int>(std::floor(to))};
  }

  bool holds(int x, int y) const {
    const auto u = static_cast<float>(x), v = static_cast<float>(y);
    bool all = true;
    for (Eigen::Index k = 0; k < 3; ++k)
      all &= barycentric_from_texel(k, 0) * u + barycentric_from_texel(k, 1) * v + barycentric_from_texel(k, 2) >= 0;
    return all;
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

 private:
  static constexpr float steep = 1e-3F;  ///< an edge along the rows bounds no columns

  void set_edges() {
    const Eigen::Vector2f ab = corners[1] - corners[0], ac = corners[2] - corners[0];
    const float turn = ab.x() * ac.y() - ab.y() * ac.x() > 0 ? 1.0F : -1.0F;
    for (size_t k = 0; k < 3; ++k) {
      const Eigen::Vector2f edge = corners[(k + 1) % 3] - corners[k];
      const float length = edge.norm();
      if (!(length > 0)) continue;
      edges[k].inwards = turn / length * Eigen::Vector2f(-edge.y(), edge.x());
      edges[k].offset = -edges[k].inwards.dot(corners[k]);
    }
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
    for_each_texel(triangle, 0, [&](int x, int y, size_t i) {
      if (owner_[i] != nobody || !triangle.holds(x, y)) return;
      owner_[i] = t;
      distance2_[i] = 0;
      ++inside_;
    });
  }
  /// Texels around, for the nearest triangle.
  void claim_band(int32_t t, const FlatTriangle& triangle) {
    for_each_texel(triangle, band_texels, [&](int x, int y, size_t i) {
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
    for_each_texel(triangle, band_texels, [&](int x, int y, size_t i) {
      if (owner_[i] == t) paint(x, y);
    });
  }
  size_t inside() const { return inside_; }

 private:
  static constexpr int32_t nobody = -1;

  template <class Visitor>
  void for_each_texel(const FlatTriangle& triangle, float reach, const Visitor& visit) const {
    const int y0 = std::max(triangle.top, first_row_), y1 = std::min(triangle.bottom, first_row_ + rows_ - 1);
    for (int y = y0; y <= y1; ++y) {
      const auto [from, to] = triangle.columns(y, reach);
      const int x0 = std::max(from, 0), x1 = std::min(to, size_ - 1);
      for (int x = x0; x <= x1; ++x)
        visit(x, y, static_cast<size_t>(y - first_row_) * static_cast<size_t>(size_) + static_cast<size_t>(x));
    }
  }

  int size_, first_row_, rows_;
  std::vector<int32_t> owner_;
  std::vector<float> distance2_;
  size_t inside_ = 0;
};

/// Collects a triangle's texels, has them painted and writes them.
class BatchWriter {
 public:
  BatchWriter(const FlatTriangle& triangle, const TrianglePainter& paint, TexelColours* result)
      : triangle_(triangle), paint_(paint), result_(result) {}

  void add(int x, int y) {
    x_[batch_.count] = static_cast<float>(x);
    y_[batch_.count] = static_cast<float>(y);
    if (++batch_.count == TexelBatch::capacity) flush();
  }
  void flush() {
    if (batch_.count == 0) return;
    find_corner_weights();
    paint_(batch_);
    for (size_t i = 0; i < batch_.count; ++i) {
      const int x = static_cast<int>(x_[i]), y = static_cast<int>(y_[i]);
      uint8_t* out = result_->image.pixel(x, y);
      for (Eigen::Index c = 0; c < 3; ++c) out[c] = srgb_from_linear(batch_.light[i][c]);
      result_->painted.at(x, y) = 255;
    }
    batch_.count = 0;
  }

 private:
  void find_corner_weights() {
    // Continued far beyond a thin triangle, a point would lie anywhere: keep to its surroundings.
    constexpr float beyond = 0.5F;
    const Eigen::Matrix3f& from_texel = triangle_.barycentric_from_texel;
    auto& [a, b, c] = batch_.corner_weights;
    for (Eigen::Index k = 0; k < 3; ++k) {
      auto& weights = batch_.corner_weights[static_cast<size_t>(k)];
      const float by_x = from_texel(k, 0), by_y = from_texel(k, 1), at_zero = from_texel(k, 2);
      for (size_t i = 0; i < batch_.count; ++i) {
        const float weight = by_x * x_[i] + by_y * y_[i] + at_zero;
        weights[i] = std::min(std::max(weight, -beyond), 1 + beyond);
      }
    }
    for (size_t i = 0; i < batch_.count; ++i) {
      const float scale = 1 / (a[i] + b[i] + c[i]);
      a[i] *= scale;
      b[i] *= scale;
      c[i] *= scale;
    }
  }

  const FlatTriangle& triangle_;
  const TrianglePainter& paint_;
  TexelColours* result_;
  TexelBatch batch_;
  TexelBatch::Each<float> x_, y_;
};

}  // namespace

TexelColours paint_texels(const Packing& packing, int size, const std::function<TrianglePainter(size_t)>& painter_of,
                          const Work& work) {
  constexpr int stripe_rows = 64;
  const auto stripes = static_cast<size_t>((size + stripe_rows - 1) / stripe_rows);
  std::vector<std::vector<int32_t>> triangles_of(stripes);
  for (size_t t = 0; t < packing.corners.size(); ++t) {
    const FlatTriangle triangle(packing.corners[t]);
    const int first = std::clamp(triangle.top, 0, size - 1) / stripe_rows;
    const int last = std::clamp(triangle.bottom, 0, size - 1) / stripe_rows;
    for (int s = first; s <= last; ++s) triangles_of[static_cast<size_t>(s)].push_back(static_cast<int32_t>(t));
  }

  TexelColours result{Image(size, size, 3), Image(size, size, 1), 0};
  std::vector<size_t> inside(stripes, 0);
  work.parallel_for(stripes, 1, [&](size_t begin, size_t end) {
    for (size_t s = begin; s < end && !work.stopped(); ++s) {
      const int first_row = static_cast<int>(s) * stripe_rows;
      Stripe stripe(size, first_row, std::min(stripe_rows, size - first_row));
      std::vector<FlatTriangle> flat;
      for (const int32_t t : triangles_of[s]) flat.emplace_back(packing.corners[static_cast<size_t>(t)]);
      for (size_t i = 0; i < flat.size(); ++i) stripe.claim_inside(triangles_of[s][i], flat[i]);
      for (size_t i = 0; i < flat.size(); ++i) stripe.claim_band(triangles_of[s][i], flat[i]);
      for (size_t i = 0; i < flat.size(); ++i) {
        const TrianglePainter paint = painter_of(static_cast<size_t>(triangles_of[s][i]));
        BatchWriter writer(flat[i], paint, &result);
        stripe.for_each_owned(triangles_of[s][i], flat[i], [&](int x, int y) { writer.add(x, y); });
        writer.flush();
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
