#include "pipeline/refine/photo_consistency.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

/// Between the samples of a patch, on the surface, and at least a pixel of the usual camera.
constexpr double least_spacing_m = 0.0025;

/// In steps of the spacing: moved by so much along the normal, what neighbouring cameras of a booth see on a patch
/// shifts by less than a sample.
constexpr int most_steps = 16;         // to either side
constexpr float least_frontal = 0.4F;  // cosine between the normal and the sight
constexpr size_t most_cameras = 4;
/// Standard deviation over a patch, grey levels: with less there is only noise to compare.
constexpr float least_contrast = 1.5F;
constexpr float unknown = -2;  // a correlation that cannot be told

/// Where the subject is: left, top, right, bottom, the last two beyond it; all 0 where it is nowhere.
std::array<int, 4> box_of(const Image& coverage) {
  std::array<int, 4> box{coverage.width, coverage.height, 0, 0};
  for (int y = 0; y < coverage.height; ++y) {
    const uint8_t* row = coverage.pixel(0, y);
    const uint8_t* end = row + coverage.width;
    const uint8_t* first = std::find_if(row, end, [](uint8_t value) { return value >= 128; });
    if (first == end) continue;
    const uint8_t* last = end;
    while (last[-1] < 128) --last;
    box = {std::min(box[0], static_cast<int>(first - row)), std::min(box[1], y),
           std::max(box[2], static_cast<int>(last - row)), y + 1};
  }
  return box[2] > 0 ? box : std::array<int, 4>{};
}

/// How far the best place is to be believed: how alike it looks, and how much less so every other place that is best
/// around itself.
float confidence_of(std::span<const float> alike, size_t top) {
  constexpr float least = 0.6F, full = 0.85F, distinct = 0.3F, ripple = 0.05F;
  float second = -1;
  const auto walk = [&](int direction) {
    float lowest = alike[top];
    for (auto n = static_cast<int>(top) + direction; n >= 0 && n < static_cast<int>(alike.size()); n += direction) {
      const float here = alike[static_cast<size_t>(n)];
      lowest = std::min(lowest, here);
      if (here > lowest + ripple) second = std::max(second, here);
    }
  };
  walk(-1);
  walk(1);
  const float good = std::clamp((alike[top] - least) / (full - least), 0.0F, 1.0F);
  return good * std::clamp((alike[top] - second) / distinct, 0.0F, 1.0F);
}

/// A unit vector at a right angle to a normal.
Eigen::Vector3f across(const Eigen::Vector3f& normal) {
  return Eigen::Vector3f::Unit(std::abs(normal.y()) < 0.9F ? 1 : 0).cross(normal).normalized();
}

/// The guess's surface near a point of the hull, but not outside it, and its normal; nothing where there is none.
std::optional<std::pair<Eigen::Vector3f, Eigen::Vector3f>> foot_of(const SmoothDistance& guess, Eigen::Vector3f p) {
  constexpr float farthest_m = 0.08F, least_slope = 0.3F;
  const Eigen::Vector3f from = p;
  for (int pass = 0;; ++pass) {
    const Eigen::Vector3f slope = guess.slope(p);
    if (!(slope.norm() > least_slope) || !((p - from).norm() < farthest_m)) return std::nullopt;
    constexpr int passes = 3;
    if (pass == passes || guess.at(from) <= 0) return std::pair(p, Eigen::Vector3f(slope.normalized()));
    p -= slope * (guess.at(p) / slope.squaredNorm());
  }
}

}  // namespace

