#include "pipeline/export/avatar_files.h"

#include <array>
#include <functional>
#include <utility>

#include "pipeline/export/collada.h"
#include "pipeline/export/gltf.h"
#include "pipeline/export/sha256.h"
#include "pipeline/image/codec.h"

namespace booth {
namespace {

std::vector<uint8_t> to_bytes(const std::string& text) { return {text.begin(), text.end()}; }

}  // namespace

std::vector<NamedBytes> make_avatar_files(const Avatar& avatar, AvatarMetadata metadata,
                                          const AvatarFileOptions& options, const Work& work) {
  metadata.triangles = avatar.mesh.triangles.size();
  metadata.joints = avatar.skeleton.joints.size();
  const std::string tool = "Avatar Booth " + metadata.software_version;
  ColladaOptions collada{.texture_file = "texture.png", .created = metadata.created, .authoring_tool = tool};

  NamedBytes dae{"avatar.dae", {}}, texture{collada.texture_file, {}}, glb{"avatar.glb", {}},
      preview{"preview.png", {}};
  // The longest first, so that the others fill the remaining threads.
  const std::array<std::function<void()>, 3> independent{
      [&] { texture.bytes = encode_png(avatar.atlas.image, options.texture_png_level); },
      [&] { preview.bytes = encode_png(render_portrait(avatar, options.portrait)); },
      [&] { dae.bytes = to_bytes(write_collada(avatar, collada)); }};
  work.parallel_for(independent.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) independent[i]();
  });
  glb.bytes = write_glb(avatar, texture.bytes, {.generator = tool});

  std::vector<NamedBytes> files;
  for (NamedBytes* file : {&dae, &texture, &glb, &preview}) files.push_back(std::move(*file));
  metadata.files.resize(files.size());
  work.parallel_for(files.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      metadata.files[i] = {files[i].name, files[i].bytes.size(), sha256_hex(files[i].bytes)};
  });
  files.push_back({"metadata.json", to_bytes(write_metadata(metadata))});
  return files;
}

}  // namespace booth
