#include "pipeline/face/surface_matching.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <optional>

#include "pipeline/face/ray_caster.h"

namespace booth {
namespace {

double median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Samples of a surface in rows from above and columns around the head.
struct SurfaceGrid {
  int width = 0, height = 0;
  std::vector<uint8_t> known;
  std::vector<uint32_t> triangle;
  std::vector<Eigen::Vector3f> weights, place, normal;
  size_t size() const { return known.size(); }
};

SurfaceGrid sample_surface(const Mesh& surface, const std::vector<Eigen::Vector3f>& normals, const RayCaster& rays,
                           const Eigen::Isometry3d& world_from_head, double spacing_m, const Work& work) {
  constexpr double widest_rad = 1.4, outside_m = 0.3;
  const Eigen::Isometry3d head_from_world = world_from_head.inverse();
  double low = 0, high = 0, radius = 0;
  for (const Eigen::Vector3f& p : surface.positions) {
    const Eigen::Vector3d at = head_from_world * p.cast<double>();
    low = std::min(low, at.y());
    high = std::max(high, at.y());
    radius = std::max(radius, std::abs(at.x()));
  }
  SurfaceGrid grid;
  const double turn = spacing_m / std::max(radius, 1e-3);
  grid.width = static_cast<int>(2 * widest_rad / turn) + 1;
  grid.height = static_cast<int>((high - low) / spacing_m) + 1;
  const size_t count = static_cast<size_t>(grid.width) * static_cast<size_t>(grid.height);
  grid.known.assign(count, 0);
  grid.triangle.assign(count, 0);
  for (auto* values : {&grid.weights, &grid.place, &grid.normal}) values->assign(count, Eigen::Vector3f::Zero());
  work.parallel_for(static_cast<size_t>(grid.height), 8, [&](size_t begin, size_t end) {
    for (size_t row = begin; row < end; ++row)
      for (int column = 0; column < grid.width; ++column) {
        const double angle = column * turn - widest_rad, y = high - static_cast<double>(row) * spacing_m;
        const Eigen::Vector3d outwards(std::sin(angle), 0, std::cos(angle));
        const Eigen::Vector3f from =
            (world_from_head * Eigen::Vector3d(outside_m * outwards + Eigen::Vector3d(0, y, 0))).cast<float>();
        const Eigen::Vector3f way = (world_from_head.linear() * -outwards).cast<float>();
        const auto hit = rays.cast(from, way, 0, static_cast<float>(outside_m));
        if (!hit) continue;
        const auto& [a, b, c] = surface.triangles[hit->triangle];
        const Eigen::Vector3f &pa = surface.positions[a], &pb = surface.positions[b], &pc = surface.positions[c];
        const Eigen::Vector3f across = (pb - pa).cross(pc - pa), at = from + hit->distance_m * way;
        const float whole = across.squaredNorm();
        if (!(whole > 0)) continue;
        const float wb = (pc - pa).cross(pa - at).dot(across) / whole,
                    wc = (pa - at).cross(pb - pa).dot(across) / whole;
        const size_t i = row * static_cast<size_t>(grid.width) + static_cast<size_t>(column);
        grid.weights[i] = {1 - wb - wc, wb, wc};
        grid.place[i] = at;
        grid.normal[i] = ((1 - wb - wc) * normals[a] + wb * normals[b] + wc * normals[c]).normalized();
        grid.triangle[i] = hit->triangle;
        grid.known[i] = 1;
      }
  });
  return grid;
}

/// What one picture shows on the surface as it is moved along its normals.
struct SweptView {
  Eigen::Vector3d eye;
  std::vector<float> visible;  ///< per sample, 1 or 0
  /// Of luma and of what is free of highlights: per step, per sample; 0 where it is not visible.
  std::array<std::vector<std::vector<float>>, 2> shades;
};

std::vector<uint8_t> visible_vertices(const Mesh& surface, const std::vector<Eigen::Vector3f>& normals,
                                      const RayCaster& rays, const Eigen::Vector3f& eye) {
  std::vector<uint8_t> visible(surface.positions.size(), 0);
  for (size_t v = 0; v < visible.size(); ++v) {
    const Eigen::Vector3f way = (eye - surface.positions[v]).normalized();
    constexpr float least_cosine = 0.35F, off_m = 0.001F, head_m = 0.4F;
    if (way.dot(normals[v]) < least_cosine) continue;
    visible[v] = rays.cast(surface.positions[v] + off_m * normals[v], way, 0, head_m) ? 0 : 1;
  }
  return visible;
}

SweptView sweep(const FacePicture& face, const SurfaceGrid& grid, const Mesh& surface,
                const std::vector<uint8_t>& vertices, int steps, double step_m) {
  const PinholePicture& picture = face.pinhole;
  const Intrinsics& k = picture.view.intrinsics;
  const Eigen::Matrix3f turn = picture.view.camera_from_world.linear().cast<float>();
  const Eigen::Vector3f shift = picture.view.camera_from_world.translation().cast<float>();
  const auto fx = static_cast<float>(k.fx), fy = static_cast<float>(k.fy), cx = static_cast<float>(k.cx),
             cy = static_cast<float>(k.cy);
  SweptView view;
  view.eye = picture.view.center();
  view.visible.assign(grid.size(), 0);
  for (auto& shades : view.shades)
    shades.assign(static_cast<size_t>(2 * steps + 1), std::vector<float>(grid.size(), 0));
  for (size_t i = 0; i < grid.size(); ++i) {
    if (grid.known[i] == 0) continue;
    const auto& corners = surface.triangles[grid.triangle[i]];
    if (std::any_of(corners.begin(), corners.end(), [&](uint32_t v) { return vertices[v] == 0; })) continue;
    const Eigen::Vector3f at = turn * grid.place[i] + shift, way = turn * grid.normal[i];
    bool inside = true;
    for (int s = -steps; s <= steps && inside; ++s) {
      const Eigen::Vector3f p = at + static_cast<float>(s * step_m) * way;
      const float x = fx * p.x() / p.z() + cx, y = fy * p.y() / p.z() + cy;
      inside =
          p.z() > 0 && x >= 0 && y >= 0 && x < static_cast<float>(k.width - 1) && y < static_cast<float>(k.height - 1);
      if (!inside) break;
      const int left = static_cast<int>(x), top = static_cast<int>(y);
      const float u = x - static_cast<float>(left), v = y - static_cast<float>(top);
      const auto between = [&](const auto& image) {
        const auto* upper = image.pixel(left, top);
        const auto* lower = image.pixel(left, top + 1);
        return (1 - v) * ((1 - u) * static_cast<float>(upper[0]) + u * static_cast<float>(upper[1])) +
               v * ((1 - u) * static_cast<float>(lower[0]) + u * static_cast<float>(lower[1]));
      };
      constexpr float of_grey_levels = 1000;
      view.shades[0][static_cast<size_t>(s + steps)][i] = between(picture.grey);
      view.shades[1][static_cast<size_t>(s + steps)][i] = of_grey_levels * between(face.matte);
    }
    if (inside)
      view.visible[i] = 1;
    else
      for (auto& channel : view.shades)
        for (auto& shades : channel) shades[i] = 0;
  }
  return view;
}

/// Sums over square windows that are made of blocks: as many to each side of every corner that four blocks share.
class WindowSums {
 public:
  /// @param block  samples of a block, across and down
  /// @param reach  blocks from a window's middle to its rim
  WindowSums(int width, int height, int block, int reach)
      : width_(width), block_(block), reach_(reach), columns_(width / block), rows_(height / block) {
    blocks_.resize(static_cast<size_t>(columns_) * static_cast<size_t>(rows_));
    line_.resize(static_cast<size_t>(width));
  }
  /// A window for every block, whose first sample is its middle.
  int columns() const { return columns_; }
  int rows() const { return rows_; }
  float samples() const { return static_cast<float>(4 * reach_ * reach_ * block_ * block_); }

