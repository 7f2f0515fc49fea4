#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "pipeline/types/image.h"

namespace booth {

/// Nanoseconds on the booth's one monotonic clock.
using Timestamp = int64_t;

/// The colours of a mosaic's top-left 2 × 2 pixels, in reading order.
enum class BayerPattern { rggb, grbg, gbrg, bggr };

/// Every pattern with its name in recording.json.
inline constexpr std::array<std::pair<BayerPattern, std::string_view>, 4> bayer_patterns{
    {{BayerPattern::rggb, "rggb"},
     {BayerPattern::grbg, "grbg"},
     {BayerPattern::gbrg, "gbrg"},
     {BayerPattern::bggr, "bggr"}}};

/// What the samples of a raw frame are: one colour a pixel, to be developed into an image.
struct Mosaic {
  BayerPattern pattern = BayerPattern::rggb;
  bool linear = true;  ///< samples are proportional to light; otherwise they are encoded as sRGB

  bool operator==(const Mosaic&) const = default;
};

/// One image of one camera. Pixels are distorted and turned as the camera delivered them, and never change
/// after delivery.
struct Frame {
  std::string camera;
  int index = 0;  ///< step within a sequence; frames of one shot with the same index were triggered together
  Timestamp timestamp_ns = 0;
  uint64_t frame_id = 0;
  double exposure_us = 0;
  double gain_db = 0;
  std::shared_ptr<const Image> pixels;  ///< grey or RGB; never null in a delivered frame
  /// The PNG or JPEG that the pixels were decoded from, where the camera delivered one; otherwise null.
  std::shared_ptr<const std::vector<uint8_t>> encoded = {};
  /// Of a frame that is raw: its pixels are grey only as stored, see develop().
  std::optional<Mosaic> mosaic = {};
};

/// The frames of one trigger, at most one per camera. A missing camera is normal data, not an error.
struct FrameSet {
  int index = 0;
  std::vector<Frame> frames;
};

}  // namespace booth
