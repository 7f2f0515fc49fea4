#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "pipeline/export/mesh_files.h"
#include "pipeline/export/metadata.h"
#include "pipeline/export/portrait.h"
#include "pipeline/image/codec.h"
#include "pipeline/types/avatar.h"
#include "pipeline/types/work.h"

namespace booth {

struct NamedBytes {
  std::string name;
  std::vector<uint8_t> bytes;
};

struct AvatarFileOptions {
  ImageFormat texture = ImageFormat::png;  ///< of the atlas: texture.png, or texture.jpg, a fraction of its size
  int texture_png_level = 1;               ///< zlib's, 0 … 9: 6 makes a file 8 % smaller, in four times the time
  int jpeg_quality = 92;                   ///< 1 … 100
  bool animation = false;                  ///< two clips in avatar.dae and avatar.glb, see make_clips
  bool collada_morphs = false;             ///< facial expressions in avatar.dae too, see write_collada
  bool turntable = false;                  ///< turntable.webp besides
  std::vector<MeshFormat> formats;         ///< avatar.stl, avatar.obj with avatar.mtl, avatar.ply besides
  PortraitOptions portrait;
  TurntableOptions turning;
};

/// The files of an avatar's folder, ready to be written: avatar.dae, texture.png or .jpg, avatar.glb, preview.png, what
/// else the options ask for and, last, metadata.json.
///
/// @param metadata  its triangles, joints and files are filled in here; the rest goes into metadata.json as it is
/// @pre check(avatar) holds
std::vector<NamedBytes> make_avatar_files(const Avatar& avatar, AvatarMetadata metadata,
                                          const AvatarFileOptions& options, const Work& work = {});

}  // namespace booth
