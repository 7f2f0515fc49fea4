#include "pipeline/structured_light/gray_code.h"

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <deque>
#include <limits>
#include <numbers>
#include <numeric>
#include <optional>

namespace booth {
namespace {

constexpr float nan = std::numeric_limits<float>::quiet_NaN();
constexpr int fine_bits = 4;      // the finest bits' differences are kept to place a pixel between the stripes' edges
constexpr int steps_per_px = 8;   // of the search for the position, projector pixels
constexpr int search_steps = 12;  // to each side of the integer position: a bit read wrongly at an edge moves it by one
constexpr size_t most_bits = 16;  // of a coordinate
constexpr int candidates = 2 * search_steps + 1;
constexpr size_t row_grain = 16;  // rows in a piece of parallel work
constexpr int clearly_lit = 12;   // grey levels between a pattern and its inverse
constexpr int fewest_lit = 200;   // pixels below which there is nothing to decode

/// One bit of a coordinate: the images that show it.
struct BitImages {
  const Image* pattern = nullptr;
  const Image* inverse = nullptr;
  bool complete() const { return pattern != nullptr && inverse != nullptr; }
  bool missing() const { return pattern == nullptr && inverse == nullptr; }
  /// Of both images at a sample: what is lit evenly shows, without the pattern.
  int sum(size_t i) const { return pattern->samples[i] + inverse->samples[i]; }
};

/// The sequence, sorted by what each image shows. Bits from the most significant.
struct Sequence {
  int width = 0, height = 0;
  std::deque<Image> converted;                 ///< grey copies of colour images, and moved ones
  std::array<std::vector<BitImages>, 2> bits;  ///< of columns, of rows
  const Image* white = nullptr;
  const Image* black = nullptr;
};

int bits_for(int size) { return std::bit_width(static_cast<unsigned>(std::max(size, 2) - 1)); }

Image to_grey(const Image& image) {
  Image grey(image.width, image.height, 1);
  const size_t channels = static_cast<size_t>(image.channels);
  for (size_t i = 0; i < grey.samples.size(); ++i) {
    const uint8_t* p = image.samples.data() + i * channels;
    grey.samples[i] = static_cast<uint8_t>((p[0] + 2 * p[1] + p[2] + 2) / 4);  // green sees most of a projector's light
  }
  return grey;
}

Result<Sequence> sort_images(std::span<const Frame> frames, const GrayCodePattern& pattern) {
  if (!pattern.columns || !pattern.rows)
    return Error{ErrorCode::unsupported, "the Gray-code sequence has no patterns for both columns and rows"};
  if (std::max(bits_for(pattern.width), bits_for(pattern.height)) > static_cast<int>(most_bits))
    return Error{ErrorCode::unsupported, "the Gray-code pattern is wider or higher than 65536 pixels"};
  if (frames.empty()) return Error{ErrorCode::no_subject, "the Gray-code sequence has no images"};
  Sequence sequence;
  std::vector<const Image*> shown(static_cast<size_t>(pattern_count(pattern)), nullptr);
  for (const Frame& frame : frames) {
    if (frame.index < 0 || static_cast<size_t>(frame.index) >= shown.size()) continue;
    const Image* image = frame.pixels.get();
    if (sequence.width == 0) {
      sequence.width = image->width;
      sequence.height = image->height;
    }
    if (image->width != sequence.width || image->height != sequence.height)
      return Error{ErrorCode::invalid_argument, "camera " + frame.camera + ": image " + std::to_string(frame.index) +
                                                    " of the Gray-code sequence has another size than the others"};
    if (image->channels != 1) image = &sequence.converted.emplace_back(to_grey(*image));
    shown[static_cast<size_t>(frame.index)] = image;
  }
  size_t next = 0;
  const std::array<int, 2> sizes{pattern.width, pattern.height};
  for (size_t axis = 0; axis < 2; ++axis)
    for (int bit = 0; bit < bits_for(sizes[axis]); ++bit) {
      BitImages images{shown[next++], nullptr};
      if (pattern.inverse) images.inverse = shown[next++];
      sequence.bits[axis].push_back(images);
    }
  sequence.white = shown[next++];
  sequence.black = shown[next];
  return sequence;
}

/// Calls `visit` with the samples that clearly show whether they are lit: by far different in both images.
template <class Visitor>
void for_each_lit(const Sequence& s, const BitImages& pair, const Visitor& visit) {
  constexpr int stride = 8;  // every eighth pixel of every eighth row tells enough
  for (int y = 0; y < s.height; y += stride)
    for (int x = 0; x < s.width; x += stride) {
      const size_t i = static_cast<size_t>(y) * static_cast<size_t>(s.width) + static_cast<size_t>(x);
      const int contrast = std::abs(pair.pattern->samples[i] - pair.inverse->samples[i]);
      if (contrast >= clearly_lit) visit(i, contrast);
    }
}

/// Whether the sums of two pairs, which are the same without a fault, differ at many lit pixels.
bool contradict(const Sequence& s, const BitImages& reference, const BitImages& pair) {
  constexpr double tolerated_share = 0.3;
  size_t lit = 0, contradicting = 0;
  for_each_lit(s, reference, [&](size_t i, int contrast) {
    ++lit;
    if (2 * std::abs(pair.sum(i) - reference.sum(i)) > contrast) ++contradicting;
  });
  return lit > 0 && static_cast<double>(contradicting) >= tolerated_share * static_cast<double>(lit);
}

/// Whether two images show the same, apart from noise, where the projector lights.
bool same(const Sequence& s, const BitImages& reference, const Image& a, const Image& b) {
  constexpr double tolerated_share = 0.15;
  size_t lit = 0, different = 0;
  for_each_lit(s, reference, [&](size_t i, int contrast) {
    ++lit;
    if (3 * std::abs(a.samples[i] - b.samples[i]) > contrast) ++different;
  });
  return static_cast<double>(different) < tolerated_share * static_cast<double>(lit);
}

/// A pattern that was not projected when its image was taken (the projector did not step, or an image stands twice in
/// the sequence) shows in the sum with its inverse, which is the same for all bits. Of the two, the one that repeats
/// the image before it is left out; where neither does, both.
void drop_contradicting(Sequence* s, const std::string& camera, std::vector<std::string>* warnings) {
  std::vector<BitImages*> pairs;
  for (auto& bits : s->bits)
    for (BitImages& bit : bits)
      if (bit.complete()) pairs.push_back(&bit);
  // What most agree with is right: lit and unlit, usually.
  std::optional<BitImages> reference;
  const auto agreed = [&](const BitImages& candidate) {
    const auto against = std::count_if(pairs.begin(), pairs.end(),
                                       [&](const BitImages* pair) { return contradict(*s, candidate, *pair); });
    // A pattern that stands in the lit image's place agrees where its stripes are lit.
    constexpr double tolerated_share = 0.3;
    size_t lit = 0, weaker = 0;
    if (!pairs.empty())
      for_each_lit(*s, *pairs.front(), [&](size_t i, int contrast) {
        ++lit;
        if (2 * std::abs(candidate.pattern->samples[i] - candidate.inverse->samples[i]) < contrast) ++weaker;
      });
    return 2 * static_cast<size_t>(against) < pairs.size() &&
           static_cast<double>(weaker) <= tolerated_share * static_cast<double>(lit);
  };
  if (s->white != nullptr && s->black != nullptr) {
    if (const BitImages lit_and_unlit{s->white, s->black}; agreed(lit_and_unlit)) {
      reference = lit_and_unlit;
    } else {
      s->white = s->black = nullptr;
      warnings->push_back("camera " + camera + ": the lit and the unlit image contradict the others and were left out");
    }
  }
  constexpr size_t most_tried = 4;
  for (size_t p = 0; p < std::min(pairs.size(), most_tried) && !reference; ++p)
    if (agreed(*pairs[p])) reference = *pairs[p];
  if (!reference) return;
  const Image* before = nullptr;
  for (size_t axis = 0; axis < 2; ++axis)
    for (size_t bit = 0; bit < s->bits[axis].size(); ++bit) {
      BitImages& images = s->bits[axis][bit];
      const BitImages shown = images;
      if (images.complete() && contradict(*s, *reference, images)) {
        const std::string name = (axis == 0 ? "column bit " : "row bit ") + std::to_string(bit);
        if (same(*s, *reference, *images.pattern, *images.inverse)) {
          images.inverse = nullptr;
          warnings->push_back("camera " + camera + ": the inverse of " + name +
                              " repeats the image before and was left out");
        } else if (before != nullptr && same(*s, *reference, *before, *images.pattern)) {
          images.pattern = nullptr;
          warnings->push_back("camera " + camera + ": the image of " + name +
                              " repeats the one before and was left out");
        } else {
          images = {};
          warnings->push_back("camera " + camera + ": the images of " + name +
                              " contradict the others and were left out");
        }
      }
      before = shown.inverse != nullptr ? shown.inverse : shown.pattern;
    }
}

/// How the image of the subject moves: for every bit, columns' first, where its images show what the finest column
/// bit's show at a pixel, relative to that pixel.
using Motion = std::vector<Eigen::Vector2d>;

/// The shift of the whole subject that explains best how the sums of pattern and inverse change (B. Lucas, T. Kanade,
/// "An iterative image registration technique", IJCAI 1981).
Motion measure_motion(const Sequence& s, const Image* subject) {
  std::vector<const BitImages*> bits;
  for (const auto& of_axis : s.bits)
    for (const BitImages& bit : of_axis) bits.push_back(&bit);
  Motion motion(bits.size(), Eigen::Vector2d::Zero());
  size_t reference = s.bits[0].size() - 1;
  while (reference > 0 && !bits[reference]->complete()) --reference;
  if (!bits[reference]->complete()) return motion;

  struct Sample {
    int x, y, sum;
    Eigen::Vector2d gradient;
  };
  std::vector<Sample> samples;
  Eigen::Matrix2d structure = Eigen::Matrix2d::Identity();
  constexpr int stride = 6, margin = 12;  // no shift reaches farther
  const BitImages& first = *bits[reference];
  const size_t down = static_cast<size_t>(s.width);
  for (int y = margin; y + margin < s.height; y += stride)
    for (int x = margin; x + margin < s.width; x += stride) {
      const size_t i = static_cast<size_t>(y) * down + static_cast<size_t>(x);
      if (std::abs(first.pattern->samples[i] - first.inverse->samples[i]) < clearly_lit) continue;
      if (subject != nullptr && subject->at(x, y) < 128) continue;
      samples.push_back(
          {x,
           y,
           first.sum(i),
           {0.5 * (first.sum(i + 1) - first.sum(i - 1)), 0.5 * (first.sum(i + down) - first.sum(i - down))}});
      structure += samples.back().gradient * samples.back().gradient.transpose();
    }
  if (samples.size() < fewest_lit) return motion;
  const Eigen::Matrix2d inverse = structure.inverse();
  const auto change = [&](const BitImages& bit, const Sample& sample, const Eigen::Vector2d& shift) {
    const double px = sample.x + shift.x(), py = sample.y + shift.y();
    const int x = static_cast<int>(px), y = static_cast<int>(py);
    const double a = px - x, b = py - y;
    const size_t i = static_cast<size_t>(y) * down + static_cast<size_t>(x);
    return (1 - b) * ((1 - a) * bit.sum(i) + a * bit.sum(i + 1)) +
           b * ((1 - a) * bit.sum(i + down) + a * bit.sum(i + down + 1)) - sample.sum;
  };
  for (size_t bit = 0; bit < bits.size(); ++bit) {
    if (bit == reference) continue;
    if (!bits[bit]->complete()) {
      if (bit > 0) motion[bit] = motion[bit - 1];
      continue;
    }
    constexpr int steps = 5;
    constexpr double still_px = 0.1, farthest_px = margin - 2;
    Eigen::Vector2d shift = bit > 0 ? motion[bit - 1] : Eigen::Vector2d(0, 0);
    for (int i = 0; i < steps; ++i) {
      Eigen::Vector2d moment = Eigen::Vector2d::Zero();
      for (const Sample& sample : samples) moment -= change(*bits[bit], sample, shift) * sample.gradient;
      const Eigen::Vector2d step = inverse * moment;
      shift = (shift + step).cwiseMax(-farthest_px).cwiseMin(farthest_px);
      if (step.norm() < still_px) break;
    }
    motion[bit] = shift;
  }
  return motion;
}

double largest_of(const Motion& motion) {
  double largest = 0;
  for (const Eigen::Vector2d& shift : motion) largest = std::max(largest, (shift - motion.front()).norm());
  return largest;
}

/// What an image shows at `shift` from each pixel.
Image moved(const Image& image, const Eigen::Vector2d& shift) {
  const int left = static_cast<int>(std::floor(shift.x())), up = static_cast<int>(std::floor(shift.y()));
  constexpr int unit = 64;  // of the weights
  const int a = static_cast<int>(std::lround((shift.x() - left) * unit)),
            b = static_cast<int>(std::lround((shift.y() - up) * unit));
  Image out(image.width, image.height, 1);
  for (int y = 0; y < image.height; ++y) {
    const int y0 = std::clamp(y + up, 0, image.height - 1), y1 = std::clamp(y + up + 1, 0, image.height - 1);
    for (int x = 0; x < image.width; ++x) {
      const int x0 = std::clamp(x + left, 0, image.width - 1), x1 = std::clamp(x + left + 1, 0, image.width - 1);
      const int value = (unit - b) * ((unit - a) * image.at(x0, y0) + a * image.at(x1, y0)) +
                        b * ((unit - a) * image.at(x0, y1) + a * image.at(x1, y1));
      out.at(x, y) = static_cast<uint8_t>((value + unit * unit / 2) / (unit * unit));
    }
  }
  return out;
}

/// Moves all images so that the subject stands where it stood when the finest column bit was shown.
void hold_still(const Motion& motion, Sequence* s) {
  const auto move = [&](const Image** image, const Eigen::Vector2d& shift) {
    if (*image != nullptr && !shift.isZero()) *image = &s->converted.emplace_back(moved(**image, shift));
  };
  size_t next = 0;
  for (auto& of_axis : s->bits)
    for (BitImages& bit : of_axis) {
      move(&bit.pattern, motion[next]);
      move(&bit.inverse, motion[next++]);
    }
  move(&s->white, motion.back());
  move(&s->black, motion.back());
}

/// The finest bits' difference relative to the contrast, by position: a square wave that the optics blur.
class StripeProfiles {
 public:
  explicit StripeProfiles(double blur_px) {
    for (int k = 0; k < fine_bits; ++k) {
      std::vector<float>& table = tables_[static_cast<size_t>(k)];
      const size_t period = static_cast<size_t>(period_steps(k));
      table.resize(period + candidates);
      for (size_t i = 0; i < table.size(); ++i)
        table[i] = i < period ? static_cast<float>(value(k, static_cast<double>(i) / steps_per_px, blur_px))
                              : table[i - period];
    }
    for (int i = 0; i < 2 * edge_reach; ++i)
      edge_[static_cast<size_t>(i)] = static_cast<float>(
          std::erf(static_cast<double>(i - edge_reach) / steps_per_px / blur_px / std::numbers::sqrt2));
  }
  /// The values at `candidates` steps from `step` on, which counts from the centre of projector pixel 0.
  const float* from(int k, int step) const {
    return tables_[static_cast<size_t>(k)].data() + (step & (period_steps(k) - 1));
  }
  /// The same of a lone edge towards set, `step` steps from the first candidate to it.
  const float* edge_from(int step) const {
    return edge_.data() + std::clamp(step + edge_reach, 0, 2 * edge_reach - candidates);
  }
  /// Mean of the finest bit's absolute value: how the blur is measured.
  static double mean_absolute(double blur_px) {
    const StripeProfiles profiles(blur_px);
    double sum = 0;
    for (int i = 0; i < period_steps(0); ++i) sum += std::abs(profiles.tables_[0][static_cast<size_t>(i)]);
    return sum / period_steps(0);
  }

