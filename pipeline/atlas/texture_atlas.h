#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/atlas/charting.h"
#include "pipeline/atlas/input_preparation.h"
#include "pipeline/types/avatar.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/silhouette.h"
#include "pipeline/types/work.h"

namespace booth {

/// How the photographs become one texture.
enum class TextureMethod {
  /// Each triangle from its best camera, as it is: what blending is compared with. Nothing evens out the cameras'
  /// gains, for showing what they do is what it is for.
  best_view,
  /// The method of Pagés et al. 2015: the mean of all cameras that see a texel, weighted by their ratings, from inputs
  /// that were eroded and in-painted by Telea's method.
  blend,
  /// Colours balanced, pictures laid over each other where the true surface is, two bands, seams levelled.
  full
};

std::string_view to_string(TextureMethod method);
/// "best_view", "blend" or "full".
std::optional<TextureMethod> texture_method_from(std::string_view name);

struct AtlasOptions {
  int size = 2048;                           ///< width and height of the atlas, texels, 256 … 8192
  int gutter_texels = 4;                     ///< least distance between charts, 0 … 32
  Charting charting = Charting::flattening;  ///< unfolding is the paper's
  TextureMethod method = TextureMethod::full;
  bool balance_colours = true;  ///< of `full`: removes differences of gain and white balance between cameras
  bool align_surface = true;    ///< of `full`: moves vertices to where the cameras agree on what is there
  bool align_views = true;      ///< of `full`: lays pictures over each other where they still disagree
};

struct TextureAtlas {
  Atlas atlas;
  std::vector<Eigen::Vector3f> positions;  ///< the mesh's vertices, moved along their normals by up to two centimetres
  double seen_share = 0;                   ///< of the surface's area that at least one camera sees
  double used_share = 0;                   ///< of the atlas's texels that lie in charts
  std::vector<std::string> warnings;
};

/// One view-independent texture, blended from every camera that sees a texel.
///
/// The surface is cut into charts and packed; every camera is rated at every vertex; texels
/// blend the cameras' colours in linear light. Where no camera looks, colours spread over the surface; unused
/// texels continue their surroundings, so that smaller mip levels do not bleed. See TextureMethod for what the
/// methods do.
///
/// @param mesh         closed, world frame
/// @param frames       at most one a camera, grey or RGB, distorted pixels; cameras without a silhouette are not used
/// @param silhouettes  of the same cameras
/// @param exact        one a vertex, not 0 where it is known to be right and is not moved; empty: none
/// @error invalid_argument  an option out of its range, a mesh that fails its check or is empty
/// @error too_few_views  no frame with a silhouette of a camera in the rig, or none that sees the surface
/// @error cancelled
/// Source: R. Pagés, D. Berjón, F. Morán, N. García, "Seamless, static multi-texturing of 3D meshes",
/// Computer Graphics Forum 34(1), 2015.
Result<TextureAtlas> build_texture_atlas(const Mesh& mesh, const Rig& rig, std::span<const Frame> frames,
                                         std::span<const Silhouette> silhouettes, const AtlasOptions& options,
                                         const Work& work = {}, std::span<const uint8_t> exact = {});

}  // namespace booth
