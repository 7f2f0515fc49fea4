#include "pipeline/refine/smooth_distance.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace booth {
namespace {

/// The cell size for which the stiffness and the share of the slopes are meant.
constexpr float unit_cell_m = 0.02F;
/// Of a sample's normal against its position.
constexpr float slope_share = 0.3F * unit_cell_m * unit_cell_m;
/// Draws every node to the hull's distance: just enough that nodes which nothing else holds have a value.
constexpr float attachment = 1e-6F;
/// Nodes outside the hull are used up to this many cells from it.
constexpr float outside_cells = 3;

/// Quadratic B-spline: the weights of the three nodes around a place along one axis, and their derivatives.
struct Spline {
  int first;
  std::array<float, 3> value, slope;
  explicit Spline(float x) {
    const float middle = std::round(x);
    const float t = x - middle;
    first = static_cast<int>(middle) - 1;
    value = {0.5F * (0.5F - t) * (0.5F - t), 0.75F - t * t, 0.5F * (0.5F + t) * (0.5F + t)};
    slope = {t - 0.5F, -2 * t, t + 0.5F};
  }
};

double dot(const std::vector<float>& a, const std::vector<float>& b) {
  double sum = 0;
  for (size_t n = 0; n < a.size(); ++n) sum += static_cast<double>(a[n]) * static_cast<double>(b[n]);
  return sum;
}

}  // namespace

SmoothDistance::SmoothDistance(const Field& hull, std::span<const HullSample> samples,
                               const SmoothDistanceOptions& options)
    : origin_(hull.grid().origin.cast<float>()),
      cell_m_(static_cast<float>(options.cell_m)),
      stiffness_(static_cast<float>(options.stiffness) * unit_cell_m / cell_m_),
      iterations_(options.iterations) {
  for (size_t axis = 0; axis < 3; ++axis)
    size_[axis] = static_cast<int>(std::ceil((hull.grid().size[axis] - 1) * hull.grid().voxel_m / options.cell_m)) + 1;
  find_nodes(hull, samples);
}

/// Every node takes over the neighbour's nearest sample where it is nearer than its own (after P.-E. Danielsson,
/// "Euclidean distance mapping", 1980), from the samples on through the whole inside and a little outside.
void SmoothDistance::find_nodes(const Field& hull, std::span<const HullSample> samples) {
  const size_t count = static_cast<size_t>(size_[0]) * static_cast<size_t>(size_[1]) * static_cast<size_t>(size_[2]);
  std::vector<int32_t> nearest(count, -1);
  std::vector<float> distance2(count, std::numeric_limits<float>::max());
  const double ratio = static_cast<double>(cell_m_) / hull.grid().voxel_m;
  const auto is_inside = [&](int i, int j, int k) {
    const auto on = [&](int n, size_t axis) {
      return std::min(static_cast<int>(std::lround(n * ratio)), hull.grid().size[axis] - 1);
    };
    return hull.at(on(i, 0), on(j, 1), on(k, 2)) < 0;
  };
  struct Place {
    int i, j, k;
  };
  std::vector<Place> front, next;
  const auto offer = [&](int i, int j, int k, int32_t sample) {
    if (i < 0 || j < 0 || k < 0 || i >= size_[0] || j >= size_[1] || k >= size_[2]) return;
    const Eigen::Vector3f at(static_cast<float>(i), static_cast<float>(j), static_cast<float>(k));
    const float d2 = (in_cells(samples[static_cast<size_t>(sample)].position) - at).squaredNorm();
    const size_t n = index(i, j, k);
    if (d2 >= distance2[n]) return;
    distance2[n] = d2;
    nearest[n] = sample;
    next.push_back({i, j, k});
  };
  for (size_t s = 0; s < samples.size(); ++s) {
    const Eigen::Vector3f p = in_cells(samples[s].position);
    for (int c = 0; c < 8; ++c)
      offer(static_cast<int>(p.x()) + (c & 1), static_cast<int>(p.y()) + (c >> 1 & 1),
            static_cast<int>(p.z()) + (c >> 2), static_cast<int32_t>(s));
  }
  while (!next.empty()) {
    std::swap(front, next);
    next.clear();
    for (const auto& [i, j, k] : front) {
      const size_t n = index(i, j, k);
      if (distance2[n] > outside_cells * outside_cells && !is_inside(i, j, k)) continue;
      for (const auto& [di, dj, dk] :
           {Place{-1, 0, 0}, Place{1, 0, 0}, Place{0, -1, 0}, Place{0, 1, 0}, Place{0, 0, -1}, Place{0, 0, 1}})
        offer(i + di, j + dj, k + dk, nearest[n]);
    }
  }
  node_of_.assign(count, -1);
  for (int k = 0; k < size_[2]; ++k)
    for (int j = 0; j < size_[1]; ++j)
      for (int i = 0; i < size_[0]; ++i) {
        const size_t n = index(i, j, k);
        if (nearest[n] < 0) continue;
        node_of_[n] = static_cast<int32_t>(start_.size());
        const float distance_m = cell_m_ * std::sqrt(distance2[n]);
        start_.push_back(is_inside(i, j, k) ? -distance_m : distance_m);
        nearest_.push_back(nearest[n]);
        places_.push_back({i, j, k});
      }
  for (const auto& [i, j, k] : places_) {
    beside_.push_back({node(i - 1, j, k), node(i + 1, j, k), node(i, j - 1, k), node(i, j + 1, k), node(i, j, k - 1),
                       node(i, j, k + 1)});
    diagonal_.push_back({node(i + 1, j + 1, k), node(i + 1, j, k + 1), node(i, j + 1, k + 1)});
  }
  values_ = start_;
}

