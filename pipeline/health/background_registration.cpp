#include "pipeline/health/background_registration.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

namespace booth {
namespace {

/// Samples that the finest level has at least, where the picture has: finer ones cost more than they add.
constexpr double fewest_samples = 120000;
/// So many have a say in all, those with the steepest lightness: the others hold mostly noise.
constexpr size_t most_telling = 28800;
/// The coarsest level's shorter side: a motion of a third of it is still found.
constexpr int coarsest_side = 60;
/// Lightness is log(v + offset) of an sRGB value v, in which light that dims by a factor only adds a constant.
constexpr float srgb_offset = 0.055F * 255.0F;
/// Half the side, in samples, of the square whose mean is taken off: shadows and light vary more slowly.
constexpr int slow_radius = 8;
/// So many samples beside the subject its soft shadow and blurred outline are left out too.
constexpr int subject_margin = 4;
constexpr int rounds_a_level = 15;
constexpr double settled = 0.004, settled_coarsely = 0.05;  ///< samples: a smaller step is the last of a level
/// Residuals beyond so many typical ones lose their say. At an edge a residual may be what a shift by so much leaves,
/// in samples of the level, less from round to round: otherwise the few edges before a plain wall would seem to be
/// faults.
constexpr double robust_scale = 3;
constexpr double first_slack = 0.5, least_slack = 0.03;
constexpr double slack_factor = 0.5;
/// Typical residuals are no smaller than what rounding to 8 bits leaves.
constexpr float least_residual = 0.002F;
/// Parts of the picture along its longer side that are taken to err independently of each other.
constexpr size_t parts_along = 12;
/// With fewer parts that bear any background nobody can tell.
constexpr int fewest_parts = 12;
/// Standard deviations of the picture's shift: without any evidence; of a camera that nobody touched (its mount
/// trembles and warms up).
constexpr double anywhere_px = 50;
constexpr double trembling = 5e-5;  ///< of the picture's diagonal
constexpr double least_trembling_px = 0.03;
/// A camera was moved whose picture did by more standard deviations than this.
constexpr double surely = 4;

/// Rotation (3) and growth (1).
using Motion = Eigen::Matrix<double, 4, 1>;
using MotionMatrix = Eigen::Matrix<double, 4, 4>;

/// How the place (x, y) in the plane z = 1 moves by each part of the motion, in focal lengths.
struct Flow {
  Motion across, down;
};
Flow flow_at(double x, double y) { return {Motion(-x * y, 1 + x * x, -y, x), Motion(-1 - y * y, x * y, x, y)}; }

/// One level of a pyramid.
struct Level {
  int width = 0, height = 0;
  std::vector<float> background, frame;  ///< lightness
  std::vector<float> open;               ///< 1 where the frame shows the background, 0 elsewhere

