#include "pipeline/face/surface_matching.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
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

/// Sums of one view's values, of another's, of their squares and of their product, where both see the surface.
enum Moment : size_t { of_a, of_b, of_aa, of_bb, of_ab, moments };

/// Adds a row of samples to a line for each moment.
void add_moments(const float* __restrict a, const float* __restrict b, const float* __restrict both, size_t count,
                 float* __restrict line_a, float* __restrict line_b, float* __restrict line_aa,
                 float* __restrict line_bb, float* __restrict line_ab) {
  for (size_t x = 0; x < count; ++x) {
    const float va = a[x] * both[x], vb = b[x] * both[x];
    line_a[x] += va;
    line_b[x] += vb;
    line_aa[x] += va * va;
    line_bb[x] += vb * vb;
    line_ab[x] += va * vb;
  }
}

/// The square windows of a grid, made of blocks: as many to each side of every corner that four blocks share.
class WindowGrid {
 public:
  /// @param block  samples of a block, across and down
  /// @param reach  blocks from a window's middle to its rim
  WindowGrid(int width, int height, int block, int reach)
      : width_(width), block_(block), reach_(reach), columns_(width / block), rows_(height / block) {}
  /// A window for every block, whose first sample is its middle.
  int columns() const { return columns_; }
  int rows() const { return rows_; }
  int block() const { return block_; }
  int width() const { return width_; }
  int reach() const { return reach_; }
  size_t size() const { return static_cast<size_t>(columns_) * static_cast<size_t>(rows_); }
  float samples() const { return static_cast<float>(4 * reach_ * reach_ * block_ * block_); }
  size_t index(int column, int row) const {
    return static_cast<size_t>(row) * static_cast<size_t>(columns_) + static_cast<size_t>(column);
  }
  size_t sample(int column, int row) const {
    return static_cast<size_t>(row * block_) * static_cast<size_t>(width_) + static_cast<size_t>(column * block_);
  }

  /// The sum over a window of what its blocks hold.
  float sum(const std::vector<float>& blocks, int column, int row) const {
    float whole = 0;
    for (int y = row - reach_; y < row + reach_; ++y)
      for (int x = column - reach_; x < column + reach_; ++x) whole += blocks[index(x, y)];
    return whole;
  }

 private:
  int width_, block_, reach_, columns_, rows_;
};

/// Compares two views, window by window, where enough of a window is seen by both.
class Comparison {
 public:
  Comparison(const SweptView& a, const SweptView& b, const WindowGrid& windows)
      : a_(a), b_(b), windows_(windows), both_(a.visible.size()), spans_(static_cast<size_t>(windows.rows())) {
    for (size_t i = 0; i < both_.size(); ++i) both_[i] = a.visible[i] * b.visible[i];
    std::vector<float> blocks(windows_.size());
    for (int row = 0; row < windows_.rows(); ++row)
      for (int column = 0; column < windows_.columns(); ++column) {
        float& count = blocks[windows_.index(column, row)];
        for (int y = 0; y < windows_.block(); ++y) {
          const auto first = both_.begin() + static_cast<std::ptrdiff_t>(windows_.sample(column, row)) +
                             static_cast<std::ptrdiff_t>(y) * windows_.width();
          count = std::accumulate(first, first + windows_.block(), count);
        }
      }
    for (int row = windows_.reach(); row + windows_.reach() <= windows_.rows(); ++row)
      for (int column = windows_.reach(); column + windows_.reach() <= windows_.columns(); ++column) {
        constexpr float enough = 0.6F;
        const float count = windows_.sum(blocks, column, row);
        if (count < enough * windows_.samples()) continue;
        compared_.push_back({column, row, count});
        for (int y = row - windows_.reach(); y < row + windows_.reach(); ++y) {
          Span& span = spans_[static_cast<size_t>(y)];
          span.begin = std::min(span.begin, column - windows_.reach());
          span.end = std::max(span.end, column + windows_.reach());
        }
      }
  }

  /// Correlations per step and window.
  std::vector<std::vector<float>> correlate(size_t channel) const {
    std::vector<std::vector<float>> correlations(a_.shades[channel].size());
    std::array<std::vector<float>, moments> blocks, lines;
    for (auto& of : blocks) of.assign(windows_.size(), 0);
    for (auto& of : lines) of.resize(static_cast<size_t>(windows_.width()));
    for (size_t s = 0; s < correlations.size(); ++s) {
      sum_blocks(a_.shades[channel][s].data(), b_.shades[channel][s].data(), &lines, &blocks);
      correlations[s].assign(windows_.size(), no_correlation);
      for (const auto& [column, row, n] : compared_) {
        std::array<float, moments> mean{};
        for (size_t m = 0; m < moments; ++m) mean[m] = windows_.sum(blocks[m], column, row) / n;
        constexpr float least_contrast = 2;  // of the window; grey levels
        const float var_a = mean[of_aa] - mean[of_a] * mean[of_a], var_b = mean[of_bb] - mean[of_b] * mean[of_b];
        if (std::min(var_a, var_b) > least_contrast * least_contrast)
          correlations[s][windows_.index(column, row)] =
              (mean[of_ab] - mean[of_a] * mean[of_b]) / std::sqrt(var_a * var_b);
      }
    }
    return correlations;
  }

  static constexpr float no_correlation = -2;  ///< of windows without: below −1

 private:
  struct Window {
    int column, row;
    float count;  ///< samples that both see
  };
  struct Span {
    int begin = std::numeric_limits<int>::max(), end = 0;  ///< columns of blocks that windows are made of
  };

  void sum_blocks(const float* a, const float* b, std::array<std::vector<float>, moments>* lines,
                  std::array<std::vector<float>, moments>* blocks) const {
    for (int row = 0; row < windows_.rows(); ++row) {
      const auto [begin, end] = spans_[static_cast<size_t>(row)];
      if (begin >= end) continue;
      for (auto& line : *lines) std::fill(line.begin(), line.end(), 0.0F);
      for (int y = 0; y < windows_.block(); ++y) {
        const size_t at = windows_.sample(begin, row) + static_cast<size_t>(y) * static_cast<size_t>(windows_.width());
        add_moments(a + at, b + at, both_.data() + at, static_cast<size_t>((end - begin) * windows_.block()),
                    (*lines)[of_a].data(), (*lines)[of_b].data(), (*lines)[of_aa].data(), (*lines)[of_bb].data(),
                    (*lines)[of_ab].data());
      }
      for (size_t m = 0; m < moments; ++m)
        for (int column = begin; column < end; ++column) {
          const auto first = (*lines)[m].begin() + (column - begin) * windows_.block();
          (*blocks)[m][windows_.index(column, row)] = std::accumulate(first, first + windows_.block(), 0.0F);
        }
    }
  }

  const SweptView &a_, &b_;
  const WindowGrid& windows_;
  std::vector<float> both_;
  std::vector<Span> spans_;  ///< per row of blocks
  std::vector<Window> compared_;
};

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
  const WindowGrid windows(grid.width, grid.height, block, reach);
  std::vector<std::vector<std::vector<float>>> correlations(2 * pairs.size());
  work.parallel_for(pairs.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end && !work.stopped(); ++i) {
      const Comparison comparison(views[pairs[i][0]], views[pairs[i][1]], windows);
      for (size_t channel = 0; channel < 2; ++channel) correlations[2 * i + channel] = comparison.correlate(channel);
    }
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
      const size_t i = windows.sample(column, row);
      if (grid.known[i] == 0) continue;
      const size_t w = windows.index(column, row);
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
