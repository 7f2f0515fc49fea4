#include "pipeline/hull/contradictions.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

constexpr double spacing_m = 0.01;  // of the points that are looked at: thinner than a wrist
/// Points along the side of the blocks that are looked at as one, the largest and the smallest.
constexpr int largest_block = 16;
constexpr int smallest_block = 4;
/// Others must agree by this much: more than an outline is off by calibration and segmentation.
constexpr float agreed_m = 0.012F;
/// What hangs together with a missing part and is thinner, such as fingers with a hand: others agree by this much, and
/// it lies at most so many points away.
constexpr float faintly_agreed_m = 0.002F;
constexpr int faint_steps = 12;
/// Deeper in the hull of all others no true gap lies, such as between arm and trunk, that one camera alone sees
/// through. Measured on standing people: up to 40 mm with ten cameras around, 45 mm with eight.
constexpr float deep_m = 0.06F;
constexpr int fewest_witnesses = 4;       // for a part that is missing
constexpr int fewest_deep_witnesses = 6;  // for a hole: with few cameras true concavities are deep
/// A camera is overruled where at least this share of a part, and so many of its points, are proven. Measured on
/// standing people, a limb missing from one mask: from 0.39 and 310 up where that camera lacks it, up to 0.29
/// elsewhere.
constexpr double least_proven_share = 1.0 / 3;
constexpr size_t least_proven_points = 30;
/// Around a point of the missing part as much as lies between the points and within the agreement's margin.
constexpr double reach_m = 0.025;

constexpr int looks_across = 60;  ///< pixels along an image's shorter side that are looked at for what is unexplained

/// A point that one camera alone denies.
struct Denied {
  std::array<int, 3> place;
  uint32_t view;
  bool agreed;        ///< others agree by more than outlines are off
  bool deep;          ///< inside the hull of all others
  bool proven;        ///< a ray of another camera through it misses the hull
  bool hole = false;  ///< deep, and its camera sees through a gap in the middle of the subject
};

/// How far a line runs on before it leaves the brick of the sample nearest to `at`; both in samples.
double rest_in_brick(const Eigen::Vector3d& at, const Eigen::Vector3d& direction) {
  double rest = std::numeric_limits<double>::infinity();
  for (int axis = 0; axis < 3; ++axis) {
    const double in_brick = at[axis] + 0.5 - Field::brick_side * std::floor((at[axis] + 0.5) / Field::brick_side);
    if (direction[axis] > 0) rest = std::min(rest, (Field::brick_side - in_brick) / direction[axis]);
    if (direction[axis] < 0) rest = std::min(rest, -in_brick / direction[axis]);
  }
  return rest;
}

/// Whether a line through a point meets the hull, in steps of a sample; it passes the nearest sample by less than a
/// voxel.
bool meets(const Field& hull, const Eigen::Vector3d& p, const Eigen::Vector3d& direction) {
  const Grid& grid = hull.grid();
  constexpr int side = Field::brick_side;
  for (const double way : {1.0, -1.0}) {
    const Eigen::Vector3d step = way * direction;
    Eigen::Vector3d at = (p - grid.origin) / grid.voxel_m;
    while (true) {
      const auto i = static_cast<int>(std::lround(at.x())), j = static_cast<int>(std::lround(at.y()));
      const auto k = static_cast<int>(std::lround(at.z()));
      if (i < 0 || j < 0 || k < 0 || i >= grid.size[0] || j >= grid.size[1] || k >= grid.size[2]) break;
      const int32_t brick = hull.brick(hull.brick_index(i / side, j / side, k / side));
      if (brick == Field::all_outside) {
        at += (std::floor(rest_in_brick(at, step)) + 1) * step;
        continue;
      }
      if (brick == Field::all_inside || static_cast<double>(hull.at(i, j, k)) < grid.voxel_m) return true;
      at += step;
    }
  }
  return false;
}

class Search {
 public:
  Search(const Eigen::AlignedBox3d& volume, const SilhouetteViews& views, const Field& hull)
      : origin_(volume.min()), views_(views), hull_(hull) {
    for (int axis = 0; axis < 3; ++axis)
      size_[static_cast<size_t>(axis)] = static_cast<int>(volume.sizes()[axis] / spacing_m) + 1;
  }

