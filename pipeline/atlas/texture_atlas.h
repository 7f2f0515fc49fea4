#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/atlas/blending.h"
#include "pipeline/atlas/charting.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/avatar.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct AtlasOptions {
  int size = 2048;                                ///< width and height of the atlas, texels, 256 … 8192
  int gutter_texels = 4;                          ///< least distance between charts, 0 … 32
  Charting charting = Charting::flattening;       ///< unfolding is the paper's
  Inpainting inpainting = Inpainting::push_pull;  ///< Telea's is the paper's
  Blending blending = Blending::best_view;        ///< rating_mean is the paper's
  bool balance_colours = true;                    ///< removes differences of gain and white balance between cameras
};

struct TextureAtlas {
  Atlas atlas;
  double seen_share = 0;  ///< of the surface's area that at least one camera sees
  double used_share = 0;  ///< of the atlas's texels that lie in charts
  std::vector<std::string> warnings;
};

/// One view-independent texture, blended from every camera that sees a texel.
///
/// The surface is cut into charts and packed; every camera is rated at every vertex; texels
/// blend the cameras' colours in linear light. Where no camera looks, colours spread over the surface; unused
/// texels continue their surroundings, so that smaller mip levels do not bleed.
///
/// @param mesh         closed, world frame
/// @param frames       at most one a camera, grey or RGB, distorted pixels; cameras without a silhouette are not used
/// @param silhouettes  of the same cameras
/// @error invalid_argument  an option out of its range, a mesh that fails its check or is empty
/// @error too_few_views  no frame with a silhouette of a camera in the rig, or none that sees the surface
/// @error cancelled
/// Source: R. Pagés, D. Berjón, F. Morán, N. García, "Seamless, static multi-texturing of 3D meshes",
/// Computer Graphics Forum 34(1), 2015.
Result<TextureAtlas> build_texture_atlas(const Mesh& mesh, const Rig& rig, std::span<const Frame> frames,
                                         std::span<const Silhouette> silhouettes, const AtlasOptions& options,
                                         const Work& work = {});

}  // namespace booth