PhotoConsistency::PhotoConsistency(std::span<const Frame> frames, const SilhouetteViews& views, const Field& hull,
                                   const Work& work)
    : views_(views), hull_(hull), greys_(views.size()) {
  const Grid& grid = hull.grid();
  const Eigen::Vector3d middle =
      grid.origin + 0.5 * grid.voxel_m * Eigen::Vector3d(grid.size[0], grid.size[1], grid.size[2]);
  std::vector<double> pixels_m;  // at the subject, by view
  for (const auto& view : views)
    pixels_m.push_back((view->camera().center() - middle).norm() * static_cast<double>(view->per_focal()));
  std::vector<double> ranked = pixels_m;
  std::sort(ranked.begin(), ranked.end());
  if (!ranked.empty()) spacing_m_ = static_cast<float>(std::max(least_spacing_m, ranked[ranked.size() / 2]));
  work.parallel_for(views.size(), 1, [&](size_t begin, size_t end) {
    for (size_t v = begin; v < end; ++v) {
      const RigCamera& camera = views[v]->camera();
      const auto frame =
          std::find_if(frames.begin(), frames.end(), [&](const Frame& f) { return f.camera == camera.id; });
      if (frame == frames.end() || frame->pixels->width != camera.intrinsics.width ||
          frame->pixels->height != camera.intrinsics.height)
        continue;
      // Until a pixel is about as large as the spacing, so that noise averages out and nothing between is missed.
      constexpr double about = 0.3;
      constexpr int most_shrunk = 16;
      const int by =
          std::clamp(static_cast<int>(static_cast<double>(spacing_m_) / pixels_m[v] + about), 1, most_shrunk);
      greys_[v] = shrink(*frame->pixels, views[v]->coverage(), by);
    }
  });
}

PhotoConsistency::Grey PhotoConsistency::shrink(const Image& picture, const Image& coverage, int by) {
  constexpr int margin = 2 * half_side;  // patches reach beyond the outline
  const auto [left, top, right, bottom] = box_of(coverage);
  Grey grey{by, std::max(0, left / by - margin), std::max(0, top / by - margin), {}};
  grey.image = Image(std::min(picture.width / by, right / by + margin) - grey.left,
                     std::min(picture.height / by, bottom / by + margin) - grey.top, 1);
  const bool colour = picture.channels >= 3;
  const unsigned count = static_cast<unsigned>(by) * static_cast<unsigned>(by) * (colour ? 4U : 1U);
  std::vector<unsigned> sums(static_cast<size_t>(grey.image.width));
  for (int y = 0; y < grey.image.height; ++y) {
    std::fill(sums.begin(), sums.end(), 0U);
    for (int j = 0; j < by; ++j) {
      const uint8_t* p = picture.pixel(grey.left * by, (grey.top + y) * by + j);
      for (unsigned& sum : sums)
        for (int i = 0; i < by; ++i, p += picture.channels)
          sum += colour ? static_cast<unsigned>(p[0]) + 2U * p[1] + p[2] : p[0];
    }
    std::transform(sums.begin(), sums.end(), grey.image.pixel(0, y),
                   [&](unsigned sum) { return static_cast<uint8_t>((sum + count / 2) / count); });
  }
  return grey;
}

std::vector<std::optional<SeenSurface>> PhotoConsistency::find(const SmoothDistance& guess,
                                                               std::span<const HullSample> samples, double inwards_m,
                                                               const Work& work) const {
  const int inwards =
      std::clamp(static_cast<int>(std::lround(inwards_m / static_cast<double>(spacing_m_))), 1, most_steps);
  std::vector<std::optional<SeenSurface>> seen(samples.size());
  constexpr size_t grain = 32;
  work.parallel_for(samples.size(), grain, [&](size_t begin, size_t end) {
    for (size_t s = begin; s < end; ++s)
      if (!work.stopped()) seen[s] = look(guess, samples[s], inwards);
  });
  return seen;
}

