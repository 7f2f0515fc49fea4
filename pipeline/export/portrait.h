#pragma once

#include <vector>

#include "pipeline/types/avatar.h"
#include "pipeline/types/image.h"
#include "pipeline/types/work.h"

namespace booth {

struct PortraitOptions {
  int width = 768;              ///< pixels, 1 … 8192
  int height = 1024;            ///< pixels, 1 … 8192
  double azimuth_rad = 0.35;    ///< where the viewer stands: 0 in front (+Z), positive towards the subject's left (+X)
  double elevation_rad = 0.05;  ///< above the horizon, −1.5 … 1.5
  int samples_per_axis = 3;     ///< samples a pixel, squared; 1 … 8
};

/// The whole avatar as a viewer would see it in perspective, framed with a small margin, on a transparent background.
/// The texture already holds the light of the booth; a dome of soft light with its shadows (ambient occlusion by ray
/// casting, once a vertex) is laid over it lightly, so that the shape can be read. Surfaces show from both sides.
///
/// @return RGBA, not premultiplied; black where nothing covers a pixel. Same bytes whatever the thread count
/// @pre check(avatar) holds
/// Cost: about 60 shadow rays a vertex, and one texture sample for each covered sample of the image.
Image render_portrait(const Avatar& avatar, const PortraitOptions& options, const Work& work = {});

struct TurntableOptions {
  int width = 360;           ///< pixels, 1 … 8192
  int height = 480;          ///< pixels, 1 … 8192
  int frames = 30;           ///< of one turn, 1 … 720
  double seconds = 4;        ///< that one turn takes, for whoever plays it
  int samples_per_axis = 2;  ///< samples a pixel, squared; 1 … 8
};

/// Pictures of the avatar going round once, as render_portrait makes them: the first from the front, then from its left
/// side. The avatar keeps its place and size. The light is even from all around, so that no side lies in the dark.
///
/// @return RGBA, one a frame
/// @pre check(avatar) holds
std::vector<Image> render_turntable(const Avatar& avatar, const TurntableOptions& options, const Work& work = {});

}  // namespace booth
