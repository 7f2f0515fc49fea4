#pragma once

#include <string>
#include <vector>

#include "pipeline/types/image.h"

namespace booth {

/// What a camera sees without a subject, learned from one or more frames of the empty booth: it takes their place, so
/// that it can be kept and used for one capture after the other.
struct EmptyView {
  std::string camera;
  Image mean;                  ///< of the frames, rounded; 8-bit grey or RGB, distorted pixels
  std::vector<float> flicker;  ///< variance between the frames by cell of segmentation's grid, level²; of one: empty
};

}  // namespace booth
