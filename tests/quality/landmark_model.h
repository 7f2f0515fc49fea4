#pragma once

#include <filesystem>
#include <memory>

#include "pipeline/face/landmark_predictor.h"

namespace booth::quality {

/// Where Debian's package libdlib-data has its predictor of landmarks.
inline constexpr const char* installed_landmark_model = "/usr/share/dlib/shape_predictor_68_face_landmarks.dat";

/// The predictor of a file; null where there is no such file. Throws std::runtime_error where it is no predictor.
std::shared_ptr<const LandmarkPredictor> read_landmarks(const std::filesystem::path& file = installed_landmark_model);

}  // namespace booth::quality
