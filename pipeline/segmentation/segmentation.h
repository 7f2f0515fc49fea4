#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/types/frame.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct SegmentationOptions {};

struct Segmentation {
  Silhouette silhouette;
  double subject_share = 0;            ///< of the image's area
  std::vector<std::string> warnings;   ///< what an operator should know, naming the camera
};

/// Separates the subject from the background that the same camera saw in the empty booth.
///
/// @param background  one or more frames of the empty booth, same camera and size as `body`
/// @error no_background     `background` is empty or of another size
/// @error no_subject        nothing in the frame differs from the background
Result<Segmentation> segment(std::span<const Frame> background, const Frame& body, const SegmentationOptions& options,
                             const Work& work = {});

}  // namespace booth