  std::vector<Denied> run(const Work& work) const {
    std::vector<std::array<int, 3>> blocks;
    for (int z = 0; z < size_[2]; z += largest_block)
      for (int y = 0; y < size_[1]; y += largest_block)
        for (int x = 0; x < size_[0]; x += largest_block) blocks.push_back({x, y, z});
    std::vector<std::vector<Denied>> by_block(blocks.size());
    work.parallel_for(blocks.size(), 1, [&](size_t begin, size_t end) {
      for (size_t b = begin; b < end; ++b)
        if (!work.stopped()) look_at_block(blocks[b], largest_block, by_block[b]);
    });
    std::vector<Denied> all;
    for (const auto& block : by_block) all.insert(all.end(), block.begin(), block.end());
    return all;
  }

  Eigen::Vector3d point(const std::array<int, 3>& place) const {
    return origin_ + spacing_m * Eigen::Vector3d(place[0], place[1], place[2]);
  }

 private:
  void look_at_block(const std::array<int, 3>& first, int points_along, std::vector<Denied>& found) const {
    if (is_settled(first, points_along)) return;
    if (points_along == smallest_block) return look_at_points(first, found);
    const int half = points_along / 2;
    for (int part = 0; part < 8; ++part)
      look_at_block({first[0] + (part & 1) * half, first[1] + (part >> 1 & 1) * half, first[2] + (part >> 2) * half},
                    half, found);
  }

  /// Whether surely no point of a block is denied by exactly one camera.
  bool is_settled(const std::array<int, 3>& first, int points_along) const {
    const double half_m = 0.5 * (points_along - 1) * spacing_m;
    const Eigen::Vector3d center = point(first) + Eigen::Vector3d::Constant(half_m);
    int sure_deniers = 0, perhaps_deniers = 0;
    for (const auto& view : views_) {
      const SilhouetteView::Verdict verdict = view->judge(center, half_m * std::sqrt(3.0));
      if (verdict.hidden) continue;
      if (verdict.most_m > 0) ++perhaps_deniers;
      if (verdict.seen && verdict.least_m > 0 && ++sure_deniers == 2) return true;
    }
    return perhaps_deniers == 0;
  }

  void look_at_points(const std::array<int, 3>& first, std::vector<Denied>& found) const {
    // Whoever denies a point mostly denies the next one: asked first, two of them settle it.
    std::vector<uint32_t> order(views_.size());
    for (uint32_t v = 0; v < order.size(); ++v) order[v] = v;
    for (int z = first[2]; z < std::min(first[2] + smallest_block, size_[2]); ++z)
      for (int y = first[1]; y < std::min(first[1] + smallest_block, size_[1]); ++y)
        for (int x = first[0]; x < std::min(first[0] + smallest_block, size_[0]); ++x) {
          const std::array<int, 3> place{x, y, z};
          const Eigen::Vector3d p = point(place);
          int deniers = 0, witnesses = 0;
          float least_agreed = -std::numeric_limits<float>::infinity();
          for (size_t n = 0; n < order.size() && deniers < 2; ++n) {
            const float distance = views_[order[n]]->distance_m(p.cast<float>());
            if (distance > 0) {
              std::rotate(order.begin() + deniers, order.begin() + static_cast<std::ptrdiff_t>(n),
                          order.begin() + static_cast<std::ptrdiff_t>(n) + 1);
              ++deniers;
            } else if (distance <= 0) {
              ++witnesses;
              least_agreed = std::max(least_agreed, distance);
            }
          }
          if (deniers != 1 || witnesses < fewest_witnesses || least_agreed > -faintly_agreed_m) continue;
          const bool agreed = least_agreed <= -agreed_m;
          const bool deep = witnesses >= fewest_deep_witnesses && least_agreed < -deep_m;
          found.push_back({.place = place,
                           .view = order[0],
                           .agreed = agreed,
                           .deep = deep,
                           .proven = agreed && missed_by_a_ray(p, order[0])});
        }
  }

