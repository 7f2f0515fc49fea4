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
#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

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
    std::vector<size_t> lit(tile_rows(), 0);
    work_.parallel_for(lit.size(), 1, [&](size_t begin, size_t end) {
      for (size_t row = begin; row < end && !work_.stopped(); ++row) lit[row] = place(static_cast<int>(row), profiles);
    });
    if (work_.stopped()) return Work::cancelled();
    if (std::accumulate(lit.begin(), lit.end(), size_t{0}) < fewest_lit)
      return Error{ErrorCode::no_subject, "hardly any pixel is lit by the projector"};

    out->origin = s_.origin;
    out->position = FloatImage(s_.width, s_.height, 2, std::numeric_limits<float>::quiet_NaN());
    out->sigma = FloatImage(s_.width, s_.height, 1, std::numeric_limits<float>::infinity());
    const PositionFit fit(raw_);
    work_.parallel_for(lit.size(), 1, [&](size_t begin, size_t end) {
      for (size_t row = begin; row < end && !work_.stopped(); ++row)
        for_each_tile(static_cast<int>(row), [&](int x, int y, const Eigen::AlignedBox2i&) {
          for (int v = y; v < std::min(y + TileRow::size, s_.height); ++v) fit.fit(v, x, x + TileRow::size, out);
        });
    });
    if (work_.stopped()) return Work::cancelled();
    for (size_t i = 0; i < out->position.samples.size(); i += 2)
      if (!std::isnan(out->position.samples[i])) ++out->decoded;
    return {};
  }

 private:
  /// Rows of tiles; the images begin with one.
  size_t tile_rows() const { return static_cast<size_t>((s_.height + TileRow::size - 1) / TileRow::size); }

  /// Calls `visit` with the first pixel of each tile that is looked for in a row of tiles, and what can light it. Tiles
  /// that reach over the images' right rim begin where they end with it.
  template <class Visitor>
  void for_each_tile(int row, const Visitor& visit) const {
    const Eigen::Vector2i first = s_.origin / SearchTiles::size_px;
    for (int x = 0; x < s_.width; x += TileRow::size)
      if (const auto& lit_from = tiles_.at(first.x() + x / TileRow::size, first.y() + row); !lit_from.isEmpty())
        visit(std::min(x, s_.width - TileRow::size), row * TileRow::size, lit_from);
  }

  /// By the mean strength of the finest stripes, columns' and rows'; one of them tells for the other.
  std::array<double, 2> measure_blur() const {
    constexpr double usual_blur = 0.6;
    const auto strength = reader_.finest_strength();
    std::array<double, 2> blur{usual_blur, usual_blur};
    for (size_t axis = 0; axis < 2 && strength; ++axis) {
      const double own = (*strength)[axis], other = (*strength)[1 - axis];
      if (own > 0 || other > 0) blur[axis] = StripeProfiles::blur_of(own > 0 ? own : other);
    }
    return blur;
  }

  /// Reads and places the pixels of a row of tiles. Returns how many are lit.
  size_t place(int row, const std::array<StripeProfiles, 2>& profiles) {
    size_t lit = 0;
    TileRead read;
    for_each_tile(row, [&](int x, int y, const Eigen::AlignedBox2i& lit_from) {
      reader_.read(x, y, &read);
      for (int v = 0; v < std::min(TileRow::size, s_.height - y); ++v)
        for (int u = 0; u < TileRow::size; ++u) {
          if (read[v].lit[u] == 0) continue;
          ++lit;
          place(read[v], u, static_cast<size_t>(raw_.index(x + u, y + v)), lit_from, profiles);
        }
    });
    return lit;
  }

  void place(const TileRow& read, int pixel, size_t at, const Eigen::AlignedBox2i& lit_from,
             const std::array<StripeProfiles, 2>& profiles) {
    raw_.weight[at] = -1;
    if (!lit_from.contains(Eigen::Vector2i(read.axis[0].code[pixel], read.axis[1].code[pixel]))) return;
    const auto column = profiles[0].place(read.axis[0], pixel, known_[0]);
    const auto row = profiles[1].place(read.axis[1], pixel, known_[1]);
    const auto inside = [&](float position, int size) {
      return position > -0.5F && position < static_cast<float>(size) - 0.5F;
    };
    if (!inside(column.position, sizes_[0]) || !inside(row.position, sizes_[1])) return;
    raw_.column[at] = column.position;
    raw_.row[at] = row.position;
    raw_.weight[at] = std::min(column.information, row.information) * read.snr2[pixel];
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