 private:
  static int period_px(int k) { return 4 << k; }
  static int period_steps(int k) { return period_px(k) * steps_per_px; }
  /// Bit k of the Gray code is set in the middle half of every period, from a quarter of it less half a pixel on: the
  /// sum of the square wave's harmonics, each damped by the Gaussian blur.
  static double value(int k, double x, double blur_px) {
    const double period = period_px(k);
    const double phase = 2 * std::numbers::pi * (x + 0.5) / period;
    constexpr int harmonics = 41;
    double sum = 0, sign = -1;
    for (int n = 1; n <= harmonics; n += 2, sign = -sign) {
      const double damped = n * 2 * std::numbers::pi * blur_px / period;
      sum += sign * 4 / (std::numbers::pi * n) * std::cos(n * phase) * std::exp(-0.5 * damped * damped);
    }
    return sum;
  }
  static constexpr int edge_reach = 4 * candidates;
  std::array<std::vector<float>, fine_bits> tables_;
  std::array<float, 2 * edge_reach> edge_{};
};

/// The blur at which the finest stripes have the mean strength that was measured.
double blur_of(double mean_absolute) {
  double low = 0.05, high = 3.0;
  for (int i = 0; i < 20; ++i) {
    const double middle = 0.5 * (low + high);
    (StripeProfiles::mean_absolute(middle) > mean_absolute ? low : high) = middle;
  }
  return 0.5 * (low + high);
}

/// What the first pass leaves of a lit pixel along one axis.
struct Reading {
  uint16_t integer = 0;                    ///< projector pixel by the signs of all bits
  std::array<int8_t, fine_bits> relative;  ///< differences of the finest bits, 100 = the contrast
  /// Where a coarser bit has an edge beside `integer` the finest are mirrored and cannot tell its sides: the pixel that
  /// the edge lies before, its bit's difference, and whether the bit is set after it. 0: there is none.
  uint16_t edge = 0;
  int8_t edge_relative = 0;
  bool edge_rises = false;
};
constexpr float relative_unit = 100;

struct LitPixel {
  uint16_t x = 0;
  float contrast = 0;
  float noise = 0;  ///< standard deviation of a bit's difference at that pixel, grey levels
  std::array<Reading, 2> axis;
};

class Decoder {
 public:
  Decoder(const Sequence& sequence, const GrayCodePattern& pattern, const Image* subject,
          const GrayCodeOptions& options, const Work& work)
      : s_(sequence),
        work_(work),
        sizes_{pattern.width, pattern.height},
        min_snr_(static_cast<float>(options.min_snr)) {
    if (subject != nullptr) mark_tiles(*subject);
    for (size_t axis = 0; axis < 2; ++axis)
      for (size_t bit = 0; bit < s_.bits[axis].size(); ++bit) {
        const BitImages& images = s_.bits[axis][bit];
        if (!images.complete()) continue;
        ++complete_;
        if (bit + fine_bits < s_.bits[axis].size()) coarse_.push_back(&images);
      }
    if (s_.white != nullptr && s_.black != nullptr) {
      lit_and_unlit_ = {s_.white, s_.black};
      coarse_.push_back(&lit_and_unlit_);
    }
  }