  /// Whether a camera looks through the point at the subject and meets the hull nowhere on that ray.
  bool missed_by_a_ray(const Eigen::Vector3d& p, uint32_t denier) const {
    for (uint32_t v = 0; v < views_.size(); ++v) {
      if (v == denier) continue;
      const float distance = views_[v]->distance_m(p.cast<float>());
      if (distance < -agreed_m && !meets(hull_, p, (p - views_[v]->camera().center()).normalized())) return true;
    }
    return false;
  }

  Eigen::Vector3d origin_;
  std::array<int, 3> size_{};
  const SilhouetteViews& views_;
  const Field& hull_;
};

/// The background that hangs together with the image's border: 255, all else 0.
Image outer_background(const Image& coverage) {
  Image outer(coverage.width, coverage.height, 1);
  std::vector<std::array<int, 2>> waiting;
  const auto reach = [&](int x, int y) {
    if (!coverage.contains(x, y) || coverage.at(x, y) >= 128 || outer.at(x, y) != 0) return;
    outer.at(x, y) = 255;
    waiting.push_back({x, y});
  };
  for (int x = 0; x < coverage.width; ++x)
    for (const int y : {0, coverage.height - 1}) reach(x, y);
  for (int y = 0; y < coverage.height; ++y)
    for (const int x : {0, coverage.width - 1}) reach(x, y);
  while (!waiting.empty()) {
    const auto [x, y] = waiting.back();
    waiting.pop_back();
    reach(x - 1, y);
    reach(x + 1, y);
    reach(x, y - 1);
    reach(x, y + 1);
  }
  return outer;
}

/// The points of one view in lexicographic order of their places, to walk from one to its neighbours.
class Neighbourhood {
 public:
  explicit Neighbourhood(std::vector<Denied> points) : points_(std::move(points)) {
    std::sort(points_.begin(), points_.end(), before);
  }

  const std::vector<Denied>& points() const { return points_; }

  template <class Visitor>
  void for_each_around(size_t n, const Visitor& visit) const {
    const auto [x, y, z] = points_[n].place;
    Denied next = points_[n];
    for (int dx = -1; dx <= 1; ++dx)
      for (int dy = -1; dy <= 1; ++dy) {
        next.place = {x + dx, y + dy, z - 1};
        const std::array<int, 3> last{x + dx, y + dy, z + 1};
        for (auto at = std::lower_bound(points_.begin(), points_.end(), next, before);
             at != points_.end() && at->place <= last; ++at)
          visit(static_cast<size_t>(at - points_.begin()));
      }
  }

 private:
  static bool before(const Denied& a, const Denied& b) { return a.place < b.place; }

  std::vector<Denied> points_;
};

/// Keeps the points of one view that hang together in parts of which enough is proven, or with a hole, and what hangs
/// on these parts.
std::vector<Denied> proven_parts(std::vector<Denied> of_view) {
  const Neighbourhood around(std::move(of_view));
  const std::vector<Denied>& points = around.points();
  std::vector<bool> reached(points.size());
  std::vector<size_t> kept, part;
  for (size_t seed = 0; seed < points.size(); ++seed) {
    if (reached[seed] || !points[seed].agreed) continue;
    part.assign(1, seed);
    reached[seed] = true;
    size_t proven = 0;
    bool hole = false;
    for (size_t m = 0; m < part.size(); ++m) {
      if (points[part[m]].proven) ++proven;
      hole = hole || points[part[m]].hole;
      around.for_each_around(part[m], [&](size_t n) {
        if (reached[n] || !points[n].agreed) return;
        reached[n] = true;
        part.push_back(n);
      });
    }
    const auto share = static_cast<double>(proven) / static_cast<double>(part.size());
    if (hole || (proven >= least_proven_points && share >= least_proven_share))
      kept.insert(kept.end(), part.begin(), part.end());
  }
  size_t begin = 0;
  for (int step = 0; step < faint_steps; ++step) {
    const size_t end = kept.size();
    for (; begin < end; ++begin)
      around.for_each_around(kept[begin], [&](size_t n) {
        if (reached[n]) return;
        reached[n] = true;
        kept.push_back(n);
      });
  }
  std::vector<Denied> denied;
  for (const size_t n : kept) denied.push_back(points[n]);
  return denied;
}

}  // namespace

