#pragma once

#include <filesystem>
#include <optional>
#include <string>

#include "pipeline/types/result.h"

namespace booth {

/// The delay that was measured for a projector, in a file that outlives the service.
struct ProjectorDelay {
  std::string projector;     ///< its id: another one's delay does not hold
  int delay_us = 0;          ///< 0 … 1'000'000
  std::string created = {};  ///< ISO 8601, UTC
};

/// Where a booth keeps it.
std::filesystem::path projector_delay_file(const std::filesystem::path& state_directory);

/// @return nothing where none was measured, or the file is not one
std::optional<ProjectorDelay> read_projector_delay(const std::filesystem::path& file);
/// Whole or not at all. @error io, disk_full
Result<void> write_projector_delay(const std::filesystem::path& file, const ProjectorDelay& delay);

}  // namespace booth
