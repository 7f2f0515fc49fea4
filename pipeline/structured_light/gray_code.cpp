#include "pipeline/structured_light/gray_code.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "pipeline/structured_light/bit_reader.h"
#include "pipeline/structured_light/pattern_images.h"
#include "pipeline/structured_light/position_fit.h"
#include "pipeline/structured_light/stripe_profiles.h"
#include "pipeline/structured_light/subject_motion.h"
#include "pipeline/structured_light/vector_clones.h"

namespace booth {
namespace {

constexpr size_t row_grain = 16;  // rows in a piece of parallel work

/// Leaves out the tiles that are not in or near the subject; the margin leaves room for its movement since it was
/// segmented.
void keep_near(const Image& subject, SearchTiles* tiles) {
  constexpr int margin = 2;  // tiles
  Image near(tiles->columns, tiles->rows, 1);
  for (int y = 0; y < subject.height; ++y)
    for (int x = 0; x < subject.width; ++x)
      if (subject.at(x, y) >= 128) {
        const int column = x / SearchTiles::size_px, row = y / SearchTiles::size_px;
        near.at(column, row) = 1;
        x = (column + 1) * SearchTiles::size_px - 1;  // on with the next tile
      }
  for (int row = 0; row < tiles->rows; ++row)
    for (int column = 0; column < tiles->columns; ++column) {
      bool kept = false;
      for (int v = std::max(0, row - margin); v <= std::min(tiles->rows - 1, row + margin); ++v)
        for (int u = std::max(0, column - margin); u <= std::min(tiles->columns - 1, column + margin); ++u)
          kept |= near.at(u, v) != 0;
      if (!kept) tiles->at(column, row).setEmpty();
    }
}

class Decoder {
 public:
  Decoder(const PatternImages& images, const GrayCodePattern& pattern, const SearchTiles& tiles,
          const GrayCodeOptions& options, const Work& work)
      : s_(images),
        tiles_(tiles),
        work_(work),
        sizes_{pattern.width, pattern.height},
        reader_(images, options.min_snr),
        raw_(images.width, images.height) {
    for (size_t axis = 0; axis < 2; ++axis)
      for (size_t k = 0; k < static_cast<size_t>(fine_bits); ++k) {
        const auto& bits = s_.bits[axis];
        known_[axis][k] = k < bits.size() && !bits[bits.size() - 1 - k].missing();
      }
  }

  Result<void> run(ProjectorCoordinates* out) {
    if (const auto usable = reader_.check(); !usable) return usable;
    out->noise = reader_.noise();
    const std::array<double, 2> blurs = measure_blur();
    out->blur_px = blurs[1];
    const std::array<StripeProfiles, 2> profiles{StripeProfiles(blurs[0]), StripeProfiles(blurs[1])};
    std::vector<size_t> lit(static_cast<size_t>(s_.height), 0);
    work_.parallel_for(lit.size(), row_grain, [&](size_t begin, size_t end) {
      for (size_t y = begin; y < end && !work_.stopped(); ++y) lit[y] = place_row(static_cast<int>(y), profiles);
    });
    if (work_.stopped()) return Work::cancelled();
    if (std::accumulate(lit.begin(), lit.end(), size_t{0}) < fewest_lit)
      return Error{ErrorCode::no_subject, "hardly any pixel is lit by the projector"};

    out->origin = s_.origin;
    out->position = FloatImage(s_.width, s_.height, 2, std::numeric_limits<float>::quiet_NaN());
    out->sigma = FloatImage(s_.width, s_.height, 1, std::numeric_limits<float>::infinity());
    const PositionFit fit(raw_);
    work_.parallel_for(lit.size(), row_grain, [&](size_t begin, size_t end) {
      for (size_t y = begin; y < end && !work_.stopped(); ++y)
        for_each_tile(static_cast<int>(y), [&](int x, const Eigen::AlignedBox2i&) {
          fit.fit(static_cast<int>(y), x, x + TileRow::size, out);
        });
    });
    if (work_.stopped()) return Work::cancelled();
    for (size_t i = 0; i < out->position.samples.size(); i += 2)
      if (!std::isnan(out->position.samples[i])) ++out->decoded;
    return {};
  }

 private:
  /// Calls `visit` with the first pixel of each tile that is looked for in a row of the images, and what can light it.
  /// Tiles that reach over the images' rim begin where they end with it.
  template <class Visitor>
  void for_each_tile(int y, const Visitor& visit) const {
    const int row = (s_.origin.y() + y) / SearchTiles::size_px, first = s_.origin.x() / SearchTiles::size_px;
    for (int x = 0; x < s_.width; x += TileRow::size)
      if (const Eigen::AlignedBox2i& lit_from = tiles_.at(first + x / TileRow::size, row); !lit_from.isEmpty())
        visit(std::min(x, s_.width - TileRow::size), lit_from);
  }

