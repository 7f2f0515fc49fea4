#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/structured_light/structured_light.h"
#include "tests/quality/face_truth.h"

namespace booth::quality {

/// A recording's face scan with what it should have found.
struct FaceRecording {
  Rig rig;
  GrayCodeCapture capture;
  Eigen::AlignedBox3d region;  ///< around the true head
  FaceTruth truth;
};
FaceRecording read_face_recording(const std::filesystem::path& folder, const Work& work = {});

/// What can go wrong, with the images in which it did.
struct FaceFault {
  std::string name;
  GrayCodeCapture capture;
  FaceTruth truth;  ///< where the face was when the finest column bit was shown, to which scans of a sway belong
};
/// As booths see them: noise, light of the room, images lost and shown twice, a subject that sways.
/// @param clean  the scan of the recording as it is
std::vector<FaceFault> face_faults(const FaceRecording& recording, const RangeScan& clean);

}  // namespace booth::quality
