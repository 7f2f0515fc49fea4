#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"

namespace booth::quality {

/// A recording's folder: the small one of the repository, or one of the larger in the folder that BOOTH_RECORDINGS
/// names. Nothing where it is not there or has no truth.
std::optional<std::filesystem::path> find_recording(const std::string& name);

/// Joints by the truth's names, world frame, metres.
std::map<std::string, Eigen::Vector3d> read_joints(const std::filesystem::path& file);

Image read_image(const std::filesystem::path& file);

/// A photograph that no camera of the rig took.
struct HeldOutView {
  std::string id;
  CalibratedView camera;
  Image photograph;
  std::array<uint8_t, 3> background{};  ///< behind the subject
};
/// Those of a recording's folder; none where it has none.
std::vector<HeldOutView> read_held_out_views(const std::filesystem::path& recording);

}  // namespace booth::quality