  size_t index(int x, int y) const {
    return static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x);
  }
};

/// The lightness of the image's mean in squares of `step` pixels; of colours the green, which is the least noisy.
std::vector<float> lightness_of(const Image& image, int step, int width, int height) {
  std::vector<float> lightness(static_cast<size_t>(width) * static_cast<size_t>(height));
  const int channels = image.channels;
  const int channel = channels == 3 ? 1 : 0;
  const float weight = 1.0F / static_cast<float>(step * step);
  std::vector<float> lightness_of_sum(static_cast<size_t>(255 * step * step) + 1);
  for (size_t sum = 0; sum < lightness_of_sum.size(); ++sum)
    lightness_of_sum[sum] = std::log(static_cast<float>(sum) * weight + srgb_offset);
  std::vector<int> sums(static_cast<size_t>(width));
  for (int y = 0; y < height; ++y) {
    std::fill(sums.begin(), sums.end(), 0);
    for (int dy = 0; dy < step; ++dy) {
      const uint8_t* samples = image.pixel(0, y * step + dy) + channel;
      for (int& sum : sums)
        for (int dx = 0; dx < step; ++dx, samples += channels) sum += *samples;
    }
    float* row = lightness.data() + static_cast<size_t>(y) * static_cast<size_t>(width);
    for (size_t x = 0; x < sums.size(); ++x) row[x] = lightness_of_sum[static_cast<size_t>(sums[x])];
  }
  return lightness;
}

/// 1 where no pixel of the square, nor of those near it, belongs to the subject.
std::vector<float> open_places(const Image& subject, int step, int width, int height) {
  std::vector<float> open(static_cast<size_t>(width) * static_cast<size_t>(height), 1.0F);
  if (subject.empty()) return open;
  std::vector<uint8_t> covered(static_cast<size_t>(width));
  for (int y = 0; y < height; ++y) {
    std::fill(covered.begin(), covered.end(), uint8_t{0});
    for (int dy = 0; dy < step; ++dy) {
      const uint8_t* samples = subject.pixel(0, y * step + dy);
      for (uint8_t& any : covered)
        for (int dx = 0; dx < step; ++dx) any |= *samples++;
    }
    for (int x = 0; x < width; ++x) {
      if (covered[static_cast<size_t>(x)] == 0) continue;
      const int left = std::max(0, x - subject_margin), right = std::min(width - 1, x + subject_margin);
      // The margin above and below is left to the rows there.
      for (int row = std::max(0, y - subject_margin); row <= std::min(height - 1, y + subject_margin);
           row += subject_margin) {
        float* at = open.data() + static_cast<size_t>(row) * static_cast<size_t>(width);
        std::fill(at + left, at + right + 1, 0.0F);
      }
    }
  }
  return open;
}

Level halved(const Level& fine) {
  Level coarse;
  coarse.width = fine.width / 2;
  coarse.height = fine.height / 2;
  const size_t count = static_cast<size_t>(coarse.width) * static_cast<size_t>(coarse.height);
  coarse.background.resize(count);
  coarse.frame.resize(count);
  coarse.open.resize(count);
  for (int y = 0; y < coarse.height; ++y)
    for (int x = 0; x < coarse.width; ++x) {
      const size_t a = fine.index(2 * x, 2 * y), b = fine.index(2 * x, 2 * y + 1), to = coarse.index(x, y);
      const auto mean = [&](const std::vector<float>& v) { return (v[a] + v[a + 1] + v[b] + v[b + 1]) / 4; };
      coarse.background[to] = mean(fine.background);
      coarse.frame[to] = mean(fine.frame);
      coarse.open[to] = std::min({fine.open[a], fine.open[a + 1], fine.open[b], fine.open[b + 1]});
    }
  return coarse;
}

/// Sums over squares of 2 r + 1 samples, cut off at the border.
std::vector<float> box_sums(const std::vector<float>& values, int width, int height, int r) {
  const auto row_of = [width](int y) { return static_cast<size_t>(y) * static_cast<size_t>(width); };
  std::vector<float> across(values.size()), sums(values.size());
  for (int y = 0; y < height; ++y) {
    const float* in = values.data() + row_of(y);
    float* out = across.data() + row_of(y);
    double sum = 0;
    for (int x = 0; x < std::min(r, width); ++x) sum += in[x];
    for (int x = 0; x < width; ++x) {
      if (x + r < width) sum += in[x + r];
      if (x - r - 1 >= 0) sum -= in[x - r - 1];
      out[x] = static_cast<float>(sum);
    }
  }
  std::vector<double> columns(static_cast<size_t>(width));
  const auto add = [&](int y, double sign) {
    const float* in = across.data() + row_of(y);
    for (int x = 0; x < width; ++x) columns[static_cast<size_t>(x)] += sign * static_cast<double>(in[x]);
  };
  for (int y = 0; y < std::min(r, height); ++y) add(y, 1);
  for (int y = 0; y < height; ++y) {
    if (y + r < height) add(y + r, 1);
    if (y - r - 1 >= 0) add(y - r - 1, -1);
    std::copy(columns.begin(), columns.end(), sums.begin() + static_cast<std::ptrdiff_t>(row_of(y)));
  }
  return sums;
}

/// Binomial smoothing over 5 × 5 samples of all but a border of two: without it noise passes for texture, and every
/// step of the registration falls short.
void smooth(std::vector<float>& values, int width, int height) {
  const auto at = [width](int x, int y) {
    return static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x);
  };
  const auto binomial = [](const float* v, size_t step) {
    return (v[0] + v[4 * step] + 4 * (v[step] + v[3 * step]) + 6 * v[2 * step]) / 16;
  };
  std::vector<float> across = values;
  for (int y = 0; y < height; ++y)
    for (int x = 2; x + 2 < width; ++x) across[at(x, y)] = binomial(&values[at(x - 2, y)], 1);
  for (int y = 2; y + 2 < height; ++y)
    for (int x = 0; x < width; ++x) values[at(x, y)] = binomial(&across[at(x, y - 2)], static_cast<size_t>(width));
}

