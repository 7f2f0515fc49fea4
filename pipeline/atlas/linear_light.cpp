#include "pipeline/atlas/linear_light.h"

#include <array>
#include <cmath>

namespace booth {
namespace {

double decoded(double value) { return value <= 0.04045 ? value / 12.92 : std::pow((value + 0.055) / 1.055, 2.4); }
double encoded(double light) { return light <= 0.0031308 ? 12.92 * light : 1.055 * std::pow(light, 1 / 2.4) - 0.055; }

std::array<float, 256> decoding_table() {
  std::array<float, 256> table{};
  for (size_t i = 0; i < table.size(); ++i) table[i] = static_cast<float>(decoded(static_cast<double>(i) / 255));
  return table;
}

std::array<uint8_t, linear_light_steps + 1> encoding_table() {
  std::array<uint8_t, linear_light_steps + 1> table{};
  for (size_t i = 0; i <= linear_light_steps; ++i)
    table[i] = static_cast<uint8_t>(std::lround(255 * encoded(static_cast<double>(i) / linear_light_steps)));
  return table;
}

}  // namespace

const std::array<float, 256> linear_light_of_srgb = decoding_table();

const std::array<uint8_t, linear_light_steps + 1> srgb_of_linear_light = encoding_table();

}  // namespace booth
