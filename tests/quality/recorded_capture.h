#pragma once

#include <filesystem>
#include <vector>

#include "pipeline/types/empty_view.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth::quality {

/// A recording's body shot with what segmentation makes of it.
struct RecordedCapture {
  Rig rig;
  std::vector<Frame> frames;            ///< of the body shot
  std::vector<EmptyView> background;    ///< of the empty booth, by frame
  std::vector<Silhouette> silhouettes;  ///< by frame
};

/// @pre the recording is whole and somebody is in it
RecordedCapture load_capture(const std::filesystem::path& recording, const Work& work);

}  // namespace booth::quality
