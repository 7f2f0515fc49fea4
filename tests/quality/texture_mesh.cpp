// texture_mesh RECORDING MESH.ply OUT_DIR [best_view|blend|full|align]
//
// Textures a given mesh from a recording's photographs and writes it as an avatar without joints. With the truth's
// mesh it shows what the texturing alone reaches, free of the reconstruction's errors of shape; with one mesh and
// several methods it compares the methods. The mesh stays as it is, unless "align" asks for the whole of the full
// method, which moves its vertices.

#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/atlas/texture_atlas.h"
#include "pipeline/export/avatar_files.h"
#include "pipeline/segmentation/segmentation.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/measures.h"

namespace booth::quality {
namespace {

template <class T>
T must(Result<T> result) {
  if (!result) throw std::runtime_error(result.error().message);
  return std::move(*result);
}

std::vector<Silhouette> silhouettes_of(std::span<const FrameSet> background, const FrameSet& body, const Work& work) {
  std::vector<Silhouette> silhouettes(body.frames.size());
  work.parallel_for(silhouettes.size(), 1, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; ++i) {
      std::vector<Frame> empty;
      for (const FrameSet& set : background)
        for (const Frame& frame : set.frames)
          if (frame.camera == body.frames[i].camera) empty.push_back(frame);
      silhouettes[i] = must(segment(empty, body.frames[i], {})).silhouette;
    }
  });
  return silhouettes;
}

void run(const std::filesystem::path& folder, const std::filesystem::path& mesh, const std::filesystem::path& out,
         TextureMethod method, bool align) {
  ThreadPool pool;
  const Work work = pool.work();
  const Recording recording = must(read_recording(folder));
  const LoadedShot background = load_shot(recording, *recording.find(ShotRole::background), work);
  const LoadedShot body = load_shot(recording, *recording.find(ShotRole::body), work);
  const std::vector<Silhouette> silhouettes = silhouettes_of(background.sets, body.sets.at(0), work);

  AtlasOptions options;
  options.method = method;
  options.align_surface = align;
  Avatar avatar;
  avatar.mesh = read_ply(mesh);
  TextureAtlas textured =
      must(build_texture_atlas(avatar.mesh, recording.rig, body.sets[0].frames, silhouettes, options, work));
  for (const std::string& warning : textured.warnings) std::cerr << "warning: " << warning << "\n";
  avatar.atlas = std::move(textured.atlas);
  avatar.mesh.positions = std::move(textured.positions);
  std::filesystem::create_directories(out);
  for (const NamedBytes& file : make_avatar_files(avatar, {}, {}, work))
    std::ofstream(out / file.name, std::ios::binary)
        .write(reinterpret_cast<const char*>(file.bytes.data()), static_cast<std::streamsize>(file.bytes.size()));
}

}  // namespace
}  // namespace booth::quality

int main(int argc, char** argv) {
  const bool align = argc > 4 && std::string(argv[4]) == "align";
  const auto method = booth::texture_method_from(argc > 4 && !align ? argv[4] : "full");
  if (argc < 4 || argc > 5 || !method) {
    std::cerr << "usage: texture_mesh RECORDING MESH.ply OUT_DIR [best_view|blend|full|align]\n";
    return 2;
  }
  try {
    booth::quality::run(argv[1], argv[2], argv[3], *method, align);
  } catch (const std::exception& e) {
    std::cerr << "texture_mesh: " << e.what() << "\n";
    return 1;
  }
}
