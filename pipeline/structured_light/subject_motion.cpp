#include "pipeline/structured_light/subject_motion.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>

namespace booth {
namespace {

/// What an image shows at `shift` from each pixel.
Image moved(const PixelView& image, int width, int height, const Eigen::Vector2d& shift) {
  const int left = static_cast<int>(std::floor(shift.x())), up = static_cast<int>(std::floor(shift.y()));
  constexpr int unit = 64;  // of the weights
  const int a = static_cast<int>(std::lround((shift.x() - left) * unit)),
            b = static_cast<int>(std::lround((shift.y() - up) * unit));
  Image out(width, height, 1);
  std::vector<int> rows(static_cast<size_t>(width));
  for (int y = 0; y < height; ++y) {
    const uint8_t* above = image.row(std::clamp(y + up, 0, height - 1));
    const uint8_t* below = image.row(std::clamp(y + up + 1, 0, height - 1));
    for (int x = 0; x < width; ++x) rows[static_cast<size_t>(x)] = (unit - b) * above[x] + b * below[x];
    uint8_t* to = out.pixel(0, y);
    const auto mix = [&](int x, int x0, int x1) {
      const int value = (unit - a) * rows[static_cast<size_t>(x0)] + a * rows[static_cast<size_t>(x1)];
      to[x] = static_cast<uint8_t>((value + unit * unit / 2) / (unit * unit));
    };
    const int first = std::clamp(-left, 0, width), last = std::clamp(width - 1 - left, first, width);
    for (int x = 0; x < first; ++x) mix(x, 0, std::clamp(x + left + 1, 0, width - 1));
    for (int x = first; x < last; ++x) mix(x, x + left, x + left + 1);
    for (int x = last; x < width; ++x) mix(x, std::clamp(x + left, 0, width - 1), width - 1);
  }
  return out;
}

}  // namespace

Motion measure_motion(const PatternImages& s, const SearchTiles& tiles, const Image* subject) {
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
  for (int y = margin; y + margin < s.height; y += stride)
    for (int x = margin; x + margin < s.width; x += stride) {
      if (first.contrast(x, y) < clearly_lit) continue;
      const Eigen::Vector2i pixel = s.origin + Eigen::Vector2i(x, y);
      if (tiles.of_pixel(pixel).isEmpty()) continue;
      if (subject != nullptr && subject->at(pixel.x(), pixel.y()) < 128) continue;
      samples.push_back(
          {x,
           y,
           first.sum(x, y),
           {0.5 * (first.sum(x + 1, y) - first.sum(x - 1, y)), 0.5 * (first.sum(x, y + 1) - first.sum(x, y - 1))}});
      structure += samples.back().gradient * samples.back().gradient.transpose();
    }
  if (samples.size() < fewest_lit) return motion;
  const Eigen::Matrix2d inverse = structure.inverse();
  const auto change = [&](const BitImages& bit, const Sample& sample, const Eigen::Vector2d& shift) {
    const double px = sample.x + shift.x(), py = sample.y + shift.y();
    const int x = static_cast<int>(px), y = static_cast<int>(py);
    const double a = px - x, b = py - y;
    return (1 - b) * ((1 - a) * bit.sum(x, y) + a * bit.sum(x + 1, y)) +
           b * ((1 - a) * bit.sum(x, y + 1) + a * bit.sum(x + 1, y + 1)) - sample.sum;
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

void hold_still(const Motion& motion, PatternImages* s) {
  const auto move = [&](PixelView* image, const Eigen::Vector2d& shift) {
    if (!*image || shift.isZero()) return;
    const Image& there = s->converted.emplace_back(moved(*image, s->width, s->height, shift));
    *image = {there.samples.data(), there.width};
  };
  size_t next = 0;
  for (auto& of_axis : s->bits)
    for (BitImages& bit : of_axis) {
      move(&bit.pattern, motion[next]);
      move(&bit.inverse, motion[next++]);
    }
  move(&s->lit_and_unlit.pattern, motion.back());
  move(&s->lit_and_unlit.inverse, motion.back());
}

}  // namespace booth