std::vector<Contradiction> find_contradictions(const Eigen::AlignedBox3d& volume, const SilhouetteViews& views,
                                               const Field& hull, const Work& work) {
  const Search search(volume, views, hull);
  const std::vector<Denied> denied = search.run(work);
  std::vector<Contradiction> contradictions;
  for (uint32_t v = 0; v < views.size(); ++v) {
    std::vector<Denied> own;
    std::copy_if(denied.begin(), denied.end(), std::back_inserter(own), [&](const Denied& d) { return d.view == v; });
    const auto project = [&](const Denied& point) {
      const Eigen::Vector3f p = search.point(point.place).cast<float>();
      Contradiction::Disc disc;
      float depth_m, within_px;
      views[v]->project(p.x(), p.y(), p.z(), disc.center.x(), disc.center.y(), depth_m, within_px);
      disc.radius_px = static_cast<float>(reach_m) / (depth_m * views[v]->per_focal());
      return disc;
    };
    // Flat parts of a body, a side view alone may cut deep into the hull of the others, but from the outside.
    if (std::any_of(own.begin(), own.end(), [](const Denied& d) { return d.deep; })) {
      const Image outer = outer_background(views[v]->coverage());
      for (Denied& point : own) {
        const Eigen::Vector2f center = project(point).center;
        const Image& coverage = views[v]->coverage();
        const int x = std::clamp(static_cast<int>(std::lround(center.x())), 0, coverage.width - 1);
        const int y = std::clamp(static_cast<int>(std::lround(center.y())), 0, coverage.height - 1);
        if (point.deep && outer.at(x, y) == 0 && coverage.at(x, y) < 128) point.hole = true;
      }
    }
    Contradiction contradiction{v, {}};
    for (const Denied& part : proven_parts(std::move(own))) contradiction.discs.push_back(project(part));
    if (!contradiction.discs.empty()) contradictions.push_back(std::move(contradiction));
  }
  return contradictions;
}

double unexplained_share(const SilhouetteView& view, const Field& hull) {
  const Image& coverage = view.coverage();
  const Eigen::Vector3d center = view.camera().center();
  const Grid& grid = hull.grid();
  const Eigen::Vector3d low = grid.origin, high = grid.point(grid.size[0] - 1, grid.size[1] - 1, grid.size[2] - 1);
  const int spacing_px = std::max(1, std::min(coverage.width, coverage.height) / looks_across);
  size_t looks = 0, unexplained = 0;
  for (int y = spacing_px / 2; y < coverage.height; y += spacing_px)
    for (int x = spacing_px / 2; x < coverage.width; x += spacing_px) {
      if (coverage.at(x, y) < 128) continue;
      ++looks;
      const Eigen::Vector3d direction = world_ray(view.camera(), {x, y});
      // From the middle of the ray's way through the grid both ways.
      double begin_m = 0, end_m = std::numeric_limits<double>::infinity();
      for (int axis = 0; axis < 3; ++axis) {
        const double a = (low[axis] - center[axis]) / direction[axis],
                     b = (high[axis] - center[axis]) / direction[axis];
        begin_m = std::max(begin_m, std::min(a, b));
        end_m = std::min(end_m, std::max(a, b));
      }
      unexplained += begin_m >= end_m || !meets(hull, center + 0.5 * (begin_m + end_m) * direction, direction);
    }
  return looks > 0 ? static_cast<double>(unexplained) / static_cast<double>(looks) : 0;
}

Image overrule(const Image& coverage, const Contradiction& contradiction) {
  Image repaired = coverage;
  for (const auto& [center, radius_px] : contradiction.discs) {
    const int top = std::max(0, static_cast<int>(std::ceil(center.y() - radius_px)));
    const int bottom = std::min(repaired.height - 1, static_cast<int>(std::floor(center.y() + radius_px)));
    for (int y = top; y <= bottom; ++y) {
      const float up = static_cast<float>(y) - center.y();
      const float half = std::sqrt(std::max(0.0F, radius_px * radius_px - up * up));
      const int left = std::max(0, static_cast<int>(std::ceil(center.x() - half)));
      const int right = std::min(repaired.width - 1, static_cast<int>(std::floor(center.x() + half)));
      if (left <= right) std::fill_n(repaired.pixel(left, y), right - left + 1, uint8_t{255});
    }
  }
  return repaired;
}

}  // namespace booth