/// Takes off the mean of what is open around each place.
void take_slow_part_off(std::vector<float>& lightness, const std::vector<float>& open, const std::vector<float>& opened,
                        int width, int height) {
  std::vector<float> weighted(lightness.size());
  for (size_t i = 0; i < lightness.size(); ++i) weighted[i] = lightness[i] * open[i];
  const std::vector<float> sums = box_sums(weighted, width, height, slow_radius);
  for (size_t i = 0; i < lightness.size(); ++i) lightness[i] -= opened[i] > 0.5F ? sums[i] / opened[i] : lightness[i];
}

/// A place that tells something about the motion.
struct Sample {
  float x, y;          ///< in the level
  float across, down;  ///< gradient of the background's lightness, a sample
  float lightness;     ///< of the background
};

/// The normal equations of one round, and by part of the picture what they are made of.
struct Evidence {
  MotionMatrix squares = MotionMatrix::Zero();
  Motion right = Motion::Zero();
  std::vector<Motion> parts;
  std::vector<int> counts;
};

/// One level of the registration.
class Registration {
 public:
  /// @param cell_px  the side of a sample, pixels
  Registration(Level level, double cell_px, const Intrinsics& k) : level_(std::move(level)), cell_px_(cell_px), k_(k) {
    smooth(level_.background, level_.width, level_.height);
    smooth(level_.frame, level_.width, level_.height);
    const std::vector<float> opened = box_sums(level_.open, level_.width, level_.height, slow_radius);
    take_slow_part_off(level_.background, level_.open, opened, level_.width, level_.height);
    take_slow_part_off(level_.frame, level_.open, opened, level_.width, level_.height);
    constexpr int border = 3;  // what is not smoothed, and a gradient's reach
    for (int y = border; y + border < level_.height; ++y)
      for (int x = border; x + border < level_.width; ++x) {
        const size_t i = level_.index(x, y);
        const auto width = static_cast<size_t>(level_.width);
        if (level_.open[i - 1] * level_.open[i + 1] * level_.open[i - width] * level_.open[i + width] == 0) continue;
        const std::vector<float>& v = level_.background;
        samples_.push_back({static_cast<float>(x), static_cast<float>(y), (v[i + 1] - v[i - 1]) / 2,
                            (v[i + width] - v[i - width]) / 2, v[i]});
      }
    keep_telling();
  }

  /// Improves the motion. @return what the last round knew; nothing when too little was open
  std::optional<Evidence> improve(Motion& motion, bool finest) const {
    Evidence evidence;
    double slack = first_slack;
    for (int round = 0; round < rounds_a_level; ++round) {
      auto found = gather(motion, slack);
      if (!found) return std::nullopt;
      evidence = std::move(*found);
      const Motion step = evidence.squares.ldlt().solve(evidence.right - prior() * motion);
      motion += step;
      const double moved = shift_px(step) / cell_px_;
      if (moved < (finest ? settled : settled_coarsely) && (!finest || slack == least_slack)) break;
      if (finest) slack = std::max(least_slack, slack * slack_factor);
    }
    return evidence;
  }

  /// The root of the mean square shift over the picture.
  double shift_px(const Motion& motion) const { return std::sqrt(std::max(0.0, motion.dot(spread() * motion))); }

  /// Mean products of the shifts that the parts of the motion make, px².
  MotionMatrix spread() const {
    MotionMatrix sum = MotionMatrix::Zero();
    constexpr int grid = 8;
    for (int j = 0; j < grid; ++j)
      for (int i = 0; i < grid; ++i) {
        const Flow flow =
            flow_at(((i + 0.5) / grid * k_.width - k_.cx) / k_.fx, ((j + 0.5) / grid * k_.height - k_.cy) / k_.fy);
        sum +=
            k_.fx * k_.fx * flow.across * flow.across.transpose() + k_.fy * k_.fy * flow.down * flow.down.transpose();
      }
    return sum / (grid * grid);
  }