  Result<void> run(ProjectorCoordinates* out) {
    if (const auto usable = check_bits(); !usable) return usable;
    measure_noise(out);
    rows_.resize(static_cast<size_t>(s_.height));
    work_.parallel_for(rows_.size(), row_grain, [&](size_t begin, size_t end) {
      RowBuffers buffers(static_cast<size_t>(s_.width));
      for (size_t y = begin; y < end && !work_.stopped(); ++y) read_row(static_cast<int>(y), &buffers);
    });
    if (work_.stopped()) return Work::cancelled();
    size_t lit = 0;
    for (const auto& row : rows_) lit += row.size();
    if (lit < fewest_lit) return Error{ErrorCode::no_subject, "hardly any pixel is lit by the projector"};

    const std::array<StripeProfiles, 2> profiles{StripeProfiles(measure_blur(0)), StripeProfiles(measure_blur(1))};
    out->blur_px = blur_;
    raw_ = FloatImage(s_.width, s_.height, 2, nan);
    weight_ = FloatImage(s_.width, s_.height, 1, 0);
    out->position = FloatImage(s_.width, s_.height, 2, nan);
    out->sigma = FloatImage(s_.width, s_.height, 1, std::numeric_limits<float>::infinity());
    work_.parallel_for(rows_.size(), row_grain, [&](size_t begin, size_t end) {
      for (size_t y = begin; y < end && !work_.stopped(); ++y) place_row(static_cast<int>(y), profiles);
    });
    measure_scale();
    work_.parallel_for(rows_.size(), row_grain, [&](size_t begin, size_t end) {
      for (size_t y = begin; y < end && !work_.stopped(); ++y) fit_row(static_cast<int>(y), out);
    });
    if (work_.stopped()) return Work::cancelled();
    for (size_t i = 0; i < out->position.samples.size(); i += 2)
      if (!std::isnan(out->position.samples[i])) ++out->decoded;
    return {};
  }

