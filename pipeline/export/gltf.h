#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "pipeline/export/animation.h"
#include "pipeline/image/codec.h"
#include "pipeline/types/avatar.h"

namespace booth {

struct GltfOptions {
  std::string generator = "Avatar Booth";         ///< UTF-8
  ImageFormat texture_format = ImageFormat::png;  ///< how the texture is encoded
};

/// The avatar as a self-contained glTF 2.0 binary (GLB): metres, Y up, facing +Z as glTF wants it. Vertices are split
/// where the atlas has seams; the joints, their bind pose and the weights are the same as in write_collada.
/// Morph targets are sparse; their names are in the mesh's extras.targetNames, as importers have agreed.
/// @param clips    an animation each
/// @param texture  the atlas, encoded; embedded as it is
/// @pre check(avatar) holds
/// Source: The Khronos Group, "glTF 2.0 Specification", version 2.0.1, 2021 (ISO/IEC 12113:2022).
std::vector<uint8_t> write_glb(const Avatar& avatar, std::span<const AnimationClip> clips,
                               std::span<const uint8_t> texture, const GltfOptions& options);

}  // namespace booth
