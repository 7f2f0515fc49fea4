#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "pipeline/export/metadata.h"
#include "pipeline/export/portrait.h"
#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

struct NamedBytes {
  std::string name;
  std::vector<uint8_t> bytes;
};

struct AvatarFileOptions {
  int texture_png_level = 4;  ///< zlib's, 0 … 9: larger makes smaller files, slower
  PortraitOptions portrait;
};

/// The files of an avatar's folder, ready to be written: avatar.dae, texture.png, avatar.glb, preview.png and, last,
/// metadata.json.
///
/// @param metadata  its triangles, joints and files are filled in here; the rest goes into metadata.json as it is
/// @pre check(avatar) holds
std::vector<NamedBytes> make_avatar_files(const Avatar& avatar, AvatarMetadata metadata,
                                          const AvatarFileOptions& options, const Work& work = {});

}  // namespace booth
