#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "pipeline/types/field.h"

namespace booth {

/// A bit for each sample of a brick: number n of a plane is that of place (n % 8, n / 8) in it, planes along z.
using BrickBits = std::array<uint64_t, Field::brick_side>;

/// Which samples of a stored brick are inside: below 0.
inline BrickBits inside_bits(const float* samples) {
  constexpr size_t plane = size_t{Field::brick_side} * Field::brick_side;
  BrickBits bits{};
  for (uint64_t& of_plane : bits) {
    for (size_t n = 0; n < plane; ++n) of_plane |= static_cast<uint64_t>(samples[n] < 0) << n;
    samples += plane;
  }
  return bits;
}

}  // namespace booth
