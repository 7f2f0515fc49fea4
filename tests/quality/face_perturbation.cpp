#include "tests/quality/face_perturbation.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <memory>
#include <random>

#include "pipeline/geometry/camera_model.h"

namespace booth::quality {
namespace {

constexpr double grain = 1.5;  // noise of images that are made anew, grey levels

uint8_t level(double value) { return static_cast<uint8_t>(std::clamp(std::lround(value), 0L, 255L)); }

template <class Value>
void make_anew(Frame* frame, const Value& value) {
  auto image = std::make_shared<Image>(*frame->pixels);
  for (size_t i = 0; i < image->samples.size(); ++i) image->samples[i] = level(value(i, image->samples[i]));
  frame->pixels = std::move(image);
}

const Frame* image_of(const GrayCodeCapture& capture, const std::string& camera, int index) {
  for (const FrameSet& set : capture.sets)
    if (set.index == index)
      for (const Frame& frame : set.frames)
        if (frame.camera == camera) return &frame;
  return nullptr;
}

/// The pattern's brightness along its axis for one image of the sequence, 0 … 1, blurred, in steps of 1/16 pixel.
struct Profile {
  static constexpr int steps = 16;
  bool of_column = true;
  std::vector<float> value;
  float at(const Eigen::Vector2d& position) const {
    const double along = (of_column ? position.x() : position.y()) * steps;
    return value[static_cast<size_t>(std::clamp(std::lround(along), 0L, static_cast<long>(value.size()) - 1))];
  }
};
Profile profile_of(const GrayCodePattern& pattern, int image) {
  const auto bits_of = [](int size) { return std::bit_width(static_cast<unsigned>(size - 1)); };
  const int column_bits = bits_of(pattern.width), count = pattern_count(pattern);
  Profile profile;
  const int number = image / 2;
  profile.of_column = number < column_bits;
  const int size = profile.of_column ? pattern.width : pattern.height;
  profile.value.assign(static_cast<size_t>(size) * Profile::steps, image == count - 2 ? 1.0F : 0.0F);
  if (image >= count - 2) return profile;
  const int bit = profile.of_column ? column_bits - 1 - number : bits_of(size) - 1 - (number - column_bits);
  constexpr double blur_px = 0.55;
  for (size_t i = 0; i < profile.value.size(); ++i) {
    const double x = static_cast<double>(i) / Profile::steps;
    double sum = 0;
    for (int p = static_cast<int>(x) - 3; p <= static_cast<int>(x) + 4; ++p) {
      const auto place = static_cast<unsigned>(std::clamp(p, 0, size - 1));
      if (((place ^ place >> 1) >> bit & 1U) == 0) continue;
      const double scale = 1 / (blur_px * std::sqrt(2.0));
      sum += 0.5 * (std::erf((p + 0.5 - x) * scale) - std::erf((p - 0.5 - x) * scale));
    }
    profile.value[i] = static_cast<float>(image % 2 == 0 ? sum : 1 - sum);
  }
  return profile;
}

/// Where each pixel of a camera is lit from, and how both move with the subject.
struct Seen {
  Eigen::Vector2f lit_at = Eigen::Vector2f::Constant(std::numeric_limits<float>::quiet_NaN());
  Eigen::Vector2f camera_shift, projector_shift;  ///< of the whole sway, pixels
};

}  // namespace

GrayCodeCapture with_noise(const GrayCodeCapture& capture, double sigma, uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> noise(0, static_cast<float>(sigma));
  GrayCodeCapture out = capture;
  for (FrameSet& set : out.sets)
    for (Frame& frame : set.frames) make_anew(&frame, [&](size_t, uint8_t was) { return was + noise(random); });
  return out;
}

GrayCodeCapture with_ambient_light(const GrayCodeCapture& capture, double share, uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> noise(0, static_cast<float>(grain));
  const int last = pattern_count(capture.pattern) - 1;
  GrayCodeCapture out = capture;
  for (FrameSet& set : out.sets)
    for (Frame& frame : set.frames) {
      const Image &lit = *image_of(capture, frame.camera, last - 1)->pixels,
                  &unlit = *image_of(capture, frame.camera, last)->pixels;
      make_anew(&frame, [&](size_t i, uint8_t was) {
        return was + share * std::max(0, lit.samples[i] - unlit.samples[i]) + static_cast<double>(noise(random));
      });
    }
  return out;
}

GrayCodeCapture without_images(const GrayCodeCapture& capture, double share, uint32_t seed) {
  std::mt19937 random(seed);
  std::bernoulli_distribution lost(share);
  GrayCodeCapture out = capture;
  for (FrameSet& set : out.sets) std::erase_if(set.frames, [&](const Frame&) { return lost(random); });
  return out;
}

GrayCodeCapture with_repeats(const GrayCodeCapture& capture, double share, uint32_t seed) {
  std::mt19937 random(seed);
  std::bernoulli_distribution repeated(share);
  GrayCodeCapture out = capture;
  for (size_t s = 1; s < out.sets.size(); ++s)
    if (repeated(random))
      for (Frame& frame : out.sets[s].frames)
        if (const Frame* before = image_of(out, frame.camera, out.sets[s].index - 1)) frame.pixels = before->pixels;
  return out;
}

GrayCodeCapture with_sway(const GrayCodeCapture& capture, const Rig& rig, const RangeScan& scan,
                          const Eigen::Vector3d& sway_m, uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> noise(0, static_cast<float>(grain));
  const int count = pattern_count(capture.pattern);
  std::vector<Profile> profiles;
  for (int image = 0; image < count; ++image) profiles.push_back(profile_of(capture.pattern, image));
  GrayCodeCapture out = capture;
  for (const RigCamera& camera : rig.cameras) {
    const Frame* lit = image_of(capture, camera.id, count - 2);
    const Frame* unlit = image_of(capture, camera.id, count - 1);
    if (lit == nullptr || unlit == nullptr) continue;
    const int width = camera.intrinsics.width, height = camera.intrinsics.height;
    std::vector<Seen> seen(static_cast<size_t>(width * height));
    Eigen::Vector2f usual_shift = Eigen::Vector2f::Zero();
    size_t measured = 0;
    std::vector<Frame> frames;
    for (const FrameSet& set : capture.sets)
      for (const Frame& frame : set.frames)
        if (frame.camera == camera.id) frames.push_back(frame);
    const FloatImage lit_at = decode_gray_code(frames, capture.pattern).value().position;
    for (size_t i = 0; i < seen.size(); ++i) {
      const Eigen::Vector2f at(lit_at.samples[2 * i], lit_at.samples[2 * i + 1]);
      if (at.x() != at.x()) continue;
      const size_t s = scan.index(std::clamp(static_cast<int>(std::lround(at.x())), 0, scan.width - 1),
                                  std::clamp(static_cast<int>(std::lround(at.y())), 0, scan.height - 1));
      if (!scan.measured(s)) continue;
      const Eigen::Vector3d p = scan.points[s].cast<double>();
      const auto before = project(camera, p), after = project(camera, p + sway_m),
                 lit_before = project(*rig.projector, p), lit_after = project(*rig.projector, p + sway_m);
      if (!before || !after || !lit_before || !lit_after) continue;
      seen[i] = {at, (*after - *before).cast<float>(), (*lit_after - *lit_before).cast<float>()};
      usual_shift += seen[i].camera_shift;
      ++measured;
    }
    if (measured > 0) usual_shift /= static_cast<float>(measured);
    for (FrameSet& set : out.sets)
      for (Frame& frame : set.frames) {
        if (frame.camera != camera.id) continue;
        const float t = static_cast<float>(frame.index) / static_cast<float>(count - 1);
        auto image = std::make_shared<Image>(width, height, 1);
        const Frame* own = image_of(capture, camera.id, frame.index);
        for (int y = 0; y < height; ++y)
          for (int x = 0; x < width; ++x) {
            const Seen& here = seen[static_cast<size_t>(y * width + x)];
            const Eigen::Vector2f shift = t * (here.lit_at.x() == here.lit_at.x() ? here.camera_shift : usual_shift);
            const float sx = std::clamp(static_cast<float>(x) - shift.x(), 0.0F, static_cast<float>(width) - 1.001F),
                        sy = std::clamp(static_cast<float>(y) - shift.y(), 0.0F, static_cast<float>(height) - 1.001F);
            const int x0 = static_cast<int>(sx), y0 = static_cast<int>(sy);
            const float a = sx - static_cast<float>(x0), b = sy - static_cast<float>(y0);
            const auto sample = [&](const Image& from) {
              const auto v = [&](int i, int j) { return static_cast<float>(from.at(x0 + i, y0 + j)); };
              return (1 - b) * ((1 - a) * v(0, 0) + a * v(1, 0)) + b * ((1 - a) * v(0, 1) + a * v(1, 1));
            };
            const Seen& source = seen[static_cast<size_t>(std::lround(sy) * width + std::lround(sx))];
            float value = sample(*own->pixels);
            if (source.lit_at.x() == source.lit_at.x()) {
              const auto place = [&](int i, int j) {
                return seen[static_cast<size_t>((y0 + j) * width + x0 + i)].lit_at;
              };
              const Eigen::Vector2f between =
                  (1 - b) * ((1 - a) * place(0, 0) + a * place(1, 0)) + b * ((1 - a) * place(0, 1) + a * place(1, 1));
              constexpr float another_surface_px = 3;
              const bool smooth = (between - source.lit_at).norm() < another_surface_px;  // not where one is NaN
              const Eigen::Vector2d at =
                  ((smooth ? between : source.lit_at) + t * source.projector_shift).cast<double>();
              value = sample(*unlit->pixels) + (sample(*lit->pixels) - sample(*unlit->pixels)) *
                                                   profiles[static_cast<size_t>(frame.index)].at(at);
            }
            image->at(x, y) = level(static_cast<double>(value + noise(random)));
          }
        frame.pixels = std::move(image);
      }
  }
  return out;
}

}  // namespace booth::quality