 private:
  struct RowBuffers {
    explicit RowBuffers(size_t width) : sum(width), strength(width), drift(width), drift2(width) {}
    std::vector<int16_t> sum;       ///< white + black, or pattern + inverse
    std::vector<int32_t> strength;  ///< sum of the absolute differences of the coarse bits
    std::vector<int32_t> drift;     ///< sum of what the coarse bits' pattern + inverse differ from `sum`
    std::vector<int32_t> drift2;    ///< sum of its squares
  };

  /// Tiles of the image in or near the subject; the margin leaves room for its movement since it was segmented.
  void mark_tiles(const Image& subject) {
    constexpr int margin = 3;  // tiles
    const int columns = tile_of(s_.width - 1) + 1, rows = tile_of(s_.height - 1) + 1;
    Image near(columns, rows, 1);
    for (int y = 0; y < s_.height; ++y)
      for (int x = 0; x < s_.width; ++x)
        if (subject.at(x, y) >= 128) near.at(tile_of(x), tile_of(y)) = 1;
    tiles_ = Image(columns, rows, 1);
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < columns; ++x)
        if (near.at(x, y) != 0)
          for (int v = std::max(0, y - margin); v <= std::min(rows - 1, y + margin); ++v)
            for (int u = std::max(0, x - margin); u <= std::min(columns - 1, x + margin); ++u) tiles_.at(u, v) = 1;
  }
  static constexpr int tile_px = 8;
  static int tile_of(int pixel) { return pixel / tile_px; }

  Result<void> check_bits() const {
    const bool reference = s_.white != nullptr && s_.black != nullptr;
    if (!reference && complete_ == 0)
      return Error{ErrorCode::no_subject, "neither the lit and the unlit image nor any inverse of a pattern is there"};
    for (size_t axis = 0; axis < 2; ++axis)
      for (size_t bit = 0; bit + 1 < s_.bits[axis].size(); ++bit)
        if (s_.bits[axis][bit].missing())
          return Error{ErrorCode::no_subject, std::string("both images of ") + (axis == 0 ? "column" : "row") +
                                                  " bit " + std::to_string(bit) + " are missing"};
    return {};
  }

