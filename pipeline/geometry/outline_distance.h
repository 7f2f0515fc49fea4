#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/types/image.h"

namespace booth {

/// Signed distance, in pixels, to the outline of a silhouette: negative where the subject is. The outline is the
/// 127.5 level of the coverage, joined between pixel centres by straight pieces (marching squares), so it is known
/// to a fraction of a pixel. Near the outline the distance is exact at every pixel centre; farther off it is
/// exact every eighth pixel, and linear in between.
///
/// Where the subject is cut off by the image's border, nobody knows how the outline goes on outside. There the
/// distance is lowered, the more the closer to the cut, so that a solid carved with it fades into the part
/// that this camera does not see instead of ending in a plane along the edge of its view.
class OutlineDistance {
 public:
  /// @param coverage   1 channel, 255 = subject
  /// @param feather_px  how far from the cut the distance is lowered: by as much at the cut itself, to nothing there
  OutlineDistance(const Image& coverage, double feather_px);

  enum class Content { outline, all_subject, no_subject };
  Content content() const { return content_; }

  /// The distance at (x, y), −0.5 ≤ x < width − 0.5, likewise y; bilinear between pixel centres.
  float at(float x, float y) const;

  /// The distance changes by at most this per pixel.
  double slope() const { return slope_; }

 private:
  struct Segment {
    float x0, y0, x1, y1;
  };
  static constexpr int tile = 8;          ///< pixels along a tile's side
  static constexpr int nodes = tile + 1;  ///< samples along it, the next tile's first included
  using Samples = std::array<float, static_cast<size_t>(nodes) * nodes>;

  void find_outline(const Image& coverage);
  void spread(const Image& coverage);
  void refine(const Image& coverage);
  void feather(const Image& coverage, double feather_px);

  int width_ = 0, height_ = 0;
  int tiles_x_ = 0, tiles_y_ = 0;
  double slope_ = 1;
  Content content_ = Content::no_subject;
  std::vector<Segment> segments_;        ///< by tile
  std::vector<uint32_t> first_segment_;  ///< of a tile; one more at the end
  std::vector<float> node_distance_;     ///< at the tiles' corners
  std::vector<int32_t> samples_of_;      ///< by tile: its place in samples_, or -1
  std::vector<Samples> samples_;
};

}  // namespace booth
