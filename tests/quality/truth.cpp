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

}  // namespace booth::quality
