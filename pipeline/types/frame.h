#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "pipeline/types/image.h"

namespace booth {

/// Nanoseconds on the booth's one monotonic clock.
using Timestamp = int64_t;

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
};

/// The frames of one trigger, at most one per camera. A missing camera is normal data, not an error.
struct FrameSet {
  int index = 0;
  std::vector<Frame> frames;
};

}  // namespace booth
