#pragma once

#include <string>

#include "pipeline/types/image.h"

namespace booth {

/// Where one camera sees the subject: an 8-bit coverage the size of the camera's image, in distorted pixels as
/// captured. 255 = subject, 0 = background, between them the share of the pixel that the subject covers, so the
/// 127.5 level is the outline to a fraction of a pixel.
struct Silhouette {
  std::string camera;
  Image coverage;  ///< 1 channel
};

}  // namespace booth
