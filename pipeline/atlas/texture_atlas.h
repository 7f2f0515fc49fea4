#pragma once

#include <span>
#include <string>
#include <vector>

#include "pipeline/types/avatar.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

struct AtlasOptions {
  int size = 2048;  ///< width and height of the atlas, texels, 256 … 8192
};

struct TextureAtlas {
  Atlas atlas;
  double seen_share = 0;  ///< of the surface's area that at least one camera sees
  double used_share = 0;  ///< of the atlas's texels that lie in charts
  std::vector<std::string> warnings;
};

/// One view-independent texture, blended from every camera that sees a texel.
///
/// @param mesh         closed, world frame
/// @param frames       at most one a camera, RGB, distorted pixels; cameras without a silhouette are not used
/// @param silhouettes  of the same cameras
/// @error too_few_views  no frame with a silhouette of a camera in the rig
/// Source: R. Pagés, D. Berjón, F. Morán, N. García, "Seamless, static multi-texturing of 3D meshes",
/// Computer Graphics Forum 34(1), 2015.
Result<TextureAtlas> build_texture_atlas(const Mesh& mesh, const Rig& rig, std::span<const Frame> frames,
                                         std::span<const Silhouette> silhouettes, const AtlasOptions& options,
                                         const Work& work = {});

}  // namespace booth
