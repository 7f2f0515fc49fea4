#include "pipeline/refine/shape_refinement.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <utility>
#include <vector>

#include "pipeline/geometry/solid_parts.h"
#include "pipeline/refine/hull_samples.h"
#include "pipeline/refine/photo_consistency.h"
#include "pipeline/refine/smooth_distance.h"

namespace booth {
namespace {

constexpr int side = Field::brick_side;
constexpr double cell_m = 0.02;  // of the grid on which the surface is looked for
/// Around sure hull the smooth surface may be this far inside without effect: it knows no details.
constexpr float detail_m = 0.03F;

/// How far a point is outside a surface, metres; near the surface at least.
using Distance = std::function<float(const Eigen::Vector3f&)>;

/// What holds the smooth surface, and how strongly.
struct Evidence {
  std::vector<HullSample> samples;
  std::vector<float> weights;  ///< 0 … 1
};

std::vector<float> weights_of(const std::vector<HullSample>& samples, const ShapeRefinementOptions& options) {
  std::vector<float> weights;
  weights.reserve(samples.size());
  for (const HullSample& sample : samples) {
    const float share = sample.slack_m / static_cast<float>(options.open_m);
    const float known = std::max(0.0F, 1 - share * share);
    weights.push_back(known * known * known);
  }
  return weights;
}

/// The hull's evidence, and behind it what photographs show where the hull is doubtful; the hull's guess gives way
/// there.
Evidence with_photographs(const Evidence& of_hull, const PhotoConsistency& photographs, const SmoothDistance& guess,
                          double inwards_m, const ShapeRefinementOptions& options, const Work& work) {
  std::vector<HullSample> doubtful;
  std::vector<size_t> numbers;
  for (size_t s = 0; s < of_hull.samples.size(); ++s)
    if (of_hull.samples[s].slack_m > static_cast<float>(options.doubtful_m)) {
      doubtful.push_back(of_hull.samples[s]);
      numbers.push_back(s);
    }
  const Step step(work, "refine: photographs");
  const auto seen = photographs.find(guess, doubtful, inwards_m, work);
  Evidence all = of_hull;
  for (size_t n = 0; n < seen.size(); ++n) {
    if (!seen[n]) continue;
    all.weights[numbers[n]] *= 1 - seen[n]->confidence;
    all.samples.push_back({.position = seen[n]->position, .normal = seen[n]->normal});
    all.weights.push_back(seen[n]->confidence);
  }
  return all;
}

/// Believes samples less the farther they lie from the surface that all together make, from the one numbered `first`
/// on. After S. Geman, D. McClure, "Statistical methods for tomographic image reconstruction", 1987.
void doubt_stray(Evidence& evidence, size_t first, const SmoothDistance& surface) {
  constexpr float usual_m = 0.004F;
  for (size_t s = first; s < evidence.samples.size(); ++s) {
    const float off = surface.at(evidence.samples[s].position) / usual_m;
    evidence.weights[s] /= (1 + off * off) * (1 + off * off);
  }
}

/// Adds that the surface meets rays which graze the subject, where it does not: at the place where it nearly does.
/// @param outside_by  how far a point of the hull is outside the surface, metres
void hold_at_rays(Evidence& evidence, const std::vector<GrazingRay>& rays, const Distance& outside_by) {
  constexpr float step_m = 0.006F, missed_m = 0.002F;
  for (const GrazingRay& ray : rays) {
    const HullSample& sample = evidence.samples[ray.sample];
    HullSample nearest{.position = sample.position, .normal = sample.normal};
    float least_m = outside_by(sample.position);
    for (float t = ray.begin_m; t <= ray.end_m && least_m > missed_m; t += step_m) {
      const Eigen::Vector3f p = sample.position + t * ray.direction;
      const float off = outside_by(p);
      if (off >= least_m) continue;
      least_m = off;
      nearest.position = p;
    }
    if (least_m <= missed_m) continue;
    evidence.samples.push_back(nearest);
    evidence.weights.push_back(1);
  }
}

/// Takes away from the hull what lies outside a surface.
Field carve(Field hull, const Distance& outside_by, const Work& work) {
  const Grid& grid = hull.grid();
  const auto bricks = hull.bricks();
  const auto voxel_m = static_cast<float>(grid.voxel_m);
  const float cut_off_m = 2 * voxel_m;  // as the hull's own
  struct Carved {
    size_t brick;
    std::vector<float> values;
  };
  constexpr float half = 0.5F * (side - 1);
  // No sample of a brick differs from its middle's distance by more: its diagonal, and the smooth distance's slope.
  const float reach_m = 1.5F * std::sqrt(3.0F) * half * voxel_m;
  std::vector<std::vector<Carved>> layers(static_cast<size_t>(bricks[2]));
  work.parallel_for(layers.size(), 1, [&](size_t begin, size_t end) {
    for (size_t layer = begin; layer < end; ++layer)
      for (int y = 0; y < bricks[1]; ++y)
        for (int x = 0; x < bricks[0]; ++x) {
          const auto z = static_cast<int>(layer);
          const size_t brick = hull.brick_index(x, y, z);
          const int32_t block = hull.brick(brick);
          if (block == Field::all_outside) continue;
          const Eigen::Vector3f first = grid.point(x * side, y * side, z * side).cast<float>();
          if (outside_by(first + Eigen::Vector3f::Constant(half * voxel_m)) < -reach_m - cut_off_m) continue;
          std::vector<float> values(Field::samples_per_brick, -cut_off_m);
          if (block >= 0) std::copy_n(hull.block(block), values.size(), values.begin());
          bool changed = false;
          size_t s = 0;
          for (int k = 0; k < side; ++k)
            for (int j = 0; j < side; ++j)
              for (int i = 0; i < side; ++i, ++s) {
                if (values[s] >= 0) continue;
                const Eigen::Vector3f p =
                    first +
                    voxel_m * Eigen::Vector3f(static_cast<float>(i), static_cast<float>(j), static_cast<float>(k));
                const float carved = std::min(outside_by(p), cut_off_m);
                if (carved <= values[s]) continue;
                values[s] = carved;
                changed = true;
              }
          if (changed) layers[layer].push_back({brick, std::move(values)});
        }
  });
  size_t added = 0;
  for (const auto& layer : layers)
    for (const Carved& carved : layer) added += hull.brick(carved.brick) < 0;
  Field result(grid);
  result.allocate_blocks(hull.blocks() + added);
  if (hull.blocks() > 0) std::copy_n(hull.block(0), hull.blocks() * Field::samples_per_brick, result.block(0));
  const size_t count = static_cast<size_t>(bricks[0]) * static_cast<size_t>(bricks[1]) * static_cast<size_t>(bricks[2]);
  for (size_t brick = 0; brick < count; ++brick) result.set_brick(brick, hull.brick(brick));
  auto next = static_cast<int32_t>(hull.blocks());
  for (const auto& layer : layers)
    for (const Carved& carved : layer) {
      if (result.brick(carved.brick) < 0) result.set_brick(carved.brick, next++);
      std::copy(carved.values.begin(), carved.values.end(), result.block(result.brick(carved.brick)));
    }
  return result;
}

}  // namespace

Field refine_shape(Field hull, const SilhouetteViews& views, std::span<const Frame> frames,
                   const ShapeRefinementOptions& options, const Work& work) {
  if (!options.enabled) return hull;
  Evidence evidence{sample_hull(hull, cell_m), {}};
  if (evidence.samples.empty()) return hull;
  const std::vector<GrazingRay> rays = [&] {
    const Step step(work, "refine: slack");
    return measure_slack(hull, views, evidence.samples, work);
  }();
  evidence.weights = weights_of(evidence.samples, options);

  constexpr int coarsest_iterations = 100, iterations = 10;
  SmoothDistance coarse(hull, evidence.samples, {4 * cell_m, options.stiffness, coarsest_iterations});
  SmoothDistance middle(hull, evidence.samples, {2 * cell_m, options.stiffness, iterations});
  SmoothDistance fine(hull, evidence.samples, {cell_m, options.stiffness, iterations});

  std::vector<float> spared;
  for (const HullSample& sample : evidence.samples) {
    const float open = sample.slack_m / static_cast<float>(options.sure_m) - 1;
    const float sure = std::clamp(1 - open, 0.0F, 1.0F);
    spared.push_back(detail_m * sure * sure);
  }
  const std::vector<float> spared_m = fine.spread(spared);
  coarse.solve(evidence.samples, evidence.weights, nullptr, work);
  middle.solve(evidence.samples, evidence.weights, &coarse, work);
  fine.solve(evidence.samples, evidence.weights, &middle, work);
  const Distance outside_by = [&](const Eigen::Vector3f& p) { return fine.at(p, spared_m); };
  const auto solve = [&](const Evidence& with) {
    const Step step(work, "refine: smoothest surface");
    middle.solve(with.samples, with.weights, nullptr, work);
    fine.solve(with.samples, with.weights, &middle, work);
  };
  Evidence all = evidence;
  if (options.photographs && !work.stopped()) {
    const PhotoConsistency photographs(frames, views, hull, work);
    constexpr double first_inwards_m = 0.03, then_inwards_m = 0.015;
    solve(with_photographs(evidence, photographs, fine, first_inwards_m, options, work));
    // Now it is known better where to look, and how the surface is turned there.
    all = with_photographs(evidence, photographs, fine, then_inwards_m, options, work);
    solve(all);
    doubt_stray(all, evidence.samples.size(), fine);
  }
  hold_at_rays(all, rays, outside_by);
  solve(all);
  if (work.stopped()) return hull;
  const Step step(work, "refine: carving");
  Field refined = carve(std::move(hull), outside_by, work);
  keep_largest_part(refined, work);
  return refined;
}

}  // namespace booth
