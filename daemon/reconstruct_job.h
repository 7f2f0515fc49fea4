#pragma once

#include <filesystem>
#include <functional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "daemon/empty_view_store.h"
#include "daemon/recording_source.h"
#include "pipeline/export/avatar_files.h"
#include "pipeline/reconstruct.h"
#include "pipeline/types/work.h"

namespace booth {

/// The stages of a job in their order: "load", those of reconstruct(), "export".
const std::vector<std::string>& job_stages();

/// Called with a stage that is under way, several of which may overlap, and the fraction of the whole job, 0 … 1, never
/// falling; by one thread at a time.
using JobProgress = std::function<void(std::string_view stage, double fraction)>;

struct JobReport {
  std::vector<std::pair<std::string, double>> stage_seconds;  ///< of job_stages() that ran; they may overlap
  std::vector<std::string> warnings;                          ///< as in the metadata
};

/// Where a job's inputs come from.
struct JobSources {
  FaceModelSource model = {};            ///< as reconstruct() wants it
  FaceDetectorSource detector = {};      ///< likewise
  const EmptyViewStore* kept = nullptr;  ///< where what was learned of the empty booth is kept; nullptr: nowhere
  /// Told of the recording once it is complete, by another thread, before its face is decoded. May be empty.
  std::function<void(const Recording&)> on_complete = {};
};

/// From a recording on disk to an avatar folder on disk. The folder appears whole or not at all; its name is the
/// avatar's id. An earlier avatar there is replaced. Frames that cannot be used are warnings in its metadata as long as
/// enough are left. Each shot is taken up as soon as the recording has it: of one that is still being written the body
/// is carved while the face is taken; that of the face is decoded meanwhile. The avatar is the same either way.
///
/// @param avatar  where the avatar's folder will appear; its parent is made where it is missing
/// @param files   which files the folder gets
/// @param work    its progress is not used
/// @error what RecordingSource and reconstruct return; no_background and no_subject for a recording without these
///        shots; invalid_argument when `avatar` is no plain name; invalid_state when something else is there; io,
///        disk_full
Result<JobReport> reconstruct_recording(RecordingSource& recording, const std::filesystem::path& avatar,
                                        const ReconstructionOptions& options, const JobSources& sources,
                                        const AvatarFileOptions& files, const Work& work,
                                        const JobProgress& progress = {}, const HealthReport& health = {});

}  // namespace booth
