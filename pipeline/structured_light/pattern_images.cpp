#include "pipeline/structured_light/pattern_images.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <bit>
#include <optional>

namespace booth {
namespace {

Image to_grey(const Image& image) {
  Image grey(image.width, image.height, 1);
  const size_t channels = static_cast<size_t>(image.channels);
  for (size_t i = 0; i < grey.samples.size(); ++i) {
    const uint8_t* p = image.samples.data() + i * channels;
    grey.samples[i] = static_cast<uint8_t>((p[0] + 2 * p[1] + p[2] + 2) / 4);  // green sees most of a projector's light
  }
  return grey;
}

/// The smallest rectangle of pixels that holds all tiles that are looked for.
Eigen::AlignedBox2i searched(const SearchTiles& tiles, int width, int height) {
  Eigen::AlignedBox2i area;
  for (int row = 0; row < tiles.rows; ++row)
    for (int column = 0; column < tiles.columns; ++column)
      if (!tiles.at(column, row).isEmpty()) {
        area.extend(SearchTiles::size_px * Eigen::Vector2i(column, row));
        area.extend(SearchTiles::size_px * Eigen::Vector2i(column + 1, row + 1) - Eigen::Vector2i::Ones());
      }
  return area.intersection({Eigen::Vector2i::Zero(), Eigen::Vector2i(width - 1, height - 1)});
}

/// Calls `visit` with the pixels that clearly show whether they are lit: by far different in both images.
template <class Visitor>
void for_each_lit(const PatternImages& s, const BitImages& pair, const Visitor& visit) {
  constexpr int stride = 8;  // every eighth pixel of every eighth row tells enough
  for (int y = 0; y < s.height; y += stride)
    for (int x = 0; x < s.width; x += stride)
      if (const int contrast = pair.contrast(x, y); contrast >= clearly_lit) visit(x, y, contrast);
}

/// Whether the sums of two pairs, which are the same without a fault, differ at many lit pixels.
bool contradict(const PatternImages& s, const BitImages& reference, const BitImages& pair) {
  constexpr double tolerated_share = 0.3;
  size_t lit = 0, contradicting = 0;
  for_each_lit(s, reference, [&](int x, int y, int contrast) {
    ++lit;
    if (2 * std::abs(pair.sum(x, y) - reference.sum(x, y)) > contrast) ++contradicting;
  });
  return lit > 0 && static_cast<double>(contradicting) >= tolerated_share * static_cast<double>(lit);
}

/// Whether two images show the same, apart from noise, where the projector lights.
bool same(const PatternImages& s, const BitImages& reference, const PixelView& a, const PixelView& b) {
  constexpr double tolerated_share = 0.15;
  size_t lit = 0, different = 0;
  for_each_lit(s, reference, [&](int x, int y, int contrast) {
    ++lit;
    if (3 * std::abs(a.at(x, y) - b.at(x, y)) > contrast) ++different;
  });
  return static_cast<double>(different) < tolerated_share * static_cast<double>(lit);
}

}  // namespace

int bits_for(int size) { return std::bit_width(static_cast<unsigned>(std::max(size, 2) - 1)); }

Result<PatternImages> sort_images(std::span<const Frame> frames, const GrayCodePattern& pattern,
                                  const SearchTiles& tiles) {
  if (!pattern.columns || !pattern.rows)
    return Error{ErrorCode::unsupported, "the Gray-code sequence has no patterns for both columns and rows"};
  if (std::max(bits_for(pattern.width), bits_for(pattern.height)) > static_cast<int>(most_bits))
    return Error{ErrorCode::unsupported, "the Gray-code pattern is wider or higher than 65536 pixels"};
  if (frames.empty()) return Error{ErrorCode::no_subject, "the Gray-code sequence has no images"};
  PatternImages images;
  const Image& first = *frames.front().pixels;
  const Eigen::AlignedBox2i area = searched(tiles, first.width, first.height);
  if (area.isEmpty()) return Error{ErrorCode::no_subject, "nothing to decode lies in the camera's images"};
  images.origin = area.min();
  images.width = area.sizes().x() + 1;
  images.height = area.sizes().y() + 1;
  if (std::min(images.width, images.height) < SearchTiles::size_px)
    return Error{ErrorCode::no_subject,
                 "the camera's images show less than " + std::to_string(SearchTiles::size_px) + " pixels to decode"};
  std::vector<PixelView> shown(static_cast<size_t>(pattern_count(pattern)));
  for (const Frame& frame : frames) {
    if (frame.index < 0 || static_cast<size_t>(frame.index) >= shown.size()) continue;
    const Image* image = frame.pixels.get();
    if (image->width != first.width || image->height != first.height)
      return Error{ErrorCode::invalid_argument, "camera " + frame.camera + ": image " + std::to_string(frame.index) +
                                                    " of the Gray-code sequence has another size than the others"};
    if (image->channels != 1) image = &images.converted.emplace_back(to_grey(*image));
    shown[static_cast<size_t>(frame.index)] = {image->pixel(images.origin.x(), images.origin.y()), image->width};
  }
  size_t next = 0;
  const std::array<int, 2> sizes{pattern.width, pattern.height};
  for (size_t axis = 0; axis < 2; ++axis)
    for (int bit = 0; bit < bits_for(sizes[axis]); ++bit) {
      BitImages pair{shown[next++], {}};
      if (pattern.inverse) pair.inverse = shown[next++];
      images.bits[axis].push_back(pair);
    }
  images.lit_and_unlit = {shown[next], shown[next + 1]};
  return images;
}

void drop_contradicting(PatternImages* s, const std::string& camera, std::vector<std::string>* warnings) {
  std::vector<const BitImages*> pairs;
  for (const auto& bits : s->bits)
    for (const BitImages& bit : bits)
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
      for_each_lit(*s, *pairs.front(), [&](int x, int y, int contrast) {
        ++lit;
        if (2 * candidate.contrast(x, y) < contrast) ++weaker;
      });
    return 2 * static_cast<size_t>(against) < pairs.size() &&
           static_cast<double>(weaker) <= tolerated_share * static_cast<double>(lit);
  };
  if (s->lit_and_unlit.complete()) {
    if (agreed(s->lit_and_unlit)) {
      reference = s->lit_and_unlit;
    } else {
      s->lit_and_unlit = {};
      warnings->push_back("camera " + camera + ": the lit and the unlit image contradict the others and were left out");
    }
  }
  constexpr size_t most_tried = 4;
  for (size_t p = 0; p < std::min(pairs.size(), most_tried) && !reference; ++p)
    if (agreed(*pairs[p])) reference = *pairs[p];
  if (!reference) return;
  PixelView before;
  for (size_t axis = 0; axis < 2; ++axis)
    for (size_t bit = 0; bit < s->bits[axis].size(); ++bit) {
      BitImages& images = s->bits[axis][bit];
      const BitImages shown = images;
      if (images.complete() && contradict(*s, *reference, images)) {
        const std::string name = (axis == 0 ? "column bit " : "row bit ") + std::to_string(bit);
        if (same(*s, *reference, images.pattern, images.inverse)) {
          images.inverse = {};
          warnings->push_back("camera " + camera + ": the inverse of " + name +
                              " repeats the image before and was left out");
        } else if (before && same(*s, *reference, before, images.pattern)) {
          images.pattern = {};
          warnings->push_back("camera " + camera + ": the image of " + name +
                              " repeats the one before and was left out");
        } else {
          images = {};
          warnings->push_back("camera " + camera + ": the images of " + name +
                              " contradict the others and were left out");
        }
      }
      before = shown.inverse ? shown.inverse : shown.pattern;
    }
}

}  // namespace booth
