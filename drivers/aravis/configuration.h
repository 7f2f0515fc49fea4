#pragma once

#include <optional>
#include <string>

#include "drivers/aravis/aravis_settings.h"
#include "drivers/aravis/features.h"
#include "pipeline/types/frame.h"

namespace booth {

/// What a configured camera delivers.
struct AravisPicture {
  int width = 0, height = 0, channels = 1;
  std::optional<Mosaic> mosaic;
};

/// Applies everything but packet sizes and what belongs to the receiving stream, in the order in which features depend
/// on each other (SFNC 2.7: device, transport, image format, acquisition, analog, trigger, own features), and reads it
/// back. Acquisition must not be under way.
/// @param action  keys of a camera that is triggered by action commands
/// @error as Features
Result<AravisPicture> apply_settings(const Features& features, const AravisCameraSettings& settings,
                                     const AravisActionSettings& action);

/// @error as Features
Result<void> apply_exposure(const Features& features, double exposure_us);
/// @error as Features
Result<void> apply_gain(const Features& features, double gain_db);
/// One frame for each trigger.
/// @error as Features
Result<void> apply_triggered(const Features& features, const AravisCameraSettings& settings);
/// Frames as they come, as often as settings.preview_fps says, or as the camera can where that is less.
/// @error as Features
Result<void> apply_free_running(const Features& features, const AravisCameraSettings& settings);

/// What the camera has, as its features are called: ExposureTime or, before SFNC 2.0, ExposureTimeAbs.
const char* exposure_feature(const Features& features);

}  // namespace booth