  template <class Value>
  void sum(Value&& value, std::vector<float>* sums) {
    for (int row = 0; row < rows_; ++row) {
      std::fill(line_.begin(), line_.end(), 0.0F);
      for (int y = row * block_; y < (row + 1) * block_; ++y) {
        const size_t begin = static_cast<size_t>(y) * static_cast<size_t>(width_);
        for (size_t x = 0; x < line_.size(); ++x) line_[x] += value(begin + x);
      }
      for (int column = 0; column < columns_; ++column) {
        const auto first = line_.begin() + column * block_;
        blocks_[index(column, row)] = std::accumulate(first, first + block_, 0.0F);
      }
    }
    sums->assign(blocks_.size(), 0);
    for (int row = reach_; row + reach_ <= rows_; ++row)
      for (int column = reach_; column + reach_ <= columns_; ++column) {
        float whole = 0;
        for (int y = row - reach_; y < row + reach_; ++y)
          for (int x = column - reach_; x < column + reach_; ++x) whole += blocks_[index(x, y)];
        (*sums)[index(column, row)] = whole;
      }
  }

 private:
  size_t index(int column, int row) const {
    return static_cast<size_t>(row) * static_cast<size_t>(columns_) + static_cast<size_t>(column);
  }
  int width_, block_, reach_, columns_, rows_;
  std::vector<float> blocks_, line_;
};

/// Correlations of two views, per step and window; nothing in a window: below −1.
constexpr float no_correlation = -2;
std::vector<std::vector<float>> correlate(const SweptView& a, const SweptView& b, size_t channel, WindowSums windows) {
  std::vector<float> count, of_a, of_b, of_aa, of_bb, of_ab;
  windows.sum([&](size_t i) { return a.visible[i] * b.visible[i]; }, &count);
  std::vector<std::vector<float>> correlations(a.shades[channel].size());
  for (size_t s = 0; s < correlations.size(); ++s) {
    const float *pa = a.shades[channel][s].data(), *pb = b.shades[channel][s].data(), *va = a.visible.data(),
                *vb = b.visible.data();
    windows.sum([=](size_t i) { return pa[i] * vb[i]; }, &of_a);
    windows.sum([=](size_t i) { return pb[i] * va[i]; }, &of_b);
    windows.sum([=](size_t i) { return pa[i] * pa[i] * vb[i]; }, &of_aa);
    windows.sum([=](size_t i) { return pb[i] * pb[i] * va[i]; }, &of_bb);
    windows.sum([=](size_t i) { return pa[i] * pb[i]; }, &of_ab);
    correlations[s].assign(count.size(), no_correlation);
    for (size_t i = 0; i < count.size(); ++i) {
      constexpr float enough = 0.6F, least_contrast = 2;  // of the window; grey levels
      if (count[i] < enough * windows.samples()) continue;
      const float n = count[i], mean_a = of_a[i] / n, mean_b = of_b[i] / n;
      const float var_a = of_aa[i] / n - mean_a * mean_a, var_b = of_bb[i] / n - mean_b * mean_b;
      if (!(std::min(var_a, var_b) > least_contrast * least_contrast)) continue;
      correlations[s][i] = (of_ab[i] / n - mean_a * mean_b) / std::sqrt(var_a * var_b);
    }
  }
  return correlations;
}

/// The best step, between steps; nothing where it is not clear.
struct Peak {
  double step = 0;
  double information = 0;  ///< of the step: 1 / its variance
  size_t nearest = 0;      ///< whole step
};
/// @param likelihood  its logarithm, per step
std::optional<Peak> peak_of(const std::vector<double>& likelihood) {
  const auto last = static_cast<int>(likelihood.size()) - 1;
  const auto top = static_cast<int>(std::max_element(likelihood.begin(), likelihood.end()) - likelihood.begin());
  if (top == 0 || top == last) return std::nullopt;
  const auto at = [&](int s) { return likelihood[static_cast<size_t>(s)]; };
  // A second place that is nearly as likely, with a less likely one between, leaves it open which it is.
  constexpr double distinct = 2;
  for (const int direction : {-1, 1}) {
    double lowest = at(top);
    for (int s = top + direction; s >= 0 && s <= last; s += direction) {
      lowest = std::min(lowest, at(s));
      if (at(s) > at(top) - distinct && at(s) > lowest + distinct / 2) return std::nullopt;
    }
  }
  const double bend = 2 * at(top) - at(top - 1) - at(top + 1);
  if (!(bend > 0)) return std::nullopt;
  return Peak{top - last / 2 + (at(top + 1) - at(top - 1)) / (2 * bend), bend, static_cast<size_t>(top)};
}

}  // namespace

std::vector<SurfaceMatch> match_surface(std::span<const FacePicture> pictures, const Mesh& surface,
                                        const Eigen::Isometry3d& world_from_head, const SurfaceMatchOptions& options,
                                        const Work& work) {
  std::vector<SurfaceMatch> matches;
  if (pictures.size() < 2 || surface.triangles.empty()) return matches;
  std::vector<double> pixels;
  for (const FacePicture& picture : pictures)
    pixels.push_back((picture.pinhole.view.center() - world_from_head.translation()).norm() /
                     picture.pinhole.view.intrinsics.fx);
  const double pixel_m = median(pixels);
  constexpr double samples_per_pixel = 1.25, least_pixels = 3;
  const double spacing_m = std::max(options.spacing_m, pixel_m / samples_per_pixel);
  const double half_m = std::max(options.half_window_m, least_pixels * pixel_m);
  constexpr int reach = 2;  // half a window, blocks
  const int block = std::max(1, static_cast<int>(std::lround(half_m / (reach * spacing_m))));
  const int steps = std::max(2, static_cast<int>(std::lround(options.range_m / options.step_m)));

  const std::vector<Eigen::Vector3f> normals = vertex_normals(surface);
  const RayCaster rays(surface);
  const SurfaceGrid grid = sample_surface(surface, normals, rays, world_from_head, spacing_m, work);
  std::vector<SweptView> views(pictures.size());
  work.parallel_for(pictures.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i)
      views[i] = sweep(pictures[i], grid, surface,
                       visible_vertices(surface, normals, rays, pictures[i].pinhole.view.center().cast<float>()), steps,
                       options.step_m);
  });
  if (work.stopped()) return matches;

  std::vector<std::array<size_t, 2>> pairs;
  for (size_t a = 0; a < views.size(); ++a)
    for (size_t b = a + 1; b < views.size(); ++b) {
      const Eigen::Vector3d to_a = (views[a].eye - world_from_head.translation()).normalized();
      const Eigen::Vector3d to_b = (views[b].eye - world_from_head.translation()).normalized();
      constexpr double closest = 0.99, farthest = 0.47;  // cos 8°: no depth; cos 62°: skin looks too different
      if (to_a.dot(to_b) < closest && to_a.dot(to_b) > farthest) pairs.push_back({a, b});
    }
  const WindowSums windows(grid.width, grid.height, block, reach);
  std::vector<std::vector<std::vector<float>>> correlations(2 * pairs.size());
  work.parallel_for(correlations.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i)
      correlations[i] = correlate(views[pairs[i / 2][0]], views[pairs[i / 2][1]], i % 2, windows);
  });
  if (work.stopped()) return matches;

  // What differs between two patches of n pixels by noise of unknown strength has the likelihood (1 − c)^(−n/2).
  // Errors are alike over some pixels: highlights, lenses, compression.
  constexpr double alike_px = 2.5, never_alike = 0.01;
  std::vector<double> pixels_of_pair;
  for (const auto& [a, b] : pairs)
    pixels_of_pair.push_back(std::max(1.0, std::pow(2 * half_m / (alike_px * std::max(pixels[a], pixels[b])), 2)));
  constexpr double overlap = 2 * reach;  // so many windows share a block's width
  std::vector<double> likelihood(static_cast<size_t>(2 * steps + 1)), correlation(likelihood.size());
  for (int row = 0; row < windows.rows(); ++row)
    for (int column = 0; column < windows.columns(); ++column) {
      const size_t i =
          static_cast<size_t>(row * block) * static_cast<size_t>(grid.width) + static_cast<size_t>(column * block);
      if (grid.known[i] == 0) continue;
      const size_t w = static_cast<size_t>(row) * static_cast<size_t>(windows.columns()) + static_cast<size_t>(column);
      std::fill(likelihood.begin(), likelihood.end(), 0.0);
      std::fill(correlation.begin(), correlation.end(), 0.0);
      int seen = 0;
      for (size_t p = 0; p < correlations.size(); ++p) {
        const auto& of = correlations[p];
        if (std::any_of(of.begin(), of.end(), [&](const auto& step) { return step[w] < -1; })) continue;
        for (size_t s = 0; s < likelihood.size(); ++s) {
          const auto c = static_cast<double>(of[s][w]);
          likelihood[s] -= pixels_of_pair[p / 2] / 2 * std::log(1 - c + never_alike);
          correlation[s] += c;
        }
        ++seen;
      }
      if (seen == 0) continue;
      // So many views make so many pairs, but one less than views is what they tell independently.
      const double views_seen = (1 + std::sqrt(1.0 + 4.0 * seen)) / 2;
      for (double& l : likelihood) l *= 2 / views_seen;
      const auto peak = peak_of(likelihood);
      if (!peak || correlation[peak->nearest] < options.least_correlation * seen) continue;
      constexpr double calibration_m = 0.0005;
      matches.push_back({.vertex = surface.triangles[grid.triangle[i]],
                         .weights = grid.weights[i],
                         .normal = grid.normal[i],
                         .along_m = peak->step * options.step_m,
                         .sigma_m = std::hypot(calibration_m, overlap * options.step_m / std::sqrt(peak->information)),
                         .correlation = correlation[peak->nearest] / seen});
    }
  return matches;
}

}  // namespace booth
