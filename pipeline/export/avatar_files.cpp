#include "pipeline/export/avatar_files.h"

#include <algorithm>
#include <functional>
#include <string>
#include <utility>

#include "pipeline/export/animation.h"
#include "pipeline/export/collada.h"
#include "pipeline/export/gltf.h"
#include "pipeline/export/sha256.h"
#include "pipeline/image/webp.h"

namespace booth {
namespace {

std::vector<uint8_t> to_bytes(const std::string& text) { return {text.begin(), text.end()}; }

/// A file and how it is made.
struct PlannedFile {
  std::string name;
  std::function<std::vector<uint8_t>()> make;
};

std::vector<uint8_t> make_turntable(const Avatar& avatar, const TurntableOptions& options) {
  constexpr int quality = 80;
  const std::vector<Image> frames = render_turntable(avatar, options);
  return encode_webp_animation(frames, options.seconds / static_cast<double>(frames.size()), quality);
}

void plan_mesh_files(const Avatar& avatar, const std::vector<MeshFormat>& formats, const std::string& texture,
                     std::vector<PlannedFile>& plan) {
  for (const MeshFormat format : formats) switch (format) {
      case MeshFormat::stl: plan.push_back({"avatar.stl", [&] { return write_stl(avatar); }}); break;
      case MeshFormat::ply: plan.push_back({"avatar.ply", [&] { return write_ply(avatar); }}); break;
      case MeshFormat::obj:
        plan.push_back({"avatar.obj", [&] { return to_bytes(write_obj(avatar, "avatar.mtl")); }});
        plan.push_back({"avatar.mtl", [&] { return to_bytes(write_obj_material(texture)); }});
        break;
    }
}

}  // namespace

std::vector<NamedBytes> make_avatar_files(const Avatar& avatar, AvatarMetadata metadata,
                                          const AvatarFileOptions& options, const Work& work) {
  metadata.triangles = avatar.mesh.triangles.size();
  metadata.joints = avatar.skeleton.joints.size();
  const std::string tool = "Avatar Booth " + metadata.software_version;
  const bool as_png = options.texture == ImageFormat::png;
  const std::string texture = as_png ? "texture.png" : "texture.jpg";
  std::vector<AnimationClip> clips;
  if (options.animation) clips = make_clips(avatar.skeleton);

  // The longest first, so that the others fill the remaining threads.
  std::vector<PlannedFile> plan;
  if (options.turntable) plan.push_back({"turntable.webp", [&] { return make_turntable(avatar, options.turning); }});
  const size_t texture_at = plan.size();
  plan.push_back({texture, [&] {
                    return as_png ? encode_png(avatar.atlas.image, options.texture_png_level)
                                  : encode_jpeg(avatar.atlas.image, options.jpeg_quality);
                  }});
  plan.push_back({"preview.png", [&] { return encode_png(render_portrait(avatar, options.portrait)); }});
  plan.push_back({"avatar.dae", [&] {
                    return to_bytes(write_collada(avatar, clips,
                                                  {.texture_file = texture,
                                                   .created = metadata.created,
                                                   .authoring_tool = tool,
                                                   .morphs = options.collada_morphs}));
                  }});
  plan_mesh_files(avatar, options.formats, texture, plan);

  std::vector<NamedBytes> files(plan.size());
  work.parallel_for(plan.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) files[i] = {plan[i].name, plan[i].make()};
  });
  files.push_back({"avatar.glb", write_glb(avatar, clips, files[texture_at].bytes,
                                           {.generator = tool, .texture_format = options.texture})});
  metadata.files.resize(files.size());
  work.parallel_for(files.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i)
      metadata.files[i] = {files[i].name, files[i].bytes.size(), sha256_hex(files[i].bytes)};
  });
  files.push_back({"metadata.json", to_bytes(write_metadata(metadata))});
  return files;
}

}  // namespace booth