  /// The brightness that a pattern alone is compared with, doubled.
  void sum_row(int y, int16_t* sum) const {
    const auto add = [&](const Image& a, const Image& b) {
      const uint8_t *pa = a.pixel(0, y), *pb = b.pixel(0, y);
      for (int x = 0; x < s_.width; ++x) sum[x] = static_cast<int16_t>(pa[x] + pb[x]);
    };
    if (s_.white != nullptr && s_.black != nullptr) return add(*s_.white, *s_.black);
    for (const auto& bits : s_.bits)
      for (const BitImages& bit : bits)
        if (bit.complete()) return add(*bit.pattern, *bit.inverse);
  }

  /// A bit's difference at a pixel: twice what its images are from the mean of lit and unlit where one is missing.
  static int difference(const BitImages& bit, size_t i, int sum) {
    if (bit.complete()) return bit.pattern->samples[i] - bit.inverse->samples[i];
    if (bit.pattern != nullptr) return 2 * bit.pattern->samples[i] - sum;
    if (bit.inverse != nullptr) return sum - 2 * bit.inverse->samples[i];
    return 0;
  }

  /// How much the sums of pattern and inverse differ.
  void measure_noise(ProjectorCoordinates* out) {
    std::vector<const BitImages*> pairs;
    for (const auto& bits : s_.bits)
      for (const BitImages& bit : bits)
        if (bit.complete()) pairs.push_back(&bit);
    constexpr double assumed_noise = 2;  // grey levels, where it cannot be measured
    out->noise = noise_ = assumed_noise;
    if (pairs.size() < 2) return;
    constexpr int stride = 4;
    std::vector<int> spread;
    for (int y = 0; y < s_.height; y += stride)
      for (int x = 0; x < s_.width; x += stride) {
        const size_t i = static_cast<size_t>(y) * static_cast<size_t>(s_.width) + static_cast<size_t>(x);
        if (std::abs(difference(*pairs.front(), i, 0)) < clearly_lit) continue;
        for (size_t p = 1; p < pairs.size(); p += 4) spread.push_back(std::abs(pairs[p]->sum(i) - pairs[0]->sum(i)));
      }
    if (spread.size() < fewest_lit) return;
    const auto middle = spread.begin() + static_cast<std::ptrdiff_t>(spread.size() / 2);
    std::nth_element(spread.begin(), middle, spread.end());
    constexpr double normal_mad = 0.6745;
    constexpr double images_in_change = 4;
    out->noise = noise_ = std::max(0.3, (*middle + 0.5) / normal_mad / std::sqrt(images_in_change));
  }

  /// The first and one past the last pixel of a row that may be decoded.
  std::pair<size_t, size_t> span_of(int y) const {
    if (tiles_.empty()) return {0, static_cast<size_t>(s_.width)};
    int first = tiles_.width, last = -1;
    for (int t = 0; t < tiles_.width; ++t)
      if (tiles_.at(t, tile_of(y)) != 0) {
        first = std::min(first, t);
        last = t;
      }
    if (last < 0) return {0, 0};
    return {static_cast<size_t>(first * tile_px), static_cast<size_t>(std::min(s_.width, (last + 1) * tile_px))};
  }

  /// Sums over the coarse bits, whose stripes are wide: how strong their differences are, and how much the sums of
  /// pattern and inverse vary, which would all be the same without noise.
  void sum_coarse_bits(int y, size_t first, size_t last, RowBuffers* b) const {
    const size_t row = static_cast<size_t>(y) * static_cast<size_t>(s_.width);
    for (auto* sums : {&b->strength, &b->drift, &b->drift2})
      std::fill(sums->begin() + static_cast<std::ptrdiff_t>(first), sums->begin() + static_cast<std::ptrdiff_t>(last),
                0);
    int32_t *strength = b->strength.data(), *drift = b->drift.data(), *drift2 = b->drift2.data();
    const int16_t* sum = b->sum.data();
    for (const BitImages* images : coarse_) {
      const uint8_t *p = images->pattern->samples.data() + row, *q = images->inverse->samples.data() + row;
      for (size_t x = first; x < last; ++x) {
        const int32_t off = p[x] + q[x] - sum[x];
        strength[x] += std::abs(p[x] - q[x]);
        drift[x] += off;
        drift2[x] += off * off;
      }
    }
  }

  /// The standard deviation of a bit's difference at a pixel, by how its sums of pattern and inverse vary (a difference
  /// and a sum of two images have the same noise), steadied by that of the whole image.
  float noise_at(size_t x, const RowBuffers& b) const {
    const float count = static_cast<float>(coarse_.size());
    const float overall = static_cast<float>(2 * noise_ * noise_);
    if (count < 2) return std::sqrt(overall);
    const float drift = static_cast<float>(b.drift[x]);
    const float scatter = static_cast<float>(b.drift2[x]) - drift * drift / count;
    constexpr float overall_weight = 6;  // as many samples
    return std::sqrt((overall_weight * overall + scatter) / (overall_weight + count - 1));
  }

  /// A bit's difference, averaged over the pixels up to `radius` around (x, y).
  float mean_difference(const BitImages& bit, int x, int y, int radius, const RowBuffers& b) const {
    const size_t width = static_cast<size_t>(s_.width);
    if (radius == 0 || !bit.complete())
      return static_cast<float>(
          difference(bit, static_cast<size_t>(y) * width + static_cast<size_t>(x), b.sum[static_cast<size_t>(x)]));
    const int left = std::max(0, x - radius), right = std::min(s_.width - 1, x + radius);
    const int top = std::max(0, y - radius), bottom = std::min(s_.height - 1, y + radius);
    int sum = 0;
    for (int v = top; v <= bottom; ++v) {
      const uint8_t *p = bit.pattern->pixel(0, v), *q = bit.inverse->pixel(0, v);
      for (int u = left; u <= right; ++u) sum += p[u] - q[u];
    }
    return static_cast<float>(sum) / static_cast<float>((right - left + 1) * (bottom - top + 1));
  }