std::optional<SeenSurface> PhotoConsistency::look(const SmoothDistance& guess, const HullSample& sample,
                                                  int inwards) const {
  const auto foot = foot_of(guess, sample.position);
  if (!foot) return std::nullopt;
  const auto& [middle, normal] = *foot;
  const std::vector<size_t> seeing = cameras_that_see(guess, {middle, normal});
  if (seeing.size() < 2) return std::nullopt;

  const Eigen::Vector3f right = across(normal);
  const Eigen::Vector3f up = normal.cross(right);
  // There is nothing outside the hull.
  const float below_hull_m = normal.dot(sample.position - middle);
  const int outwards = std::clamp(static_cast<int>(std::ceil(below_hull_m / spacing_m_)) + 1, 1, most_steps);
  const auto inwards_m = [&](float step) { return spacing_m_ * (step - static_cast<float>(outwards)); };
  std::array<float, 2 * most_steps + 1> alike{};
  const std::span<float> tried(alike.data(), static_cast<size_t>(outwards + inwards + 1));
  for (size_t n = 0; n < tried.size(); ++n)
    tried[n] = likeness(seeing, middle - inwards_m(static_cast<float>(n)) * normal, right, up);
  const auto top = static_cast<size_t>(std::max_element(tried.begin(), tried.end()) - tried.begin());
  if (top == 0 || top + 1 == tried.size() || !(std::min(tried[top - 1], tried[top + 1]) > unknown)) return std::nullopt;
  const float bend = tried[top - 1] - 2 * tried[top] + tried[top + 1];
  constexpr float of_two = 0.6F;  // two cameras alone are easier misled
  const float confidence = confidence_of(tried, top) * (seeing.size() > 2 ? 1 : of_two);
  if (!(bend < 0) || !(confidence > 0)) return std::nullopt;
  const float between = 0.5F * (tried[top - 1] - tried[top + 1]) / bend;
  return SeenSurface{middle - inwards_m(static_cast<float>(top) + between) * normal, normal, confidence};
}

/// The most frontal ones, in that order.
std::vector<size_t> PhotoConsistency::cameras_that_see(const SmoothDistance& guess, const Place& place) const {
  const auto& [p, normal] = place;
  std::vector<std::pair<float, size_t>> seeing;
  for (size_t v = 0; v < views_.size(); ++v) {
    if (greys_[v].image.empty()) continue;
    const Eigen::Vector3f sight = (views_[v]->camera().center().cast<float>() - p).normalized();
    const float frontal = sight.dot(normal);
    if (frontal < least_frontal || !(views_[v]->distance_m(p) < 0) || is_hidden(guess, p, sight)) continue;
    seeing.emplace_back(-frontal, v);
  }
  std::sort(seeing.begin(), seeing.end());
  if (seeing.size() > most_cameras) seeing.resize(most_cameras);
  std::vector<size_t> cameras;
  for (const auto& [frontal, v] : seeing) cameras.push_back(v);
  return cameras;
}

/// Whether something is before a place of the guess: the guess itself, or the hull again after it was left.
bool PhotoConsistency::is_hidden(const SmoothDistance& guess, const Eigen::Vector3f& p,
                                 const Eigen::Vector3f& sight) const {
  constexpr float first_m = 0.01F, stride_m = 0.006F, farthest_m = 1, own_m = 0.02F, deep_m = 0.002F;
  bool left = false;
  for (float t = first_m; t < farthest_m; t += stride_m) {
    const Eigen::Vector3f at = p + t * sight;
    if (!is_in_hull(at))
      left = true;
    else if (left || (t > own_m && guess.at(at) < -deep_m))
      return true;
  }
  return false;
}

bool PhotoConsistency::is_in_hull(const Eigen::Vector3f& p) const {
  const Grid& grid = hull_.grid();
  const Eigen::Vector3f at = (p - grid.origin.cast<float>()) / static_cast<float>(grid.voxel_m);
  const auto i = static_cast<int>(std::lround(at.x())), j = static_cast<int>(std::lround(at.y()));
  const auto k = static_cast<int>(std::lround(at.z()));
  if (i < 0 || j < 0 || k < 0 || i >= grid.size[0] || j >= grid.size[1] || k >= grid.size[2]) return false;
  return hull_.at(i, j, k) < 0;
}

/// The mean correlation of the first camera's patch with the others'; unknown where it cannot be told.
float PhotoConsistency::likeness(const std::vector<size_t>& seeing, const Eigen::Vector3f& middle,
                                 const Eigen::Vector3f& right, const Eigen::Vector3f& up) const {
  Patch reference, other;
  if (!look_at(seeing[0], middle, right, up, reference)) return unknown;
  float sum = 0;
  int compared = 0;
  for (size_t n = 1; n < seeing.size(); ++n) {
    if (!look_at(seeing[n], middle, right, up, other)) continue;
    for (size_t s = 0; s < patch_samples; ++s) sum += reference[s] * other[s];
    ++compared;
  }
  return compared > 0 ? sum / static_cast<float>(compared) : unknown;
}

