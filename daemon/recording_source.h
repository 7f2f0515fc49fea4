#pragma once

#include <filesystem>
#include <optional>
#include <stop_token>
#include <string>

#include "daemon/child_output.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"
#include "replay/recording.h"

namespace booth {

/// A recording that is there, or one that is being written. By one thread at a time.
class RecordingSource {
 public:
  /// One that is there.
  explicit RecordingSource(std::filesystem::path folder) : folder_(std::move(folder)) {}
  /// One that will be in `folder`; until then it says in `news`, a JSON object a line, where there is a part of it:
  /// {"so_far": "FOLDER"}, and at last {"complete": true}. What is no such line is passed over.
  /// @param news  a descriptor; stays the caller's; reading from it is made not to wait
  RecordingSource(std::filesystem::path folder, int news);

  /// Waits until the recording has a shot of that role, or is complete, and reads it. What is there only in part may
  /// move away while its images are read: then complete() has them.
  /// @error as read_recording; cancelled; invalid_state  the news ended before the recording was complete
  Result<Recording> with(ShotRole role, const std::stop_token& stop);
  /// Waits for all of it. @error as with
  Result<Recording> complete(const std::stop_token& stop);

  bool is_complete() const { return news_ < 0; }

 private:
  Result<void> wait_for_news(const std::stop_token& stop);

  const std::filesystem::path folder_;
  int news_ = -1;  ///< negative: the recording is complete
  LineReader lines_;
  std::filesystem::path so_far_;  ///< empty: nothing yet
};

}  // namespace booth