  /// The coarse bits' mean strength around a pixel.
  float mean_strength(int x, int y, int radius, const RowBuffers& b) const {
    float sum = 0;
    for (const BitImages* bit : coarse_) sum += std::abs(mean_difference(*bit, x, y, radius, b));
    return sum / static_cast<float>(std::max<size_t>(coarse_.size(), 1));
  }

  /// Whether lit and unlit alone say that nothing around a pixel is lit by half of what is asked for.
  bool hopeless(int x, int y, int radius, float noise, const RowBuffers& b) const {
    constexpr float share = 0.5F;
    return lit_and_unlit_.complete() && mean_difference(lit_and_unlit_, x, y, radius, b) <
                                            share * min_snr_ * noise / static_cast<float>(2 * radius + 1);
  }

  void read_row(int y, RowBuffers* buffers) {
    const auto [first, last] = span_of(y);
    sum_row(y, buffers->sum.data());
    sum_coarse_bits(y, first, last, buffers);
    std::vector<LitPixel>& pixels = rows_[static_cast<size_t>(y)];
    for (size_t i = first; i < last; ++i) {
      const int x = static_cast<int>(i);
      if (!tiles_.empty() && tiles_.at(tile_of(x), tile_of(y)) == 0) continue;
      LitPixel pixel;
      pixel.x = static_cast<uint16_t>(x);
      pixel.noise = noise_at(i, *buffers);
      // What is too dim by itself (dark skin and hair, grazing light) its surroundings may make out.
      int radius = 0;
      pixel.contrast =
          static_cast<float>(buffers->strength[i]) / static_cast<float>(std::max<size_t>(coarse_.size(), 1));
      constexpr float certain_snr = 4;
      constexpr int widest = 2;
      if (pixel.contrast < certain_snr * pixel.noise && hopeless(x, y, widest, pixel.noise, *buffers)) continue;
      while (pixel.contrast <
                 (radius == 0 ? certain_snr : min_snr_) * pixel.noise / static_cast<float>(2 * radius + 1) &&
             radius <= widest)
        if (++radius <= widest) pixel.contrast = mean_strength(x, y, radius, *buffers);
      if (radius > widest) continue;
      read_bits(y, radius, *buffers, &pixel);
      pixels.push_back(pixel);
    }
  }

  void read_bits(int y, int radius, const RowBuffers& buffers, LitPixel* pixel) const {
    const float scale = relative_unit / pixel->contrast;
    const auto relative = [&](float d) { return static_cast<int8_t>(std::clamp(d * scale, -127.0F, 127.0F)); };
    for (size_t axis = 0; axis < 2; ++axis) {
      const auto& bits = s_.bits[axis];
      Reading& reading = pixel->axis[axis];
      std::array<float, most_bits> d{};  // from the finest
      unsigned value = 0, previous = 0;
      for (size_t bit = bits.size(); bit-- > 0;) {
        d[bit] = mean_difference(bits[bits.size() - 1 - bit], pixel->x, y, radius, buffers);
        previous ^= d[bit] > 0 ? 1U : 0U;  // a Gray bit is the binary bit's change from the one before it
        value = value << 1 | previous;
        if (bit < fine_bits) reading.relative[bit] = relative(d[bit]);
      }
      reading.integer = static_cast<uint16_t>(value);
      constexpr unsigned coarse = 1U << fine_bits;
      const unsigned edge = (value + 2) & ~(coarse - 1);  // the only one that can be within two pixels
      if (edge == 0 || edge + 1 < value) continue;
      const auto bit = static_cast<size_t>(std::countr_zero(edge));
      if (bit >= bits.size() || bits[bits.size() - 1 - bit].missing()) continue;
      reading.edge = static_cast<uint16_t>(edge);
      reading.edge_relative = relative(d[bit]);
      reading.edge_rises = ((edge ^ edge >> 1) >> bit & 1U) != 0;
    }
  }

  double measure_blur(size_t axis) {
    if (s_.bits[axis].back().missing()) return blur_;
    double sum = 0, count = 0;
    for (const auto& row : rows_)
      for (const LitPixel& pixel : row)
        if (pixel.contrast > 4 * pixel.noise) {
          sum += std::abs(pixel.axis[axis].relative[0]) / relative_unit;
          ++count;
        }
    constexpr double usual_blur = 0.6;
    blur_ = count > 0 ? blur_of(sum / count) : usual_blur;
    return blur_;
  }

  void place_row(int y, const std::array<StripeProfiles, 2>& profiles) {
    for (const LitPixel& pixel : rows_[static_cast<size_t>(y)]) {
      std::array<float, 2> position{};
      float information = std::numeric_limits<float>::infinity();
      bool good = true;
      for (size_t axis = 0; axis < 2 && good; ++axis) {
        float found_information = 0;
        position[axis] = place(pixel.axis[axis], axis, profiles[axis], &found_information);
        good = position[axis] > -0.5F && position[axis] < static_cast<float>(sizes_[axis]) - 0.5F;
        information = std::min(information, found_information);
      }
      if (!good) continue;
      raw_.at(pixel.x, y, 0) = position[0];
      raw_.at(pixel.x, y, 1) = position[1];
      const float snr = pixel.contrast / pixel.noise;
      weight_.at(pixel.x, y) = information * snr * snr;
    }
  }

