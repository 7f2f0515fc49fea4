#include "pipeline/geometry/outline_distance.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>

#include "pipeline/types/vector_clones.h"

namespace booth {
namespace {

constexpr float half_tile_diagonal = 5.657F;  // pixels, of a tile of eight

bool is_subject(uint8_t coverage) { return coverage >= 128; }

/// Lowers the squared distances of samples at (x, y) to those to a piece of outline, where they are larger.
template <size_t count>
BOOTH_VECTOR_CLONES void approach(float x0, float y0, float x1, float y1, const std::array<float, count>& x,
                                  const std::array<float, count>& y, std::array<float, count>& distances2) {
  const float dx = x1 - x0, dy = y1 - y0;
  const float inverse = 1 / std::max(dx * dx + dy * dy, 1e-12F);
  for (size_t s = 0; s < count; ++s) {
    const float px = x[s] - x0, py = y[s] - y0;
    float share = (px * dx + py * dy) * inverse;
    share = share > 0 ? share : 0;
    share = share < 1 ? share : 1;
    const float ex = px - share * dx, ey = py - share * dy;
    const float distance2 = ex * ex + ey * ey;
    distances2[s] = distance2 < distances2[s] ? distance2 : distances2[s];
  }
}

/// Where the coverage passes 127.5 between two pixel centres, as a share of the way.
float crossing(uint8_t from, uint8_t to) {
  return (127.5F - static_cast<float>(from)) / (static_cast<float>(to) - static_cast<float>(from));
}

}  // namespace

OutlineDistance::OutlineDistance(const Image& coverage, double feather_px)
    : width_(coverage.width),
      height_(coverage.height),
      tiles_x_(std::max(1, (coverage.width + tile - 2) / tile)),
      tiles_y_(std::max(1, (coverage.height + tile - 2) / tile)) {
  find_outline(coverage);
  if (segments_.empty()) content_ = is_subject(coverage.at(0, 0)) ? Content::all_subject : Content::no_subject;
  if (!segments_.empty()) content_ = Content::outline;
  spread(coverage);
  refine(coverage);
  feather(coverage, feather_px);
}

/// Marching squares: the pieces of the outline between the pixel centres of every tile.
void OutlineDistance::find_outline(const Image& coverage) {
  first_segment_.reserve(static_cast<size_t>(tiles_x_) * static_cast<size_t>(tiles_y_) + 1);
  for (int ty = 0; ty < tiles_y_; ++ty)
    for (int tx = 0; tx < tiles_x_; ++tx) {
      first_segment_.push_back(static_cast<uint32_t>(segments_.size()));
      const int x_end = std::min(tx * tile + tile, width_ - 1), y_end = std::min(ty * tile + tile, height_ - 1);
      // Most tiles are all subject or all background: look at the top bits of nine pixels at once.
      uint8_t any = 0, all = 0xFF;
      for (int y = ty * tile; y <= y_end; ++y) {
        const uint8_t* row = coverage.pixel(0, y);
        for (int x = tx * tile; x <= x_end; ++x) {
          any = static_cast<uint8_t>(any | row[x]);
          all = static_cast<uint8_t>(all & row[x]);
        }
      }
      if (!is_subject(any) || is_subject(all)) continue;
      for (int y = ty * tile; y < y_end; ++y)
        for (int x = tx * tile; x < x_end; ++x) {
          const uint8_t a = coverage.at(x, y), b = coverage.at(x + 1, y);
          const uint8_t c = coverage.at(x + 1, y + 1), d = coverage.at(x, y + 1);
          const int pattern = static_cast<int>(is_subject(a)) | static_cast<int>(is_subject(b)) << 1 |
                              static_cast<int>(is_subject(c)) << 2 | static_cast<int>(is_subject(d)) << 3;
          if (pattern == 0 || pattern == 15) continue;
          struct Point {
            float x, y;
          };
          const auto fx = static_cast<float>(x), fy = static_cast<float>(y);
          std::array<Point, 4> points{};  // around the square: top, right, bottom, left
          int count = 0;
          if (is_subject(a) != is_subject(b)) points[static_cast<size_t>(count++)] = {fx + crossing(a, b), fy};
          if (is_subject(b) != is_subject(c)) points[static_cast<size_t>(count++)] = {fx + 1, fy + crossing(b, c)};
          if (is_subject(d) != is_subject(c)) points[static_cast<size_t>(count++)] = {fx + crossing(d, c), fy + 1};
          if (is_subject(a) != is_subject(d)) points[static_cast<size_t>(count++)] = {fx, fy + crossing(a, d)};
          const auto add = [&](const Point& p, const Point& q) { segments_.push_back({p.x, p.y, q.x, q.y}); };
          if (count == 2) {
            add(points[0], points[1]);
            continue;
          }
          // Two opposite corners are subject: the middle decides whether they are joined.
          const bool joined = a + b + c + d >= 4 * 127.5;
          if (joined == is_subject(a)) {
            add(points[0], points[1]);
            add(points[2], points[3]);
          } else {
            add(points[0], points[3]);
            add(points[1], points[2]);
          }
        }
    }
  first_segment_.push_back(static_cast<uint32_t>(segments_.size()));
}

/// The distance at the tiles' corners: each takes over the tile that holds its neighbour's nearest piece of outline
/// if that is nearer than its own. After P.-E. Danielsson, "Euclidean distance mapping", 1980.
void OutlineDistance::spread(const Image& coverage) {
  const int columns = tiles_x_ + 1, rows = tiles_y_ + 1;
  const auto far = static_cast<float>(width_ + height_);
  node_distance_.assign(static_cast<size_t>(columns) * static_cast<size_t>(rows), far);
  std::vector<int32_t> nearest(node_distance_.size(), -1);
  const auto offer = [&](int i, int j, int32_t from) {
    const size_t node = static_cast<size_t>(j) * static_cast<size_t>(columns) + static_cast<size_t>(i);
    if (from < 0 || nearest[node] == from) return;
    const auto x = static_cast<float>(i * tile), y = static_cast<float>(j * tile);
    float best = node_distance_[node] * node_distance_[node];
    const auto left = static_cast<float>(from % tiles_x_ * tile), top = static_cast<float>(from / tiles_x_ * tile);
    const float beside = std::max({left - x, x - left - tile, 0.0F}), over = std::max({top - y, y - top - tile, 0.0F});
    if (beside * beside + over * over >= best) return;
    for (size_t s = first_segment_[static_cast<size_t>(from)]; s < first_segment_[static_cast<size_t>(from) + 1]; ++s) {
      const Segment& piece = segments_[s];
      const float dx = piece.x1 - piece.x0, dy = piece.y1 - piece.y0;
      const float length2 = std::max(dx * dx + dy * dy, 1e-12F);
      const float share = std::clamp(((x - piece.x0) * dx + (y - piece.y0) * dy) / length2, 0.0F, 1.0F);
      const float ex = x - piece.x0 - share * dx, ey = y - piece.y0 - share * dy;
      if (const float distance2 = ex * ex + ey * ey; distance2 < best) {
        best = distance2;
        nearest[node] = from;
      }
    }
    node_distance_[node] = std::sqrt(best);
  };
  for (int ty = 0; ty < tiles_y_; ++ty)
    for (int tx = 0; tx < tiles_x_; ++tx) {
      const int32_t index = ty * tiles_x_ + tx;
      if (first_segment_[static_cast<size_t>(index)] == first_segment_[static_cast<size_t>(index) + 1]) continue;
      for (const auto& [i, j] : {std::array{0, 0}, std::array{1, 0}, std::array{0, 1}, std::array{1, 1}})
        offer(tx + i, ty + j, index);
    }
  const auto take = [&](int i, int j, int di, int dj) {
    if (i + di >= 0 && j + dj >= 0 && i + di < columns && j + dj < rows)
      offer(i, j, nearest[static_cast<size_t>(j + dj) * static_cast<size_t>(columns) + static_cast<size_t>(i + di)]);
  };
  for (int j = 0; j < rows; ++j) {
    for (int i = 0; i < columns; ++i)
      for (const auto& [di, dj] : {std::array{-1, -1}, std::array{0, -1}, std::array{1, -1}, std::array{-1, 0}})
        take(i, j, di, dj);
    for (int i = columns - 1; i >= 0; --i) take(i, j, 1, 0);
  }
  for (int j = rows - 1; j >= 0; --j) {
    for (int i = columns - 1; i >= 0; --i)
      for (const auto& [di, dj] : {std::array{1, 1}, std::array{0, 1}, std::array{-1, 1}, std::array{1, 0}})
        take(i, j, di, dj);
    for (int i = 0; i < columns; ++i) take(i, j, -1, 0);
  }
  for (int j = 0; j < rows; ++j)
    for (int i = 0; i < columns; ++i)
      if (is_subject(coverage.at(std::min(i * tile, width_ - 1), std::min(j * tile, height_ - 1)))) {
        float& distance =
            node_distance_[static_cast<size_t>(j) * static_cast<size_t>(columns) + static_cast<size_t>(i)];
        distance = -distance;
      }
}

/// The distance at every pixel centre of the tiles that the outline passes through, and of those around them.
void OutlineDistance::refine(const Image& coverage) {
  samples_of_.assign(static_cast<size_t>(tiles_x_) * static_cast<size_t>(tiles_y_), -1);
  const auto holds_outline = [&](int tx, int ty) {
    const auto index = static_cast<size_t>(ty * tiles_x_ + tx);
    return first_segment_[index] != first_segment_[index + 1];
  };
  const auto for_each_near = [&](int tx, int ty, int reach, const auto& visit) {
    for (int y = std::max(0, ty - reach); y <= std::min(tiles_y_ - 1, ty + reach); ++y)
      for (int x = std::max(0, tx - reach); x <= std::min(tiles_x_ - 1, tx + reach); ++x)
        if (holds_outline(x, y)) visit(x, y);
  };
  Samples along_x, along_y;  // of the samples, from the tile's first
  for (int j = 0; j < nodes; ++j)
    for (int i = 0; i < nodes; ++i) {
      along_x[static_cast<size_t>(j * nodes + i)] = static_cast<float>(i);
      along_y[static_cast<size_t>(j * nodes + i)] = static_cast<float>(j);
    }
  std::vector<Segment> near;       // relative to the tile
  std::vector<float> from_middle;  // their distances from its middle
  constexpr float middle = 0.5F * tile;
  for (int ty = 0; ty < tiles_y_; ++ty)
    for (int tx = 0; tx < tiles_x_; ++tx) {
      bool wanted = false;
      for_each_near(tx, ty, 1, [&](int, int) { wanted = true; });
      if (!wanted) continue;
      const auto left = static_cast<float>(tx * tile), top = static_cast<float>(ty * tile);
      near.clear();
      from_middle.clear();
      float nearest = std::numeric_limits<float>::max();
      for_each_near(tx, ty, 2, [&](int x, int y) {
        const auto index = static_cast<size_t>(y * tiles_x_ + x);
        for (size_t s = first_segment_[index]; s < first_segment_[index + 1]; ++s) {
          const Segment& piece = segments_[s];
          near.push_back({piece.x0 - left, piece.y0 - top, piece.x1 - left, piece.y1 - top});
          const float dx = 0.5F * (near.back().x0 + near.back().x1) - middle;
          const float dy = 0.5F * (near.back().y0 + near.back().y1) - middle;
          from_middle.push_back(std::sqrt(dx * dx + dy * dy));
          nearest = std::min(nearest, from_middle.back());
        }
      });
      samples_of_[static_cast<size_t>(ty * tiles_x_ + tx)] = static_cast<int32_t>(samples_.size());
      Samples& samples = samples_.emplace_back();
      samples.fill(std::numeric_limits<float>::max());
      // All samples are within half a diagonal of the middle; a piece is at most a pixel's diagonal long.
      constexpr float longest_half = 0.71F;
      const float farthest = nearest + 2 * half_tile_diagonal + longest_half;
      for (size_t n = 0; n < near.size(); ++n)
        if (from_middle[n] <= farthest)
          approach(near[n].x0, near[n].y0, near[n].x1, near[n].y1, along_x, along_y, samples);
      for (int j = 0; j < nodes; ++j)
        for (int i = 0; i < nodes; ++i) {
          float& value = samples[static_cast<size_t>(j * nodes + i)];
          value = std::sqrt(value);
          if (is_subject(coverage.at(std::min(tx * tile + i, width_ - 1), std::min(ty * tile + j, height_ - 1))))
            value = -value;
        }
    }
}

void OutlineDistance::feather(const Image& coverage, double feather_px) {
  // Stretches of the image's border that the subject reaches, from … to along it.
  struct Cut {
    float x0, y0, x1, y1;
  };
  std::vector<Cut> cuts;
  const auto scan = [&](int count, const auto& subject, const auto& cut) {
    for (int i = 0; i < count; ++i) {
      if (!subject(i)) continue;
      int last = i;
      while (last + 1 < count && subject(last + 1)) ++last;
      cuts.push_back(cut(static_cast<float>(i), static_cast<float>(last)));
      i = last;
    }
  };
  const float right = static_cast<float>(width_) - 0.5F, bottom = static_cast<float>(height_) - 0.5F;
  scan(
      width_, [&](int x) { return is_subject(coverage.at(x, 0)); },
      [](float a, float b) {
        return Cut{a, -0.5F, b, -0.5F};
      });
  scan(
      width_, [&](int x) { return is_subject(coverage.at(x, height_ - 1)); },
      [&](float a, float b) {
        return Cut{a, bottom, b, bottom};
      });
  scan(
      height_, [&](int y) { return is_subject(coverage.at(0, y)); },
      [](float a, float b) {
        return Cut{-0.5F, a, -0.5F, b};
      });
  scan(
      height_, [&](int y) { return is_subject(coverage.at(width_ - 1, y)); },
      [&](float a, float b) {
        return Cut{right, a, right, b};
      });
  if (cuts.empty() || !(feather_px > 0)) return;
  slope_ = 3;  // the distance's own and the steepest of the parabola below
  const auto reach = static_cast<float>(feather_px);
  const auto lowered_by = [&](float x, float y) {
    float nearest2 = reach * reach;
    for (const Cut& cut : cuts) {
      const float dx = std::max({cut.x0 - x, x - cut.x1, 0.0F}), dy = std::max({cut.y0 - y, y - cut.y1, 0.0F});
      nearest2 = std::min(nearest2, dx * dx + dy * dy);
    }
    const float share = 1 - std::sqrt(nearest2) / reach;
    return reach * share * share;
  };
  for (int j = 0; j <= tiles_y_; ++j)
    for (int i = 0; i <= tiles_x_; ++i)
      node_distance_[static_cast<size_t>(j) * static_cast<size_t>(tiles_x_ + 1) + static_cast<size_t>(i)] -=
          lowered_by(static_cast<float>(i * tile), static_cast<float>(j * tile));
  for (int ty = 0; ty < tiles_y_; ++ty)
    for (int tx = 0; tx < tiles_x_; ++tx) {
      const int32_t place = samples_of_[static_cast<size_t>(ty * tiles_x_ + tx)];
      if (place < 0) continue;
      Samples& samples = samples_[static_cast<size_t>(place)];
      for (int j = 0; j < nodes; ++j)
        for (int i = 0; i < nodes; ++i)
          samples[static_cast<size_t>(j * nodes + i)] -=
              lowered_by(static_cast<float>(tx * tile + i), static_cast<float>(ty * tile + j));
    }
}

float OutlineDistance::at(float x, float y) const {
  x = std::clamp(x, 0.0F, static_cast<float>(width_ - 1));
  y = std::clamp(y, 0.0F, static_cast<float>(height_ - 1));
  const auto ix = static_cast<int>(x), iy = static_cast<int>(y);
  const int tx = std::min(ix / tile, tiles_x_ - 1), ty = std::min(iy / tile, tiles_y_ - 1);
  const int32_t place = samples_of_[static_cast<size_t>(ty * tiles_x_ + tx)];
  const float* values;
  size_t stride;
  if (place >= 0) {
    const int i = std::min(ix - tx * tile, tile - 1), j = std::min(iy - ty * tile, tile - 1);
    values = samples_[static_cast<size_t>(place)].data() + j * nodes + i;
    stride = nodes;
    x -= static_cast<float>(tx * tile + i);
    y -= static_cast<float>(ty * tile + j);
  } else {
    stride = static_cast<size_t>(tiles_x_) + 1;
    values = node_distance_.data() + static_cast<size_t>(ty) * stride + static_cast<size_t>(tx);
    x = (x - static_cast<float>(tx * tile)) / tile;
    y = (y - static_cast<float>(ty * tile)) / tile;
  }
  const float top = values[0] + x * (values[1] - values[0]);
  const float bottom = values[stride] + x * (values[stride + 1] - values[stride]);
  return top + y * (bottom - top);
}

}  // namespace booth
