#include "tests/quality/landmark_model.h"

#include <fstream>
#include <stdexcept>
#include <vector>

namespace booth::quality {

std::shared_ptr<const LandmarkPredictor> read_landmarks(const std::filesystem::path& file) {
  std::ifstream in(file, std::ios::binary | std::ios::ate);
  if (!in) return nullptr;
  std::vector<uint8_t> bytes(static_cast<size_t>(in.tellg()));
  in.seekg(0);
  in.read(reinterpret_cast<char*>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
  auto landmarks = read_dlib_landmarks(bytes);
  if (!in || !landmarks) throw std::runtime_error(file.string() + ": " + (in ? landmarks.error().message : "cut off"));
  return std::move(*landmarks);
}

}  // namespace booth::quality