  /// The position near the integer one at which the profiles explain the finest differences best.
  float place(const Reading& reading, size_t axis, const StripeProfiles& profiles, float* information) const {
    std::array<float, candidates> cost{};
    const int center = reading.integer * steps_per_px;
    const auto& bits = s_.bits[axis];
    const int used = std::min(fine_bits, static_cast<int>(bits.size()));
    for (int k = 0; k < used; ++k) {
      if (bits[bits.size() - 1 - static_cast<size_t>(k)].missing()) continue;
      const float measured = static_cast<float>(reading.relative[static_cast<size_t>(k)]) / relative_unit;
      // One bit off is one outlier, not four times its weight.
      constexpr float most = 0.5F;
      const float* expected = profiles.from(k, center - search_steps);
      for (size_t j = 0; j < candidates; ++j) {
        const float off = measured - expected[j];
        cost[j] += std::min(off * off, most);
      }
    }
    if (reading.edge != 0) {
      const float sign = reading.edge_rises ? 1.0F : -1.0F;
      const float measured = sign * static_cast<float>(reading.edge_relative) / relative_unit;
      const float* expected =
          profiles.edge_from(center - search_steps - (reading.edge * steps_per_px - steps_per_px / 2));
      for (size_t j = 0; j < candidates; ++j) {
        const float off = measured - expected[j];
        cost[j] += off * off;
      }
    }
    int best = 1;
    for (int j = 1; j + 1 < candidates; ++j)
      if (cost[static_cast<size_t>(j)] < cost[static_cast<size_t>(best)]) best = j;
    const float before = cost[static_cast<size_t>(best - 1)], at = cost[static_cast<size_t>(best)],
                after = cost[static_cast<size_t>(best + 1)];
    const float bend = before - 2 * at + after;
    const float shift = bend > 1e-6F ? std::clamp(0.5F * (before - after) / bend, -0.5F, 0.5F) : 0.0F;
    constexpr float least_bend = 0.002F;  // in the middle of a wide stripe nothing says where
    *information = std::max(bend, least_bend) * steps_per_px * steps_per_px * 0.5F;
    return (static_cast<float>(center + best - search_steps) + shift) / steps_per_px;
  }

  /// How many projector pixels a camera pixel covers, along the image's rows and columns: the median step.
  void measure_scale() {
    std::vector<float> steps;
    constexpr int stride = 3;
    for (int y = 0; y < s_.height; y += stride)
      for (int x = 0; x + 1 < s_.width; x += stride) {
        const Eigen::Map<const Eigen::Vector2f> a(raw_.pixel(x, y)), b(raw_.pixel(x + 1, y));
        if (a.x() == a.x() && b.x() == b.x()) steps.push_back((b - a).norm());
      }
    scale_ = 1;
    if (steps.empty()) return;
    const auto middle = steps.begin() + static_cast<std::ptrdiff_t>(steps.size() / 2);
    std::nth_element(steps.begin(), middle, steps.end());
    constexpr float least = 0.1F, most = 4;
    scale_ = std::clamp(*middle, least, most);
    constexpr float stripes_wanted = 2.5F;  // a window this wide, in projector pixels, holds edges of every direction
    constexpr int widest = 6;
    radius_ = std::clamp(static_cast<int>(std::lround(0.5F * stripes_wanted / scale_)), 2, widest);
  }

  /// Calls `visit` with (u, v, position) of every pixel decoded around (x, y), itself included.
  template <class Visitor>
  void for_each_around(int x, int y, const Visitor& visit) const {
    for (int v = std::max(-radius_, -y); v <= radius_ && y + v < s_.height; ++v)
      for (int u = std::max(-radius_, -x); u <= radius_ && x + u < s_.width; ++u)
        if (const float* position = raw_.pixel(x + u, y + v); position[0] == position[0])
          visit(u, v, Eigen::Vector2f(position[0], position[1]));
  }

  /// Sums of the weighted least-squares fit of a plane to the steps from `center` of the pixels that continue it.
  struct PlaneFit {
    Eigen::Matrix3f moments = Eigen::Matrix3f::Zero();
    Eigen::Matrix<float, 3, 2> right = Eigen::Matrix<float, 3, 2>::Zero();
    float squares = 0;  ///< weighted sum of the squared steps
    int continuing = 0;
  };
  using Plane = Eigen::Matrix<float, 3, 2>;  ///< a step at (u, v) from a pixel: (1, u, v) times this

  /// @param near    a step that a pixel (u, v) away must come close to
  /// @param reach   within how much, projector pixels
  template <class Near, class Reach>
  PlaneFit fit_around(int x, int y, const Eigen::Vector2f& center, const Near& near, const Reach& reach) const {
    PlaneFit fit;
    float s = 0, su = 0, sv = 0, suu = 0, suv = 0, svv = 0;
    Eigen::Vector2f b = Eigen::Vector2f::Zero(), bu = b, bv = b;
    for_each_around(x, y, [&](int u, int v, const Eigen::Vector2f& position) {
      const Eigen::Vector2f step = position - center;
      const float fu = static_cast<float>(u), fv = static_cast<float>(v);
      const Eigen::Vector2f off = step - near(fu, fv);
      const float most = reach(fu, fv);
      if (std::abs(off.x()) > most || std::abs(off.y()) > most) return;
      ++fit.continuing;
      const float w = weight_.at(x + u, y + v);
      s += w;
      su += w * fu;
      sv += w * fv;
      suu += w * fu * fu;
      suv += w * fu * fv;
      svv += w * fv * fv;
      b += w * step;
      bu += w * fu * step;
      bv += w * fv * step;
      fit.squares += w * step.squaredNorm();
    });
    fit.moments << s, su, sv, su, suu, suv, sv, suv, svv;
    fit.right.row(0) = b;
    fit.right.row(1) = bu;
    fit.right.row(2) = bv;
    return fit;
  }
  PlaneFit fit_around(int x, int y, const Eigen::Vector2f& center) const {
    constexpr float tolerance = 0.6F, per_pixel = 0.15F;
    Plane plane = Plane::Zero();
    plane.row(1) = slope(x, y, 1, 0, center);
    plane.row(2) = slope(x, y, 0, 1, center);
    return fit_around(
        x, y, center, [&](float u, float v) { return Eigen::Vector2f(u * plane.row(1) + v * plane.row(2)); },
        [&](float u, float v) { return tolerance + per_pixel * std::max(std::abs(u), std::abs(v)); });
  }

