#pragma once

#include <Eigen/Core>
#include <array>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <span>
#include <string>
#include <vector>

#include "pipeline/structured_light/gray_code.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/image.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

inline constexpr int clearly_lit = 12;   ///< grey levels between a pattern and its inverse
inline constexpr size_t most_bits = 16;  ///< of a coordinate
inline constexpr int fewest_lit = 200;   ///< pixels below which there is nothing to decode

/// Part of a grey image of someone else.
struct PixelView {
  const uint8_t* samples = nullptr;  ///< nullptr: there is no image
  std::ptrdiff_t stride = 0;

  const uint8_t* row(int y) const { return samples + y * stride; }
  int at(int x, int y) const { return row(y)[x]; }
  explicit operator bool() const { return samples != nullptr; }
};

/// One bit of a coordinate: the images that show it.
struct BitImages {
  PixelView pattern, inverse;

  bool complete() const { return pattern && inverse; }
  bool missing() const { return !pattern && !inverse; }
  /// Of both images at a pixel: what is lit evenly shows, without the pattern.
  int sum(int x, int y) const { return pattern.at(x, y) + inverse.at(x, y); }
  int contrast(int x, int y) const { return std::abs(pattern.at(x, y) - inverse.at(x, y)); }
};

/// The part of a camera's sequence that is decoded, sorted by what each image shows.
struct PatternImages {
  Eigen::Vector2i origin{0, 0};                ///< the camera's pixel that (0, 0) of all views is
  int width = 0, height = 0;                   ///< of all views
  std::array<std::vector<BitImages>, 2> bits;  ///< of columns, of rows; from the most significant
  BitImages lit_and_unlit;
  std::deque<Image> converted;  ///< grey copies of colour images, and moved ones
};

/// Bits that tell a coordinate of the pattern's.
int bits_for(int size);

/// @param tiles  as large as the images; the smallest rectangle that holds all that are looked for is viewed
/// @error unsupported, invalid_argument, no_subject  as decode_gray_code
Result<PatternImages> sort_images(std::span<const Frame> frames, const GrayCodePattern& pattern,
                                  const SearchTiles& tiles);

/// A pattern that was not projected when its image was taken (the projector did not step, or an image stands twice in
/// the sequence) shows in the sum with its inverse, which is the same for all bits. Of the two, the one that repeats
/// the image before it is left out; where neither does, both.
void drop_contradicting(PatternImages* images, const std::string& camera, std::vector<std::string>* warnings);

}  // namespace booth
