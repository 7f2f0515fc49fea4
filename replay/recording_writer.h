#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <string>

#include "drivers/clock.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"
#include "replay/recording.h"

namespace booth {

/// How a recording's images are stored.
struct SpoolOptions {
  enum class Format { png, jpeg };
  Format format = Format::png;
  int png_level = 1;      ///< zlib's, 0 … 9; 1 keeps pace with cameras
  int jpeg_quality = 95;  ///< 1 … 100
  /// Stores a frame's own encoded bytes (Frame::encoded) as they are instead of encoding its pixels again.
  bool keep_encoded = true;
};

/// What recording.json says about the capture as a whole.
struct RecordingHeader {
  std::string id = {};       ///< is_safe_id; also the folder's name
  std::string created = {};  ///< ISO 8601, UTC: "2026-11-22T10:15:00Z"
  std::string label = {};    ///< at most 1000 bytes; may be empty
  std::string face = {};     ///< how the capture asks for the face ("auto", …); may be empty
};

/// What recording.json says about a shot, its frames aside.
struct ShotHeader {
  std::string name;  ///< is_safe_id, unique in the recording
  ShotRole role = ShotRole::body;
  std::optional<GrayCodePattern> pattern = {};  ///< of a gray_code shot
  std::optional<CalibrationBoard> board = {};   ///< of a calibration_board shot
};

/// Spools a capture to the disk as its frames come. The recording appears at PARENT/ID when commit() succeeds, whole
/// and flushed; without it nothing remains.
///
/// add may be called from several threads at once (the encoding runs in the caller); everything else by one thread
/// while no add is under way.
class RecordingWriter {
 public:
  /// @param rig  check(rig) holds
  /// @error invalid_argument  a header that is not as RecordingHeader says, or an invalid rig; @error disk_full, io
  static Result<std::unique_ptr<RecordingWriter>> begin(const std::filesystem::path& parent,
                                                        const RecordingHeader& header, const Rig& rig,
                                                        const SpoolOptions& options = {});
  ~RecordingWriter();
  RecordingWriter(const RecordingWriter&) = delete;
  RecordingWriter& operator=(const RecordingWriter&) = delete;

  /// Opens a shot; shots are listed in the order of this call.
  /// @error invalid_argument  an unsafe or repeated name, or a gray_code shot without a pattern
  Result<void> begin_shot(const ShotHeader& shot);

  /// Encodes and stores one frame of a shot that was begun. Body shots hold one frame a camera (index 0).
  /// @error invalid_argument  an unknown shot or camera, a size that is not the rig's, a second frame of the same
  ///                          camera and index; @error disk_full, io
  Result<void> add(const std::string& shot, const Frame& frame);

  /// Takes over a whole shot of another recording, such as the background learned before, without decoding: the
  /// image files are linked, or copied where the file system cannot link.
  /// @error as begin_shot and add; invalid_file  an image is missing or not a regular file
  Result<void> add_shot(const Recording& from, const Shot& shot);

  /// Makes what was added so far readable, as a recording in a folder that is not yet the recording's: for whoever can
  /// begin with it.
  /// @return that folder, which commit() or the writer's end takes away
  /// @error disk_full, io
  Result<std::filesystem::path> show_so_far();

  /// Writes recording.json and lets the recording appear. Afterwards the writer is done.
  /// @error as DurableFolder::commit
  Result<void> commit();

  /// Where the recording will appear.
  const std::filesystem::path& final_path() const;

 private:
  struct Content;
  explicit RecordingWriter(std::unique_ptr<Content> content);
  std::unique_ptr<Content> content_;
};

/// recording.json's text of a recording (without its rig). read_recording gives the same values back.
std::string write_recording_json(const Recording& recording);

}  // namespace booth