  /// The inverse covariance of a motion of which each part alone would shift the picture by that much.
  MotionMatrix information_of(double px) const { return MotionMatrix(spread().diagonal().asDiagonal()) / (px * px); }

 private:
  /// Of each part of the picture the steepest, so that no part speaks for all.
  void keep_telling() {
    constexpr size_t most = most_telling / (parts_along * parts_along);
    std::vector<std::vector<float>> steepness(parts_along * parts_along);
    const auto steepness_of = [](const Sample& s) { return s.across * s.across + s.down * s.down; };
    for (const Sample& s : samples_) steepness[part_of(s)].push_back(steepness_of(s));
    std::vector<float> least(steepness.size());
    for (size_t part = 0; part < steepness.size(); ++part) {
      std::vector<float>& all = steepness[part];
      if (all.size() <= most) continue;
      const auto at = all.begin() + static_cast<std::ptrdiff_t>(all.size() - most);
      std::nth_element(all.begin(), at, all.end());
      least[part] = *at;
    }
    std::erase_if(samples_, [&](const Sample& s) { return steepness_of(s) < least[part_of(s)]; });
  }

  size_t part_of(const Sample& s) const {
    const float part = static_cast<float>(std::max(level_.width, level_.height)) / parts_along;
    return static_cast<size_t>(s.y / part) * parts_along + static_cast<size_t>(s.x / part);
  }

  MotionMatrix prior() const { return information_of(anywhere_px); }

  Flow flow_of(const Sample& sample) const {
    const double middle = (cell_px_ - 1) / 2;
    return flow_at((sample.x * cell_px_ + middle - k_.cx) / k_.fx, (sample.y * cell_px_ + middle - k_.cy) / k_.fy);
  }

  std::optional<Evidence> gather(const Motion& motion, double slack) const {
    const double fx = k_.fx / cell_px_, fy = k_.fy / cell_px_;
    struct Found {
      size_t sample;
      float residual;
    };
    std::vector<Found> found;
    found.reserve(samples_.size());
    std::vector<float> sizes;
    sizes.reserve(samples_.size());
    for (size_t n = 0; n < samples_.size(); ++n) {
      const Sample& s = samples_[n];
      const Flow flow = flow_of(s);
      const double u = s.x + fx * flow.across.dot(motion), v = s.y + fy * flow.down.dot(motion);
      const int x = static_cast<int>(std::floor(u)), y = static_cast<int>(std::floor(v));
      if (!(u >= 0 && v >= 0) || x + 1 >= level_.width || y + 1 >= level_.height) continue;
      const size_t i = level_.index(x, y);
      const auto width = static_cast<size_t>(level_.width);
      if (level_.open[i] * level_.open[i + 1] * level_.open[i + width] * level_.open[i + width + 1] == 0) continue;
      const auto a = static_cast<float>(u - x), b = static_cast<float>(v - y);
      const float* f = level_.frame.data() + i;
      const float seen = (1 - b) * ((1 - a) * f[0] + a * f[1]) + b * ((1 - a) * f[width] + a * f[width + 1]);
      found.push_back({n, seen - s.lightness});
      sizes.push_back(std::abs(found.back().residual));
    }
    if (sizes.empty()) return std::nullopt;
    const auto middle = sizes.begin() + static_cast<std::ptrdiff_t>(sizes.size() / 2);
    std::nth_element(sizes.begin(), middle, sizes.end());
    constexpr float sigma_of_median = 1.4826F;
    const double typical = std::max(least_residual, sigma_of_median * *middle);
    Evidence evidence;
    evidence.parts.assign(parts_along * parts_along, Motion::Zero());
    evidence.counts.assign(evidence.parts.size(), 0);
    for (const auto& [n, residual] : found) {
      const Sample& s = samples_[n];
      const Flow flow = flow_of(s);
      const Motion row =
          static_cast<double>(s.across) * fx * flow.across + static_cast<double>(s.down) * fy * flow.down;
      // Geman and McClure's weight.
      const double steepness2 = static_cast<double>(s.across * s.across + s.down * s.down);
      const double expected = typical * typical + slack * slack * steepness2;
      const double trust = 1 + static_cast<double>(residual * residual) / (robust_scale * robust_scale * expected);
      const double weight = 1 / (trust * trust * expected);
      evidence.squares += weight * row * row.transpose();
      const Motion pull = -weight * static_cast<double>(residual) * row;
      evidence.right += pull;
      const size_t part = part_of(s);
      evidence.parts[part] += pull;
      ++evidence.counts[part];
    }
    evidence.squares += prior();
    return evidence;
  }

