#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <filesystem>
#include <map>
#include <mutex>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// What has added up since the program started.
struct HealthTotals {
  double captures_done = 0, captures_failed = 0;
  double jobs_done = 0, jobs_failed = 0;
  double job_seconds = 0;  ///< of all runs, those that failed included
};

struct CameraObservation {
  std::string id;
  bool offline = false;
  uint64_t frames = 0, dropped = 0;  ///< since the program started
};

/// The booth at one instant.
struct HealthObservation {
  std::chrono::system_clock::time_point time;
  std::chrono::steady_clock::time_point steady;
  bool ready = false;   ///< could a capture start?
  uint64_t queued = 0;  ///< jobs that wait or run
  uint64_t free_bytes = 0, used_bytes = 0, resident_bytes = 0;
  uint64_t descriptors = 0, threads = 0;
  HealthTotals totals = {};
  std::vector<CameraObservation> cameras = {};
};

/// The booth over a span of time. Nothing of a visitor is in it.
struct HealthSample {
  struct Camera {
    double offline_s = 0;
    uint64_t frames = 0, dropped = 0;
  };
  std::chrono::sys_seconds begin, end;  ///< by the clock of the day, which may have been stepped
  double observed_s = 0;                ///< how much of it the program ran
  double ready_s = 0;                   ///< and how much of that a capture could have started
  uint64_t starts = 0;                  ///< of the program
  HealthTotals totals;                  ///< what came in it
  uint64_t most_queued = 0;
  uint64_t least_free_bytes = 0;
  uint64_t most_used_bytes = 0;
  uint64_t most_resident_bytes = 0, most_descriptors = 0, most_threads = 0;
  std::map<std::string, Camera> cameras;  ///< by id
};

nlohmann::json to_json(const HealthSample& sample);
/// @return nothing where it is not one
std::optional<HealthSample> health_sample_from(const nlohmann::json& json);

/// How the booth has been, for months, in a file that outlives the service: the latest day in samples of five minutes,
/// two weeks before it by the hour, more than a year by the day. Any thread.
class HealthHistory {
 public:
  /// Goes on with what the file holds. One that is damaged is told of in the log and begun anew; one that the disk does
  /// not give now is left as it is, and this history in memory.
  explicit HealthHistory(std::filesystem::path file);

  /// Does not wait for the disk. @return whether it is time to save()
  bool observe(const HealthObservation& now);
  /// Whole or not at all; waits for the disk. @error disk_full, io
  Result<void> save() const;

  /// Oldest first, those that end at `since` or later; neighbours are summed up where there are more than `limit`.
  std::vector<HealthSample> samples(std::chrono::system_clock::time_point since, size_t limit) const;

 private:
  void load();
  std::vector<HealthSample> all() const;
  void keep(HealthSample sample);

  const std::filesystem::path file_;
  bool writable_ = true;
  mutable std::mutex mutex_;
  std::deque<HealthSample> days_, hours_, fine_;  ///< guarded by mutex_; each oldest first, and older than the next
  std::optional<HealthSample> current_;           ///< guarded by mutex_; not yet of its full length
  std::optional<HealthObservation> last_;         ///< guarded by mutex_; of this process
};

/// Where a booth keeps it.
std::filesystem::path health_history_file(const std::filesystem::path& state_directory);

}  // namespace booth