/// The patch as a camera sees it, zero mean and unit length; false where it leaves the picture or the outline of the
/// subject, or has no contrast. So small a patch is seen as through a parallel projection.
BOOTH_VECTOR_CLONES
bool PhotoConsistency::look_at(size_t view, const Eigen::Vector3f& middle, const Eigen::Vector3f& right,
                               const Eigen::Vector3f& up, Patch& patch) const {
  const auto place = [&](const Eigen::Vector3f& p) {
    Eigen::Vector2f pixel;
    float depth_m, within_px;
    views_[view]->project(p.x(), p.y(), p.z(), pixel.x(), pixel.y(), depth_m, within_px);
    return pixel;
  };
  const float reach_m = half_side * spacing_m_;
  Eigen::Vector2f at = place(middle);
  Eigen::Vector2f across = place(middle + reach_m * right) - at, along = place(middle + reach_m * up) - at;
  for (const float i : {-1.0F, 1.0F})
    for (const float j : {-1.0F, 1.0F}) {
      const Eigen::Vector2f corner = at + i * across + j * along;
      if (!(views_[view]->outline().at(corner.x(), corner.y()) < 0)) return false;
    }
  const Grey& grey = greys_[view];
  const auto shrunk = static_cast<float>(grey.shrunk);
  at = (at + Eigen::Vector2f::Constant(0.5F)) / shrunk -
       Eigen::Vector2f(static_cast<float>(grey.left) + 0.5F, static_cast<float>(grey.top) + 0.5F);
  across /= shrunk;
  along /= shrunk;
  const Eigen::Vector2f spread = across.cwiseAbs() + along.cwiseAbs();
  if (!(at.x() - spread.x() >= 0 && at.y() - spread.y() >= 0 &&
        at.x() + spread.x() < static_cast<float>(grey.image.width - 1) &&
        at.y() + spread.y() < static_cast<float>(grey.image.height - 1)))
    return false;
  across /= half_side;
  along /= half_side;
  const uint8_t* pixels = grey.image.samples.data();
  const int stride = grey.image.width;
  std::array<int, patch_samples> place_of;
  Patch u, v;
  size_t s = 0;
  for (int j = -half_side; j <= half_side; ++j)
    for (int i = -half_side; i <= half_side; ++i, ++s) {
      const float x = at.x() + static_cast<float>(i) * across.x() + static_cast<float>(j) * along.x();
      const float y = at.y() + static_cast<float>(i) * across.y() + static_cast<float>(j) * along.y();
      const auto left = static_cast<int>(x), top = static_cast<int>(y);
      u[s] = x - static_cast<float>(left);
      v[s] = y - static_cast<float>(top);
      place_of[s] = top * stride + left;
    }
  Patch a, b, c, d;
  for (s = 0; s < patch_samples; ++s) {
    const uint8_t* p = pixels + place_of[s];
    a[s] = p[0];
    b[s] = p[1];
    c[s] = p[stride];
    d[s] = p[stride + 1];
  }
  float sum = 0;
  for (s = 0; s < patch_samples; ++s) {
    const float upper = a[s] + u[s] * (b[s] - a[s]), lower = c[s] + u[s] * (d[s] - c[s]);
    patch[s] = upper + v[s] * (lower - upper);
    sum += patch[s];
  }
  const float mean = sum / static_cast<float>(patch_samples);
  float square = 0;
  for (float& value : patch) {
    value -= mean;
    square += value * value;
  }
  if (!(square > least_contrast * least_contrast * static_cast<float>(patch_samples))) return false;
  const float scale = 1 / std::sqrt(square);
  for (float& value : patch) value *= scale;
  return true;
}

}  // namespace booth
