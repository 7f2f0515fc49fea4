#pragma once

#include <filesystem>
#include <vector>

#include "pipeline/hull/rig_correction.h"
#include "pipeline/types/result.h"
#include "pipeline/types/work.h"

namespace booth {

struct OfflineCorrectionOptions {
  std::vector<std::filesystem::path> recordings;  ///< of people, all by the same rig
  std::filesystem::path out;                      ///< the folder to make; an empty one may be there
};

/// Proposes where cameras are that were moved since their calibration, from what the booth captured: see
/// pipeline/hull/rig_correction.h.
///
/// Writes OUT/report.html and OUT/correction.json (the figures) and, when a correction is needed, OUT/rig.json, the
/// rig with it; all or nothing. Whether the background of each camera has shifted since it was learned is told along,
/// as a second witness.
/// @error as read_recording, segment and correct_rig; invalid_argument  recordings of different calibrations;
///        not_found  one holds no body shot; invalid_state  OUT holds something; disk_full, io
Result<RigCorrection> correct_from_recordings(const OfflineCorrectionOptions& options, const Work& work = {});

}  // namespace booth
