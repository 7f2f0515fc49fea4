#include "pipeline/hull/contradictions.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

constexpr double spacing_m = 0.02;  // of the points that are looked at
/// Others must agree by this much: more than an outline is off by calibration and segmentation.
constexpr float agreed_m = 0.012F;
/// Deeper in the hull of all others no true gap lies, such as between arm and trunk, that one camera alone sees
/// through. Measured on standing people: up to 40 mm with ten cameras around, 45 mm with eight.
constexpr float deep_m = 0.06F;
constexpr int fewest_witnesses = 4;       // for a part that is missing
constexpr int fewest_deep_witnesses = 6;  // for a hole: with few cameras true concavities are deep
/// Around a point of the missing part as much as lies between the points and within the agreement's margin.
constexpr double reach_m = 0.03;

constexpr int looks_across = 60;  ///< pixels along an image's shorter side that are looked at for what is unexplained

/// A point that one camera alone denies.
struct Denied {
  std::array<int, 3> place;
  uint32_t view;
  bool deep;    ///< inside the hull of all others
  bool proven;  ///< that the camera is wrong
};

/// Whether a line through a point meets the hull, in steps of a sample; it passes the nearest sample by less than a
/// voxel.
bool meets(const Field& hull, const Eigen::Vector3d& p, const Eigen::Vector3d& direction) {
  const Grid& grid = hull.grid();
  for (const double way : {1.0, -1.0}) {
    const Eigen::Vector3d step = way * direction;
    Eigen::Vector3d at = (p - grid.origin) / grid.voxel_m;
    while (true) {
      const auto i = static_cast<int>(std::lround(at.x())), j = static_cast<int>(std::lround(at.y()));
      const auto k = static_cast<int>(std::lround(at.z()));
      if (i < 0 || j < 0 || k < 0 || i >= grid.size[0] || j >= grid.size[1] || k >= grid.size[2]) break;
      if (static_cast<double>(hull.at(i, j, k)) < grid.voxel_m) return true;
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
    std::vector<std::vector<Denied>> layers(static_cast<size_t>(size_[1]));
    work.parallel_for(layers.size(), 1, [&](size_t begin, size_t end) {
      for (size_t y = begin; y < end; ++y)
        if (!work.stopped()) layers[y] = look_at_layer(static_cast<int>(y));
    });
    std::vector<Denied> all;
    for (const auto& layer : layers) all.insert(all.end(), layer.begin(), layer.end());
    return all;
  }

  Eigen::Vector3d point(const std::array<int, 3>& place) const {
    return origin_ + spacing_m * Eigen::Vector3d(place[0], place[1], place[2]);
  }

 private:
  std::vector<Denied> look_at_layer(int y) const {
    std::vector<Denied> found;
    // Whoever denies a point mostly denies the next one: asked first, two of them settle it.
    std::vector<uint32_t> order(views_.size());
    for (uint32_t v = 0; v < order.size(); ++v) order[v] = v;
    for (int z = 0; z < size_[2]; ++z)
      for (int x = 0; x < size_[0]; ++x) {
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
        if (deniers != 1 || witnesses < fewest_witnesses || least_agreed > -agreed_m) continue;
        const bool deep = witnesses >= fewest_deep_witnesses && least_agreed < -deep_m;
        found.push_back({place, order[0], deep, missed_by_a_ray(p, order[0])});
      }
    return found;
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

/// Keeps the points of one view that hang together with a proven one.
std::vector<Denied> proven_parts(const std::vector<Denied>& points) {
  std::vector<bool> kept(points.size());
  std::vector<size_t> waiting;
  const auto keep = [&](size_t n) {
    if (kept[n]) return;
    kept[n] = true;
    waiting.push_back(n);
  };
  for (size_t n = 0; n < points.size(); ++n)
    if (points[n].proven) keep(n);
  while (!waiting.empty()) {
    const Denied& center = points[waiting.back()];
    waiting.pop_back();
    for (size_t n = 0; n < points.size(); ++n) {
      int apart = 0;
      for (size_t axis = 0; axis < 3; ++axis)
        apart = std::max(apart, std::abs(points[n].place[axis] - center.place[axis]));
      if (apart <= 1) keep(n);
    }
  }
  std::vector<Denied> parts;
  for (size_t n = 0; n < points.size(); ++n)
    if (kept[n]) parts.push_back(points[n]);
  return parts;
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
        if (point.deep && outer.at(x, y) == 0 && coverage.at(x, y) < 128) point.proven = true;
      }
    }
    Contradiction contradiction{v, {}};
    for (const Denied& part : proven_parts(own)) contradiction.discs.push_back(project(part));
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
