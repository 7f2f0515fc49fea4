#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/calibration/calibration.h"
#include "pipeline/types/result.h"
#include "pipeline/types/work.h"

namespace booth {

struct OfflineCalibrationOptions {
  std::vector<std::filesystem::path> recordings;  ///< of the same rig; poses of the board add up
  std::filesystem::path out;                      ///< the folder to make; an empty one may be there
  std::optional<int> floor_index;  ///< in the first recording's board shot: the board lies on the floor there
  bool keep_unseen = false;        ///< devices that never saw the board keep the calibration that they had
  bool nominal = false;            ///< the recordings' own rigs tell nothing but which devices there are
  std::optional<Rig> previous;     ///< with `nominal`, the calibration that there was; else the first recording's holds
  CalibrationOptions solver;
};

/// Solves a rig from the board shots of recordings.
///
/// A board shot named "floor" shows the board lying on the floor, which gives the world frame; without one, and without
/// floor_index, the rig is put where the first recording's lies. A Gray-code shot named "board-N" was taken of the
/// board resting as in index N of the recording's first board shot: with such shots the projector is solved along.
///
/// Writes OUT/rig.json, OUT/report.html and OUT/calibration.json (verdict and figures), all or nothing.
/// @error as read_recording, find_board and solve_calibration; invalid_argument  boards or cameras that differ between
///        recordings; not_found  none holds a board shot; invalid_state  OUT holds something; disk_full, io
Result<Calibration> calibrate_recordings(const OfflineCalibrationOptions& options, const Work& work = {});

}  // namespace booth
