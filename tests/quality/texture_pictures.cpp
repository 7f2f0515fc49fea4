// texture_pictures RECORDING MESH.ply VIEW LEFT TOP WIDTH HEIGHT OUT.jpg
//
// Side by side, part of a photograph that no camera of the rig took (the recording's truth has some) and the same view
// of the mesh, textured by the methods best_view, blend and full: replay/pictures/textures.jpg is made by it.

#include <algorithm>
#include <exception>
#include <iostream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/atlas/texture_atlas.h"
#include "pipeline/thread_pool.h"
#include "tests/quality/measures.h"
#include "tests/quality/panels.h"
#include "tests/quality/recorded_capture.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

void run(const std::string& recording, const std::string& mesh, const std::string& id, const Window& window,
         const std::string& out) {
  const std::vector<HeldOutView> views = read_held_out_views(recording);
  const auto view = std::find_if(views.begin(), views.end(), [&](const HeldOutView& v) { return v.id == id; });
  if (view == views.end()) throw std::runtime_error("the recording's truth has no view " + id);
  ThreadPool pool;
  const Work work = pool.work();
  const RecordedCapture capture = load_capture(recording, work);
  Avatar avatar;
  avatar.mesh = read_ply(mesh);
  const RayCaster caster(avatar.mesh);
  std::vector<Image> panels{part_of(view->photograph, window)};
  for (const TextureMethod method : {TextureMethod::best_view, TextureMethod::blend, TextureMethod::full}) {
    auto textured = build_texture_atlas(avatar.mesh, capture.rig, capture.frames, capture.silhouettes,
                                        {.method = method, .align_surface = false}, work);
    if (!textured) throw std::runtime_error(textured.error().message);
    avatar.atlas = std::move(textured->atlas);
    panels.push_back(render_view(caster, avatar, view->camera, window, view->background));
  }
  write_jpeg(in_rows({panels}), out);
}

}  // namespace
}  // namespace booth::quality

int main(int argc, char** argv) {
  if (argc != 9) {
    std::cerr << "usage: texture_pictures RECORDING MESH.ply VIEW LEFT TOP WIDTH HEIGHT OUT.jpg\n";
    return 2;
  }
  try {
    booth::quality::run(argv[1], argv[2], argv[3],
                        {std::stoi(argv[4]), std::stoi(argv[5]), std::stoi(argv[6]), std::stoi(argv[7])}, argv[8]);
  } catch (const std::exception& e) {
    std::cerr << "texture_pictures: " << e.what() << "\n";
    return 1;
  }
}