  Level level_;
  double cell_px_;
  Intrinsics k_;
  std::vector<Sample> samples_;
};

Result<void> check(const Image& empty_booth, const Frame& frame, const Image& subject, const Intrinsics& intrinsics) {
  const auto fault = [&](const std::string& what) {
    return Error{ErrorCode::invalid_argument, "camera " + frame.camera + ": " + what};
  };
  if (!frame.pixels || frame.pixels->empty()) return fault("its picture is empty");
  const Image& image = *frame.pixels;
  if (empty_booth.width != image.width || empty_booth.height != image.height || empty_booth.channels != image.channels)
    return fault("its picture of the empty booth has another size or other channels than its capture");
  if (!subject.empty() && (subject.width != image.width || subject.height != image.height || subject.channels != 1))
    return fault("the subject's coverage has another size than the picture");
  if (intrinsics.width != image.width || intrinsics.height != image.height)
    return fault("its calibration is for pictures of another size");
  return {};
}

}  // namespace

Result<BackgroundMotion> register_background(const Image& empty_booth, const Frame& frame, const Image& subject,
                                             const Intrinsics& intrinsics) {
  if (const auto valid = check(empty_booth, frame, subject, intrinsics); !valid) return valid.error();
  const Image& image = *frame.pixels;
  const int step =
      std::max(1, static_cast<int>(std::sqrt(static_cast<double>(image.width) * image.height / fewest_samples)));
  std::vector<Level> pyramid(1);
  pyramid[0].width = image.width / step;
  pyramid[0].height = image.height / step;
  pyramid[0].background = lightness_of(empty_booth, step, pyramid[0].width, pyramid[0].height);
  pyramid[0].frame = lightness_of(image, step, pyramid[0].width, pyramid[0].height);
  pyramid[0].open = open_places(subject, step, pyramid[0].width, pyramid[0].height);
  while (std::min(pyramid.back().width, pyramid.back().height) >= 2 * coarsest_side)
    pyramid.push_back(halved(pyramid.back()));

  Motion motion = Motion::Zero();
  BackgroundMotion result;
  for (size_t n = pyramid.size(); n-- > 0;) {
    const Registration registration(std::move(pyramid[n]), step * std::pow(2.0, static_cast<double>(n)), intrinsics);
    const auto evidence = registration.improve(motion, n == 0);
    if (!evidence || !motion.allFinite()) return BackgroundMotion{};
    if (n > 0) continue;
    const auto telling = std::count_if(evidence->counts.begin(), evidence->counts.end(), [](int c) { return c > 0; });
    if (telling < fewest_parts) return BackgroundMotion{};
    MotionMatrix scatter = MotionMatrix::Zero();
    for (const Motion& part : evidence->parts) scatter += part * part.transpose();
    const MotionMatrix inverse = evidence->squares.ldlt().solve(MotionMatrix::Identity());
    const MotionMatrix covariance = inverse * (scatter + registration.information_of(anywhere_px)) * inverse;
    const double trembling_px = std::max(least_trembling_px, trembling * std::hypot(image.width, image.height));
    const MotionMatrix untouched = registration.information_of(trembling_px).diagonal().cwiseInverse().asDiagonal();
    result.rotation_rad = motion.head<3>();
    result.growth = motion[3];
    result.shift_px = registration.shift_px(motion);
    result.sigma_px = std::sqrt((covariance * registration.spread()).trace());
    result.deviation = std::sqrt(std::max(0.0, motion.dot((covariance + untouched).ldlt().solve(motion))));
    result.moved = result.deviation > surely;
  }
  return result;
}

}  // namespace booth
