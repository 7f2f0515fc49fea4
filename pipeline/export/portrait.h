#pragma once

#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

struct PortraitOptions {
  int width = 768;
  int height = 1024;
  double azimuth_rad = 0.35;    ///< where the viewer stands: 0 in front (+Z), positive towards the subject's left (+X)
  double elevation_rad = 0.05;  ///< above the horizon
  int samples_per_axis = 3;     ///< rays a pixel, squared
};

/// The whole avatar as a viewer would see it, framed with a small margin, softly lit, on a transparent background.
/// @return RGBA, not premultiplied
Image render_portrait(const Avatar& avatar, const PortraitOptions& options, const Work& work = {});

}  // namespace booth
