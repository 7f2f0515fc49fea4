#include "tests/quality/truth.h"

#include <cstdlib>
#include <fstream>
#include <nlohmann/json.hpp>
#include <vector>

#include "pipeline/image/codec.h"

namespace booth::quality {
namespace {

namespace fs = std::filesystem;

std::vector<uint8_t> bytes_of(const fs::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

CalibratedView view_of(const nlohmann::json& json) {
  CalibratedView view;
  view.intrinsics.width = json.at("width");
  view.intrinsics.height = json.at("height");
  view.intrinsics.fx = json.at("K")[0][0];
  view.intrinsics.fy = json.at("K")[1][1];
  view.intrinsics.cx = json.at("K")[0][2];
  view.intrinsics.cy = json.at("K")[1][2];
  for (size_t i = 0; i < 5; ++i) view.intrinsics.distortion[i] = json.at("distortion")[i];
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column)
      view.camera_from_world.linear()(row, column) =
          json.at("R")[static_cast<size_t>(row)][static_cast<size_t>(column)];
    view.camera_from_world.translation()[row] = json.at("t")[static_cast<size_t>(row)];
  }
  return view;
}

}  // namespace

std::optional<fs::path> find_recording(const std::string& name) {
  fs::path folder = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings" / name;
  if (const char* larger = std::getenv("BOOTH_RECORDINGS"); !fs::exists(folder) && larger != nullptr && *larger != 0)
    folder = fs::path(larger) / name;
  return fs::exists(folder / "truth") ? std::optional(folder) : std::nullopt;
}

std::map<std::string, Eigen::Vector3d> read_joints(const fs::path& file) {
  std::map<std::string, Eigen::Vector3d> joints;
  const nlohmann::json json = nlohmann::json::parse(bytes_of(file));
  for (const auto& [name, p] : json.items())
    joints[name] = Eigen::Vector3d(p[0].get<double>(), p[1].get<double>(), p[2].get<double>());
  return joints;
}

Image read_image(const fs::path& file) { return decode_image(bytes_of(file)).value(); }

std::vector<HeldOutView> read_held_out_views(const fs::path& recording) {
  const fs::path folder = recording / "truth/views";
  if (!fs::exists(folder / "views.json")) return {};
  const nlohmann::json json = nlohmann::json::parse(bytes_of(folder / "views.json"));
  std::vector<HeldOutView> views;
  for (const nlohmann::json& view : json.at("views"))
    views.push_back({view.at("id"), view_of(view), read_image(folder / view.at("file").get<std::string>()),
                     json.at("background_rgb")});
  return views;
}

}  // namespace booth::quality