  /// By the mean strength of the finest stripes where pixels are sure, columns' and rows'.
  std::array<double, 2> measure_blur() const {
    std::array<double, 2> sum{};
    size_t count = 0;
    constexpr int stride = 8;  // every eighth row tells enough
    constexpr float sure_snr = 4;
    TileRow read;
    for (int y = 0; y < s_.height; y += stride)
      for_each_tile(y, [&](int x, const Eigen::AlignedBox2i&) {
        reader_.read(x, y, &read);
        for (size_t i = 0; i < static_cast<size_t>(TileRow::size); ++i) {
          if (read.lit[i] == 0 || read.snr2[i] < sure_snr * sure_snr) continue;
          ++count;
          for (size_t axis = 0; axis < 2; ++axis)
            sum[axis] += std::abs(static_cast<double>(read.axis[axis].relative[0][i])) / relative_unit;
        }
      });
    constexpr double usual_blur = 0.6;
    std::array<double, 2> blur{usual_blur, usual_blur};
    for (size_t axis = 0; axis < 2; ++axis)
      if (known_[axis][0] && count > 0) blur[axis] = StripeProfiles::blur_of(sum[axis] / static_cast<double>(count));
    return blur;
  }

  /// Reads and places a row's pixels. Returns how many are lit.
  size_t place_row(int y, const std::array<StripeProfiles, 2>& profiles) {
    size_t lit = 0;
    TileRow read;
    for_each_tile(y, [&](int x, const Eigen::AlignedBox2i& lit_from) {
      reader_.read(x, y, &read);
      for (int i = 0; i < TileRow::size; ++i) {
        if (read.lit[i] == 0) continue;
        ++lit;
        const auto at = static_cast<size_t>(raw_.index(x + i, y));
        raw_.weight[at] = -1;
        if (!lit_from.contains(Eigen::Vector2i(read.axis[0].code[i], read.axis[1].code[i]))) continue;
        const auto column = profiles[0].place(read.axis[0], i, known_[0]);
        const auto row = profiles[1].place(read.axis[1], i, known_[1]);
        const auto inside = [&](float position, int size) {
          return position > -0.5F && position < static_cast<float>(size) - 0.5F;
        };
        if (!inside(column.position, sizes_[0]) || !inside(row.position, sizes_[1])) continue;
        raw_.column[at] = column.position;
        raw_.row[at] = row.position;
        raw_.weight[at] = std::min(column.information, row.information) * read.snr2[i];
      }
    });
    return lit;
  }

  const PatternImages& s_;
  const SearchTiles& tiles_;
  const Work& work_;
  std::array<int, 2> sizes_;
  std::array<std::array<bool, fine_bits>, 2> known_{};  ///< fine bits that have images
  BitReader reader_;
  RawPositions raw_;
};

}  // namespace

SearchTiles SearchTiles::everywhere(int width, int height) {
  SearchTiles tiles;
  tiles.columns = (width + size_px - 1) / size_px;
  tiles.rows = (height + size_px - 1) / size_px;
  constexpr int most = std::numeric_limits<int>::max();
  tiles.lit_from.assign(static_cast<size_t>(tiles.columns) * static_cast<size_t>(tiles.rows),
                        {Eigen::Vector2i::Zero(), Eigen::Vector2i(most, most)});
  return tiles;
}

Result<ProjectorCoordinates> decode_gray_code(std::span<const Frame> frames, const GrayCodePattern& pattern,
                                              const Image* subject, const SearchTiles* tiles,
                                              const GrayCodeOptions& options, const Work& work) {
  if (frames.empty()) return Error{ErrorCode::no_subject, "the Gray-code sequence has no images"};
  const Image& first = *frames.front().pixels;
  SearchTiles searched = SearchTiles::everywhere(first.width, first.height);
  if (tiles != nullptr) {
    if (tiles->columns != searched.columns || tiles->rows != searched.rows)
      return Error{ErrorCode::invalid_argument, "camera " + frames.front().camera +
                                                    ": the images of the Gray-code sequence are " +
                                                    std::to_string(first.width) + " x " + std::to_string(first.height) +
                                                    " pixels large, not what the rig says"};
    searched = *tiles;
  }
  if (subject != nullptr && (subject->width != first.width || subject->height != first.height)) subject = nullptr;
  if (subject != nullptr) keep_near(*subject, &searched);
  ProjectorCoordinates out;
  out.camera = frames.front().camera;
  auto images = sort_images(frames, pattern, searched);
  if (!images) return images.error();
  const Motion motion = measure_motion(*images, searched, subject);
  out.motion_px = largest_of(motion);
  constexpr double noticeable_px = 0.4;
  if (out.motion_px > noticeable_px) hold_still(motion, &*images);
  drop_contradicting(&*images, out.camera, &out.warnings);
  if (const auto decoded = Decoder(*images, pattern, searched, options, work).run(&out); !decoded)
    return Error{decoded.error().code, "camera " + out.camera + ": " + decoded.error().message};
  return out;
}

}  // namespace booth
