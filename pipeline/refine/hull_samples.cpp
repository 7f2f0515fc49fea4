#include "pipeline/refine/hull_samples.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <unordered_set>

namespace booth {
namespace {

constexpr int side = Field::brick_side;

class Sampling {
 public:
  Sampling(const Field& hull, double cell_m)
      : hull_(hull), per_cell_(static_cast<float>(hull.grid().voxel_m / cell_m)) {}

  std::vector<HullSample> run() {
    const auto bricks = hull_.bricks();
    for (int z = 0; z < bricks[2]; ++z)
      for (int y = 0; y < bricks[1]; ++y)
        for (int x = 0; x < bricks[0]; ++x)
          if (const int32_t block = hull_.brick(hull_.brick_index(x, y, z)); block >= 0)
            visit({x * side, y * side, z * side}, hull_.block(block));
    return std::move(samples_);
  }

 private:
  void visit(const std::array<int, 3>& first, const float* values) {
    for (int k = 0; k < side; ++k)
      for (int j = 0; j < side; ++j)
        for (int i = 0; i < side; ++i) {
          const std::array<int, 3> place{i, j, k};
          const int sample = (k * side + j) * side + i;
          for (int axis = 0, stride = 1; axis < 3; ++axis, stride *= side) {
            if (place[static_cast<size_t>(axis)] + 1 == side) continue;
            const float from = values[sample], to = values[sample + stride];
            if ((from < 0) != (to < 0)) offer({first[0] + i, first[1] + j, first[2] + k}, axis, from / (from - to));
          }
        }
  }

  float at(std::array<int, 3> place, size_t axis, int step) const {
    place[axis] = std::clamp(place[axis] + step, 0, hull_.grid().size[axis] - 1);
    return hull_.at(place[0], place[1], place[2]);
  }

  void offer(const std::array<int, 3>& place, int axis, float share) {
    Eigen::Vector3f normal;
    for (size_t a = 0; a < 3; ++a) normal[static_cast<Eigen::Index>(a)] = at(place, a, 1) - at(place, a, -1);
    const float length = normal.norm();
    if (!(length > 0)) return;
    Eigen::Vector3f p(static_cast<float>(place[0]), static_cast<float>(place[1]), static_cast<float>(place[2]));
    p[axis] += share;
    int facing = 0;
    normal.cwiseAbs().maxCoeff(&facing);
    uint64_t key = normal[facing] > 0 ? 1 : 0;
    key = key << 2 | static_cast<uint64_t>(facing);
    for (int a = 0; a < 3; ++a) key = key << 16 | static_cast<uint64_t>(p[a] * per_cell_);
    if (!taken_.insert(key).second) return;
    const Grid& grid = hull_.grid();
    samples_.push_back(
        {grid.origin.cast<float>() + static_cast<float>(grid.voxel_m) * p, Eigen::Vector3f(normal / length), 0});
  }

