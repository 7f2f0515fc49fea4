#pragma once

#include <Eigen/Core>
#include <filesystem>
#include <map>
#include <optional>
#include <string>

#include "pipeline/types/image.h"

namespace booth::quality {

/// A recording's folder: the small one of the repository, or one of the larger in the folder that BOOTH_RECORDINGS
/// names. Nothing where it is not there or has no truth.
std::optional<std::filesystem::path> find_recording(const std::string& name);

/// Joints by the truth's names, world frame, metres.
std::map<std::string, Eigen::Vector3d> read_joints(const std::filesystem::path& file);

Image read_image(const std::filesystem::path& file);

}  // namespace booth::quality
