#include "pipeline/face/patch_matching.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

namespace booth {
namespace {

constexpr int side = 11;  // samples of a patch, across and down
using Patch = Eigen::Array<float, side * side, 1>;

/// The patch as a picture sees it, zero mean and unit length; nothing where it leaves the picture or has no contrast.
std::optional<Patch> look_at(const PinholePicture& picture, const Eigen::Vector3d& middle, const Eigen::Vector3d& right,
                             const Eigen::Vector3d& down) {
  const Intrinsics& k = picture.view.intrinsics;
  const Eigen::Vector3f at = (picture.view.camera_from_world * middle).cast<float>();
  const Eigen::Vector3f across = (picture.view.camera_from_world.linear() * right).cast<float>();
  const Eigen::Vector3f along = (picture.view.camera_from_world.linear() * down).cast<float>();
  const auto fx = static_cast<float>(k.fx), fy = static_cast<float>(k.fy), cx = static_cast<float>(k.cx),
             cy = static_cast<float>(k.cy);
  const auto last_x = static_cast<float>(picture.grey.width - 1), last_y = static_cast<float>(picture.grey.height - 1);
  Patch patch;
  for (int j = 0; j < side; ++j)
    for (int i = 0; i < side; ++i) {
      constexpr float half = (side - 1) / 2;
      const Eigen::Vector3f p =
          at + (static_cast<float>(i) / half - 1) * across + (static_cast<float>(j) / half - 1) * along;
      const float per_depth = 1 / p.z(), x = fx * p.x() * per_depth + cx, y = fy * p.y() * per_depth + cy;
      if (!(p.z() > 0 && x >= 0 && y >= 0 && x < last_x && y < last_y)) return std::nullopt;
      const int left = static_cast<int>(x), top = static_cast<int>(y);
      const float u = x - static_cast<float>(left), v = y - static_cast<float>(top);
      const uint8_t* upper = picture.grey.pixel(left, top);
      const uint8_t* lower = upper + picture.grey.width;
      patch[j * side + i] = (1 - v) * ((1 - u) * upper[0] + u * upper[1]) + v * ((1 - u) * lower[0] + u * lower[1]);
    }
  patch -= patch.mean();
  const float length = std::sqrt(patch.square().sum());
  constexpr float least_contrast = 3;  // grey levels, standard deviation: below it is noise that is compared
  if (!(length > least_contrast * side)) return std::nullopt;
  return patch / length;
}

constexpr double most_slant = 0.5;  // cos 60°

}  // namespace

std::optional<double> patch_correlation(const PinholePicture& reference, std::span<const PinholePicture* const> others,
                                        const Eigen::Vector3d& point, const Eigen::Vector3d& normal,
                                        double half_size_m) {
  const auto faces = [&](const PinholePicture& picture) {
    return (picture.view.center() - point).normalized().dot(normal) > most_slant;
  };
  if (!faces(reference)) return std::nullopt;
  const Eigen::Vector3d right = half_size_m * Eigen::Vector3d::UnitY().cross(normal).normalized();
  const Eigen::Vector3d down = right.cross(normal);
  const auto expected = look_at(reference, point, right, down);
  if (!expected) return std::nullopt;
  double sum = 0;
  int seen = 0;
  for (const PinholePicture* other : others) {
    if (!faces(*other)) continue;
    if (const auto patch = look_at(*other, point, right, down)) {
      sum += static_cast<double>((*expected * *patch).sum());
      ++seen;
    }
  }
  if (seen == 0) return std::nullopt;
  return sum / seen;
}

std::optional<PatchMatch> match_patch(const PinholePicture& reference, std::span<const PinholePicture* const> others,
                                      const Eigen::Vector3d& point, const Eigen::Vector3d& normal,
                                      const PatchSearch& search) {
  constexpr int steps = 12;  // to each side
  const Eigen::Vector3d eye = reference.view.center(), sight = (point - eye).normalized();
  const double step_m = search.range_m / steps;
  const Eigen::Vector3d right = Eigen::Vector3d::UnitY().cross(normal).normalized(), up = normal.cross(right);

  std::array<double, 2 * steps + 1> best{};
  best.fill(-1);
  constexpr double tilt = 0.5;
  constexpr std::array<std::array<double, 2>, 5> tilts{{{0, 0}, {tilt, 0}, {-tilt, 0}, {0, tilt}, {0, -tilt}}};
  for (const auto& [sideways, upwards] : tilts) {
    const Eigen::Vector3d facing = (normal + sideways * right + upwards * up).normalized();
    const Eigen::Vector3d across = search.half_size_m * up.cross(facing).normalized();
    const Eigen::Vector3d down = across.cross(facing);
    std::vector<const PinholePicture*> seeing;
    for (const PinholePicture* other : others)
      if ((other->view.center() - point).normalized().dot(facing) > most_slant) seeing.push_back(other);
    if (seeing.empty() || -sight.dot(facing) < most_slant) continue;
    for (int s = -steps; s <= steps; ++s) {
      const Eigen::Vector3d middle = point + s * step_m * sight;
      const auto expected = look_at(reference, middle, across, down);
      if (!expected) continue;
      double sum = 0;
      for (const PinholePicture* other : seeing)
        if (const auto patch = look_at(*other, middle, across, down))
          sum += static_cast<double>((*expected * *patch).sum());
      double& so_far = best[static_cast<size_t>(s + steps)];
      so_far = std::max(so_far, sum / static_cast<double>(seeing.size()));
    }
  }
  const auto top = static_cast<int>(std::max_element(best.begin(), best.end()) - best.begin());
  if (top == 0 || top == 2 * steps || best[static_cast<size_t>(top)] < search.least_correlation) return std::nullopt;
  // A second place that looks nearly as good, with a worse one between, leaves it open which it is.
  constexpr double distinct = 0.05;
  for (const int direction : {-1, 1}) {
    double least = best[static_cast<size_t>(top)];
    for (int s = top + direction; s >= 0 && s <= 2 * steps; s += direction) {
      const double here = best[static_cast<size_t>(s)];
      least = std::min(least, here);
      if (here > best[static_cast<size_t>(top)] - distinct && here > least + distinct / 2) return std::nullopt;
    }
  }
  const double here = best[static_cast<size_t>(top)], before = best[static_cast<size_t>(top - 1)],
               after = best[static_cast<size_t>(top + 1)];
  const double bend = before - 2 * here + after;
  if (!(bend < 0)) return std::nullopt;
  PatchMatch match;
  match.depth_m = (top - steps + 0.5 * (before - after) / bend) * step_m;
  match.correlation = here;
  // How far the correlation stays within what noise makes of it: 1 − c at the top is noise's share.
  match.sigma_m = std::sqrt(std::max(1 - here, 0.01) / -bend) * step_m;
  return match;
}

}  // namespace booth
