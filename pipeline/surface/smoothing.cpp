#include "pipeline/surface/smoothing.h"

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <span>
#include <vector>

namespace booth {
namespace {

/// The vertices that share an edge with a vertex, each once, in ascending order.
class Neighbours {
 public:
  explicit Neighbours(const Mesh& mesh) : first_(mesh.positions.size() + 1, 0) {
    for (const auto& triangle : mesh.triangles)
      for (const uint32_t v : triangle) first_[v + 1] += 2;
    std::partial_sum(first_.begin(), first_.end(), first_.begin());
    others_.resize(first_.back());
    std::vector<size_t> end(first_.begin(), first_.end() - 1);
    for (const auto& [a, b, c] : mesh.triangles)
      for (const auto& [v, left, right] : {std::array{a, b, c}, std::array{b, c, a}, std::array{c, a, b}}) {
        others_[end[v]++] = left;
        others_[end[v]++] = right;
      }
    count_.resize(mesh.positions.size());
    for (size_t v = 0; v < count_.size(); ++v) {
      const auto begin = others_.begin() + static_cast<std::ptrdiff_t>(first_[v]);
      const auto stop = others_.begin() + static_cast<std::ptrdiff_t>(first_[v + 1]);
      std::sort(begin, stop);
      count_[v] = static_cast<size_t>(std::unique(begin, stop) - begin);
    }
  }
  std::span<const uint32_t> of(size_t v) const { return {others_.data() + first_[v], count_[v]}; }

  /// The mean of `values` over the neighbours; `own` where there are none.
  Eigen::Vector3f mean(const std::vector<Eigen::Vector3f>& values, size_t v, const Eigen::Vector3f& own) const {
    if (count_[v] == 0) return own;
    Eigen::Vector3f sum = Eigen::Vector3f::Zero();
    for (const uint32_t other : of(v)) sum += values[other];
    return sum / static_cast<float>(count_[v]);
  }

 private:
  std::vector<size_t> first_;
  std::vector<size_t> count_;
  std::vector<uint32_t> others_;
};

}  // namespace

Mesh smooth_hc(const Mesh& mesh, const SmoothingOptions& options, const Work& work) {
  Mesh smoothed = mesh;
  if (options.iterations <= 0) return smoothed;
  const auto alpha = static_cast<float>(options.alpha), beta = static_cast<float>(options.beta);
  const Neighbours neighbours(mesh);
  const size_t count = mesh.positions.size();
  std::vector<Eigen::Vector3f> moved(count), moved_by(count);
  const auto for_each_vertex = [&](const auto& visit) {
    constexpr size_t grain = 4096;
    work.parallel_for(count, grain, [&](size_t begin, size_t end) {
      for (size_t v = begin; v < end; ++v) visit(v);
    });
  };
  // p, q, o and b of the paper: moved, smoothed.positions, mesh.positions and moved_by.
  for (int i = 0; i < options.iterations && !work.stopped(); ++i) {
    for_each_vertex([&](size_t v) {
      const Eigen::Vector3f& q = smoothed.positions[v];
      moved[v] = neighbours.mean(smoothed.positions, v, q);
      moved_by[v] = moved[v] - (alpha * mesh.positions[v] + (1 - alpha) * q);
    });
    for_each_vertex([&](size_t v) {
      smoothed.positions[v] = moved[v] - (beta * moved_by[v] + (1 - beta) * neighbours.mean(moved_by, v, moved_by[v]));
    });
  }
  return smoothed;
}

}  // namespace booth
