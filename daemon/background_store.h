#pragma once

#include <filesystem>
#include <memory>
#include <mutex>
#include <string>

#include "pipeline/types/result.h"
#include "replay/recording.h"
#include "replay/recording_writer.h"

namespace booth {

/// The empty booth as it was learned last: a recording with a background shot, below one folder. Any thread.
class BackgroundStore {
 public:
  /// Finds the newest background; one that cannot be read is left alone.
  /// @error io
  static Result<std::unique_ptr<BackgroundStore>> open(const std::filesystem::path& folder);

  /// Nothing was learned yet: null.
  std::shared_ptr<const Recording> current() const;

  /// Takes over the background shot of another recording, in place of the one that was learned before.
  /// @param id  a new one, is_safe_id
  /// @error no_background  the recording has none; what RecordingWriter returns
  Result<void> adopt(const Recording& recording, const std::string& id, const std::string& created);

  /// Begins to learn: the caller adds a background shot. @error what RecordingWriter returns
  Result<std::unique_ptr<RecordingWriter>> begin(const Rig& rig, const SpoolOptions& images, const std::string& id,
                                                 const std::string& created) const;
  /// Takes what was written in place of what was learned before. @error what RecordingWriter returns
  Result<void> finish(RecordingWriter& writer, const std::string& id);

 private:
  explicit BackgroundStore(std::filesystem::path folder) : folder_(std::move(folder)) {}

  const std::filesystem::path folder_;
  mutable std::mutex mutex_;
  std::shared_ptr<const Recording> current_;  ///< guarded by mutex_
};

}  // namespace booth
