#pragma once

#include <chrono>
#include <condition_variable>
#include <filesystem>
#include <mutex>
#include <optional>
#include <stop_token>
#include <string>
#include <thread>

#include "daemon/child_process.h"
#include "daemon/job_queue.h"
#include "daemon/reconstruct_program.h"

namespace booth {

/// Begins a capture's reconstruction before its job exists: as soon as the subject's pictures are on the disk, while
/// the face's patterns are still being shown and the recording is being finished. At most one process, and only while a
/// worker has nothing else to do. It is an offer: whatever becomes of it, the job is done all the same.
///
/// The process gets --growing and hears through its standard input, a JSON object a line, where the recording is that
/// is being written, {"so_far": "FOLDER"}, and at last that it is at its place: {"complete": true}. Any thread may
/// call.
class HeadStart {
 public:
  /// @param workers  how many jobs may run at once
  HeadStart(ReconstructProgram program, int workers, JobQueue& jobs);
  /// Kills what runs.
  ~HeadStart();

  /// A capture's recording has grown. Returns at once.
  /// @param folder  where it is being written, readable as a recording
  void grow(const std::string& capture, const std::string& face, const std::filesystem::path& folder);

  /// The process that works on this job, if there is one that lives: it has been told that the recording is complete,
  /// and is the caller's from now on; it dies with this object all the same. That of another capture is ended when it
  /// would be one too many beside this job.
  std::optional<ChildProcess> take(const std::string& job);

  /// Of this capture's process nothing is left when this returns.
  void drop(const std::string& capture);

 private:
  void run(const std::stop_token& stop);
  void start();
  void watch();
  void end();
  bool has_room() const;

  const ReconstructProgram program_;
  const int workers_;
  JobQueue& jobs_;
  std::mutex mutex_;
  std::condition_variable_any changed_;
  // Guarded by mutex_.
  std::string capture_, face_;    ///< whose process is wanted; empty: nobody's
  std::filesystem::path folder_;  ///< of its recording so far
  bool told_ = false;             ///< the process knows that folder's newest state
  std::optional<ChildProcess> process_;
  std::chrono::steady_clock::time_point started_;
  std::jthread thread_;  ///< starts the processes, as they die with the thread that did
};

}  // namespace booth