  const Field& hull_;
  float per_cell_;
  std::unordered_set<uint64_t> taken_;
  std::vector<HullSample> samples_;
};

/// Nearer to the outline than this, a point of the hull may be the ray's contact.
constexpr float contact_m = 0.002F;
/// A ray that passes the hull by less than the first grazes it, and by less than the second is taken to graze it
/// somewhere else: silhouettes and calibration do not agree to the millimetre.
constexpr float grazed_m = 0.0015F, grazed_elsewhere_m = 0.006F;
/// By which limbs bend, and the edges of what is broader: where silhouettes leave a surface open.
constexpr float bend_radius_m = 0.06F;

}  // namespace

std::vector<HullSample> sample_hull(const Field& hull, double cell_m) { return Sampling(hull, cell_m).run(); }

std::vector<GrazingRay> measure_slack(const Field& hull, const SilhouetteViews& views, std::vector<HullSample>& samples,
                                      const Work& work) {
  constexpr float step_m = 0.006F, farthest_m = 0.8F, most_m = 1;
  const Grid& grid = hull.grid();
  const Eigen::Vector3f origin = grid.origin.cast<float>();
  const auto per_voxel = static_cast<float>(1 / grid.voxel_m);
  const auto distance_m = [&](const Eigen::Vector3f& p) {
    const Eigen::Vector3f q = (p - origin) * per_voxel;
    std::array<int, 3> n{};
    std::array<float, 3> share{};
    bool in_one_brick = true;
    for (size_t a = 0; a < 3; ++a) {
      const float place = q[static_cast<Eigen::Index>(a)];
      if (!(place >= 0) || !(place < static_cast<float>(grid.size[a] - 1))) return most_m;
      n[a] = static_cast<int>(place);
      share[a] = place - static_cast<float>(n[a]);
      in_one_brick = in_one_brick && n[a] % side != side - 1;
    }
    const auto mean = [&](const auto& at) {
      float sum = 0;
      for (int c = 0; c < 8; ++c)
        sum += ((c & 1) != 0 ? share[0] : 1 - share[0]) * ((c & 2) != 0 ? share[1] : 1 - share[1]) *
               ((c & 4) != 0 ? share[2] : 1 - share[2]) * at(c & 1, c >> 1 & 1, c >> 2);
      return sum;
    };
    if (!in_one_brick) return mean([&](int i, int j, int k) { return hull.at(n[0] + i, n[1] + j, n[2] + k); });
    const int32_t block = hull.brick(hull.brick_index(n[0] / side, n[1] / side, n[2] / side));
    if (block < 0) return block == Field::all_outside ? 1.0F : -1.0F;
    const float* first = hull.block(block) + ((n[2] % side) * side + n[1] % side) * side + n[0] % side;
    return mean([&](int i, int j, int k) { return first[(k * side + j) * side + i]; });
  };
  std::vector<std::vector<GrazingRay>> rays(samples.size());
  const auto measure = [&](size_t s) {
    HullSample& sample = samples[s];
    sample.slack_m = most_m;
    for (const auto& view : views) {
      if (!(std::abs(view->distance_m(sample.position)) < contact_m)) continue;
      const Eigen::Vector3f ray = (sample.position - view->camera().center().cast<float>()).normalized();
      std::array<float, 2> reach{};  // of the stretch around the sample, both ways
      bool elsewhere = false;
      for (const size_t way : {size_t{0}, size_t{1}}) {
        bool own = true;
        for (float t = step_m; t < farthest_m && !elsewhere; t += step_m) {
          const float off = distance_m(sample.position + (way == 0 ? t : -t) * ray);
          if (own && off < grazed_m) reach[way] = t;
          if (off >= grazed_elsewhere_m) own = false;
          if (!own && off < grazed_elsewhere_m) elsewhere = true;
        }
      }
      if (elsewhere) continue;
      rays[s].push_back({.sample = s, .direction = ray, .begin_m = -reach[1], .end_m = reach[0]});
      const float length = reach[0] + reach[1], from_middle = 0.5F * (reach[0] - reach[1]);
      const float reach2 = from_middle * from_middle + length * length / 16;
      // So long a stretch also lies by a surface that the ray only touches.
      constexpr float own_m = 1.25F * grazed_m;
      sample.slack_m = std::min(sample.slack_m, std::max(0.0F, reach2 / (2 * bend_radius_m) - own_m));
    }
    // The views' order is chance.
    std::sort(rays[s].begin(), rays[s].end(), [](const GrazingRay& a, const GrazingRay& b) {
      return std::lexicographical_compare(a.direction.begin(), a.direction.end(), b.direction.begin(),
                                          b.direction.end());
    });
  };
  constexpr size_t grain = 64;
  work.parallel_for(samples.size(), grain, [&](size_t begin, size_t end) {
    for (size_t s = begin; s < end; ++s) measure(s);
  });
  std::vector<GrazingRay> all;
  for (const auto& of_sample : rays) all.insert(all.end(), of_sample.begin(), of_sample.end());
  return all;
}

}  // namespace booth
