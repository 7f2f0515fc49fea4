#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/frame.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"
#include "pipeline/types/work.h"

namespace booth {

/// One image of a recording, before it is decoded.
struct FrameRecord {
  std::string camera;
  int index = 0;
  std::string file;  ///< relative to the recording's folder
  Timestamp timestamp_ns = 0;
  uint64_t frame_id = 0;
  double exposure_us = 0;
  double gain_db = 0;
  std::optional<Mosaic> mosaic = {};  ///< of a raw frame
};

struct Shot {
  std::string name;  ///< file-name safe
  ShotRole role = ShotRole::body;
  std::optional<GrayCodePattern> pattern;  ///< of a gray_code shot
  std::optional<CalibrationBoard> board;   ///< of a calibration_board shot
  std::vector<FrameRecord> frames;
};

/// What a capture left on disk, as recording.json and rig.json say it. Shots of unknown roles are left out.
struct Recording {
  std::filesystem::path folder;
  std::string id;
  std::string created;  ///< ISO 8601, UTC
  std::string label;    ///< who or what it shows, as the front end named it; may be empty
  std::string face;     ///< how the capture asked for the face ("auto", …); may be empty
  Rig rig;
  std::vector<Shot> shots;

  /// The first shot of that role, or nullptr.
  const Shot* find(ShotRole role) const;
};

/// Reads recording.json and rig.json; decodes no image.
///
/// @error not_found     no such folder, or no recording.json in it
/// @error invalid_file  one sentence that names the file and the field: not JSON, an unknown version, a missing or
///                      ill-typed field, an unsafe path, a frame of a camera that the rig does not have,
///                      two frames for one camera, shot and index
Result<Recording> read_recording(const std::filesystem::path& folder);

/// rig.json alone. @error as above
Result<Rig> read_rig(const std::filesystem::path& file);

/// rig.json's text. read_rig gives every number back bit by bit.
/// @pre check(rig) holds
std::string write_rig_json(const Rig& rig);

/// The decoded frames of one shot, by index, and a sentence for each that could not be used.
struct LoadedShot {
  std::vector<FrameSet> sets;  ///< ascending index
  std::vector<std::string> faults;
};

/// Decodes a shot's images. A missing, damaged or wrongly sized image is left out and said in `faults`: whether
/// that matters is for the caller to decide.
LoadedShot load_shot(const Recording& recording, const Shot& shot, const Work& work = {});

}  // namespace booth