void SmoothDistance::make_rows(std::span<const HullSample> samples, std::span<const float> weights) {
  rows_.clear();
  rows_.reserve(samples.size());
  for (size_t s = 0; s < samples.size(); ++s) {
    if (!(weights[s] > 0)) continue;
    Row row;
    row.weight = weights[s];
    row.wanted = samples[s].slack_m;
    row.normal = samples[s].normal;
    const Eigen::Vector3f p = in_cells(samples[s].position);
    const Spline x(p.x()), y(p.y()), z(p.z());
    size_t t = 0;
    for (size_t c = 0; c < 3; ++c)
      for (size_t b = 0; b < 3; ++b)
        for (size_t a = 0; a < 3; ++a, ++t) {
          row.node[t] =
              node(x.first + static_cast<int>(a), y.first + static_cast<int>(b), z.first + static_cast<int>(c));
          row.value[t] = x.value[a] * y.value[b] * z.value[c];
          row.slope[0][t] = x.slope[a] * y.value[b] * z.value[c] / cell_m_;
          row.slope[1][t] = x.value[a] * y.slope[b] * z.value[c] / cell_m_;
          row.slope[2][t] = x.value[a] * y.value[b] * z.slope[c] / cell_m_;
        }
    if (std::none_of(row.node.begin(), row.node.end(), [](int32_t n) { return n < 0; })) rows_.push_back(row);
  }
}

/// y = A x of the normal equations: all second differences (each mixed one counts twice), the attachment, the samples.
void SmoothDistance::multiply(const std::vector<float>& x, std::vector<float>& y) const {
  for (size_t n = 0; n < x.size(); ++n) y[n] = attachment * x[n];
  for (size_t n = 0; n < x.size(); ++n) {
    const auto& near = beside_[n];
    for (size_t axis = 0; axis < 3; ++axis) {
      if (near[2 * axis] < 0 || near[2 * axis + 1] < 0) continue;
      const auto low = static_cast<size_t>(near[2 * axis]), high = static_cast<size_t>(near[2 * axis + 1]);
      const float bent = stiffness_ * (x[low] - 2 * x[n] + x[high]);
      y[low] += bent;
      y[n] -= 2 * bent;
      y[high] += bent;
    }
    for (size_t plane = 0; plane < 3; ++plane) {
      const int32_t first = near[plane == 2 ? 3 : 1], second = near[plane == 0 ? 3 : 5], across = diagonal_[n][plane];
      if (first < 0 || second < 0 || across < 0) continue;
      const auto a = static_cast<size_t>(first), b = static_cast<size_t>(second), c = static_cast<size_t>(across);
      const float bent = 2 * stiffness_ * (x[n] - x[a] - x[b] + x[c]);
      y[n] += bent;
      y[a] -= bent;
      y[b] -= bent;
      y[c] += bent;
    }
  }
  for (const Row& row : rows_) {
    float value = 0;
    std::array<float, 3> slope{};
    for (size_t t = 0; t < support; ++t) {
      const float v = x[static_cast<size_t>(row.node[t])];
      value += row.value[t] * v;
      for (size_t axis = 0; axis < 3; ++axis) slope[axis] += row.slope[axis][t] * v;
    }
    value *= row.weight;
    for (float& part : slope) part *= slope_share * row.weight;
    for (size_t t = 0; t < support; ++t)
      y[static_cast<size_t>(row.node[t])] +=
          value * row.value[t] + slope[0] * row.slope[0][t] + slope[1] * row.slope[1][t] + slope[2] * row.slope[2][t];
  }
}

