#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "pipeline/types/avatar.h"

namespace booth {

struct GltfOptions {
  std::string generator = "Avatar Booth";
};

/// The avatar as a self-contained glTF 2.0 binary (GLB).
/// @param texture_png  the atlas, encoded; embedded as it is
/// @pre check(avatar) holds
std::vector<uint8_t> write_glb(const Avatar& avatar, std::span<const uint8_t> texture_png, const GltfOptions& options);

}  // namespace booth
