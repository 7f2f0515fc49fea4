#include "pipeline/atlas/linear_light.h"

#include <algorithm>
#include <array>
#include <cmath>

namespace booth {
namespace {

double decoded(double value) { return value <= 0.04045 ? value / 12.92 : std::pow((value + 0.055) / 1.055, 2.4); }
double encoded(double light) { return light <= 0.0031308 ? 12.92 * light : 1.055 * std::pow(light, 1 / 2.4) - 0.055; }

// In even steps of light the darkest values lie 1/3300 apart: this many entries tell them apart with room to spare.
constexpr size_t steps = 1 << 14;

std::array<float, 256> decoding_table() {
  std::array<float, 256> table{};
  for (size_t i = 0; i < table.size(); ++i) table[i] = static_cast<float>(decoded(static_cast<double>(i) / 255));
  return table;
}

std::array<uint8_t, steps + 1> encoding_table() {
  std::array<uint8_t, steps + 1> table{};
  for (size_t i = 0; i <= steps; ++i)
    table[i] = static_cast<uint8_t>(std::lround(255 * encoded(static_cast<double>(i) / steps)));
  return table;
}

const std::array<uint8_t, steps + 1> srgb_of_linear_light = encoding_table();

}  // namespace

const std::array<float, 256> linear_light_of_srgb = decoding_table();

uint8_t srgb_from_linear(float light) {
  return srgb_of_linear_light[static_cast<size_t>(std::clamp(light, 0.0F, 1.0F) * static_cast<float>(steps) + 0.5F)];
}

}  // namespace booth