void SmoothDistance::solve(std::span<const HullSample> samples, std::span<const float> weights,
                           const SmoothDistance* coarser, const Work& work) {
  make_rows(samples, weights);
  const size_t count = start_.size();
  if (coarser != nullptr)
    for (size_t n = 0; n < count; ++n) {
      const auto& [i, j, k] = places_[n];
      const Eigen::Vector3f cells(static_cast<float>(i), static_cast<float>(j), static_cast<float>(k));
      values_[n] = coarser->at(origin_ + cell_m_ * cells);
    }
  // Conjugate gradients, each node scaled by its diagonal of the normal equations.
  constexpr float bending_diagonal = 36;
  std::vector<float> right(count), diagonal(count, attachment + bending_diagonal * stiffness_);
  for (size_t n = 0; n < count; ++n) right[n] = attachment * start_[n];
  for (const Row& row : rows_)
    for (size_t t = 0; t < support; ++t) {
      const auto n = static_cast<size_t>(row.node[t]);
      float along = 0, square = row.value[t] * row.value[t];
      for (size_t axis = 0; axis < 3; ++axis) {
        along += row.normal[static_cast<Eigen::Index>(axis)] * row.slope[axis][t];
        square += slope_share * row.slope[axis][t] * row.slope[axis][t];
      }
      right[n] += row.weight * (slope_share * along + row.value[t] * row.wanted);
      diagonal[n] += row.weight * square;
    }
  std::vector<float> residual(count), scaled(count), way, moved(count);
  multiply(values_, moved);
  for (size_t n = 0; n < count; ++n) {
    residual[n] = right[n] - moved[n];
    scaled[n] = residual[n] / diagonal[n];
  }
  way = scaled;
  double square = dot(residual, scaled);
  for (int iteration = 0; iteration < iterations_ && square > 0 && !work.stopped(); ++iteration) {
    multiply(way, moved);
    const auto step = static_cast<float>(square / dot(way, moved));
    for (size_t n = 0; n < count; ++n) {
      values_[n] += step * way[n];
      residual[n] -= step * moved[n];
      scaled[n] = residual[n] / diagonal[n];
    }
    const double next = dot(residual, scaled);
    const auto kept = static_cast<float>(next / square);
    square = next;
    for (size_t n = 0; n < count; ++n) way[n] = scaled[n] + kept * way[n];
  }
}

Eigen::Vector3f SmoothDistance::slope(const Eigen::Vector3f& p) const {
  const Eigen::Vector3f q = in_cells(p);
  const Spline x(q.x()), y(q.y()), z(q.z());
  Eigen::Vector3f sum = Eigen::Vector3f::Zero();
  for (size_t c = 0; c < 3; ++c)
    for (size_t b = 0; b < 3; ++b)
      for (size_t a = 0; a < 3; ++a) {
        const int32_t n =
            node(x.first + static_cast<int>(a), y.first + static_cast<int>(b), z.first + static_cast<int>(c));
        if (n < 0) return Eigen::Vector3f::Zero();
        sum += values_[static_cast<size_t>(n)] * Eigen::Vector3f(x.slope[a] * y.value[b] * z.value[c],
                                                                 x.value[a] * y.slope[b] * z.value[c],
                                                                 x.value[a] * y.value[b] * z.slope[c]);
      }
  return sum / cell_m_;
}

std::vector<float> SmoothDistance::spread(std::span<const float> by_sample) const {
  std::vector<float> by_node(nearest_.size());
  for (size_t n = 0; n < by_node.size(); ++n) by_node[n] = by_sample[static_cast<size_t>(nearest_[n])];
  return by_node;
}

template <class Value>
float SmoothDistance::interpolate(const Eigen::Vector3f& p, const Value& value_of) const {
  const Eigen::Vector3f q = in_cells(p);
  const Spline x(q.x()), y(q.y()), z(q.z());
  float sum = 0, total = 0;
  for (size_t c = 0; c < 3; ++c)
    for (size_t b = 0; b < 3; ++b) {
      const float across = y.value[b] * z.value[c];
      for (size_t a = 0; a < 3; ++a) {
        const int32_t n =
            node(x.first + static_cast<int>(a), y.first + static_cast<int>(b), z.first + static_cast<int>(c));
        if (n < 0) continue;
        const float weight = x.value[a] * across;
        sum += weight * value_of(static_cast<size_t>(n));
        total += weight;
      }
    }
  return total > 0 ? sum / total : 0;
}

float SmoothDistance::at(const Eigen::Vector3f& p) const {
  return interpolate(p, [&](size_t n) { return values_[n]; });
}

float SmoothDistance::at(const Eigen::Vector3f& p, const std::vector<float>& less) const {
  return interpolate(p, [&](size_t n) { return values_[n] - less[n]; });
}

}  // namespace booth