  /// The change of position a pixel towards (u, v): of both sides the gentler, as beyond an edge it leaps.
  Eigen::RowVector2f slope(int x, int y, int u, int v, const Eigen::Vector2f& center) const {
    constexpr int reach = 2;
    Eigen::RowVector2f gentler = Eigen::RowVector2f::Zero();
    float least = std::numeric_limits<float>::infinity();
    for (const int side : {-reach, reach}) {
      const int there_x = x + side * u, there_y = y + side * v;
      if (there_x < 0 || there_y < 0 || there_x >= s_.width || there_y >= s_.height) continue;
      const float* position = raw_.pixel(there_x, there_y);
      const Eigen::RowVector2f step = (Eigen::RowVector2f(position[0], position[1]) - center.transpose()) / side;
      if (step.norm() >= least || std::isnan(step.x())) continue;
      least = step.norm();
      gentler = step;
    }
    constexpr float most_slope = 3;  // times the usual step: steeper is another surface
    return least <= most_slope * scale_ ? gentler : Eigen::RowVector2f::Zero();
  }

  /// The median of the positions around a pixel, each axis by itself.
  std::optional<Eigen::Vector2f> median_around(int x, int y) const {
    constexpr size_t most = 13 * 13;
    std::array<std::array<float, most>, 2> values{};
    size_t count = 0;
    for_each_around(x, y, [&](int, int, const Eigen::Vector2f& position) {
      values[0][count] = position.x();
      values[1][count++] = position.y();
    });
    if (count == 0) return std::nullopt;
    Eigen::Vector2f median;
    for (size_t axis = 0; axis < 2; ++axis) {
      const auto middle = values[axis].begin() + static_cast<std::ptrdiff_t>(count / 2);
      std::nth_element(values[axis].begin(), middle, values[axis].begin() + static_cast<std::ptrdiff_t>(count));
      median[static_cast<Eigen::Index>(axis)] = *middle;
    }
    return median;
  }

  /// A plane through the positions around each pixel that continue its own; where they do not (a bit of the pixel was
  /// read wrongly), that continue their median.
  void fit_row(int y, ProjectorCoordinates* out) const {
    const int window = (2 * radius_ + 1) * (2 * radius_ + 1);
    const auto enough = [&](int continuing) { return 3 * continuing >= window; };  // a surface's corner has a quarter
    for (const LitPixel& pixel : rows_[static_cast<size_t>(y)]) {
      const int x = pixel.x;
      Eigen::Vector2f center(raw_.at(x, y, 0), raw_.at(x, y, 1));
      PlaneFit fit;
      if (center.x() == center.x()) fit = fit_around(x, y, center);
      if (!enough(fit.continuing)) {
        const auto median = median_around(x, y);
        if (!median) continue;
        center = *median;
        fit = fit_around(x, y, center);
        if (!enough(fit.continuing)) continue;
      }
      Eigen::Matrix3f inverse = fit.moments.inverse();
      Plane plane = inverse * fit.right;
      // Where the plane explains its pixels badly there is an edge or a wrong bit among them: those near it once more.
      constexpr float usual_residual_px = 0.2F;
      const float residual2 = (fit.squares - plane.cwiseProduct(fit.right).sum()) / fit.moments(0, 0);
      if (residual2 > usual_residual_px * usual_residual_px) {
        const float most = std::max(2 * usual_residual_px, std::sqrt(residual2));
        const PlaneFit again = fit_around(
            x, y, center, [&](float u, float v) { return Eigen::Vector2f(Eigen::RowVector3f(1, u, v) * plane); },
            [&](float, float) { return most; });
        if (enough(again.continuing)) {
          fit = again;
          inverse = fit.moments.inverse();
          plane = inverse * fit.right;
        }
      }
      const float variance = inverse(0, 0);
      if (!(variance > 0) || !std::isfinite(variance)) continue;
      const Eigen::RowVector2f offset = plane.row(0);
      constexpr float spike = 1.5F;
      if (!(offset.cwiseAbs().maxCoeff() < spike)) continue;
      out->position.at(x, y, 0) = center.x() + offset.x();
      out->position.at(x, y, 1) = center.y() + offset.y();
      const float sigma = std::sqrt(variance);  // the weights are slope² × contrast² / noise²
      constexpr float model_error = 0.03F;      // of blur that varies over the image, projector pixels
      out->sigma.at(x, y) = std::hypot(sigma, model_error);
    }
  }

  const Sequence& s_;
  const Work& work_;
  std::array<int, 2> sizes_;
  int complete_ = 0;
  BitImages lit_and_unlit_;
  std::vector<const BitImages*> coarse_;  ///< complete ones whose stripes are wide, lit and unlit among them
  float min_snr_;
  double noise_ = 0;
  double blur_ = 0;
  float scale_ = 1;
  int radius_ = 2;
  std::vector<std::vector<LitPixel>> rows_;
  FloatImage raw_, weight_;
  Image tiles_;  ///< 1 where there is something to decode; empty: everywhere
};

}  // namespace

Result<ProjectorCoordinates> decode_gray_code(std::span<const Frame> frames, const GrayCodePattern& pattern,
                                              const Image* subject, const GrayCodeOptions& options, const Work& work) {
  auto sequence = sort_images(frames, pattern);
  if (!sequence) return sequence.error();
  if (subject != nullptr && (subject->width != sequence->width || subject->height != sequence->height))
    subject = nullptr;
  ProjectorCoordinates out;
  out.camera = frames.front().camera;
  const Motion motion = measure_motion(*sequence, subject);
  out.motion_px = largest_of(motion);
  constexpr double noticeable_px = 0.4;
  if (out.motion_px > noticeable_px) hold_still(motion, &*sequence);
  drop_contradicting(&*sequence, out.camera, &out.warnings);
  if (const auto decoded = Decoder(*sequence, pattern, subject, options, work).run(&out); !decoded)
    return Error{decoded.error().code, "camera " + out.camera + ": " + decoded.error().message};
  return out;
}

}  // namespace booth
