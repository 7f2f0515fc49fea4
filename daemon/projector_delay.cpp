#include "daemon/projector_delay.h"

#include <fstream>
#include <nlohmann/json.hpp>

#include "replay/durable_folder.h"

namespace booth {
namespace {

constexpr int most_delay_us = 1'000'000;

}  // namespace

std::filesystem::path projector_delay_file(const std::filesystem::path& state_directory) {
  return state_directory / "calibration" / "projector.json";
}

std::optional<ProjectorDelay> read_projector_delay(const std::filesystem::path& file) {
  std::ifstream stream(file);
  const auto json = nlohmann::json::parse(stream, nullptr, false);
  if (!json.is_object()) return std::nullopt;
  const auto projector = json.find("projector"), delay_us = json.find("delay_us"), created = json.find("created");
  if (projector == json.end() || !projector->is_string() || delay_us == json.end() || !delay_us->is_number_unsigned() ||
      *delay_us > most_delay_us)
    return std::nullopt;
  return ProjectorDelay{projector->get<std::string>(), delay_us->get<int>(),
                        created != json.end() && created->is_string() ? created->get<std::string>() : ""};
}

Result<void> write_projector_delay(const std::filesystem::path& file, const ProjectorDelay& delay) {
  std::error_code code;
  std::filesystem::create_directories(file.parent_path(), code);
  if (code) return Error{ErrorCode::io, file.parent_path().string() + ": cannot be made: " + code.message()};
  const nlohmann::json json{{"projector", delay.projector}, {"delay_us", delay.delay_us}, {"created", delay.created}};
  return write_file_atomically(file, json.dump(2) + "\n");
}

}  // namespace booth
