#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// Which captures have begun and are not over: an empty file each, named by the capture's id, so that one that ends
/// with the daemon's process, or with the power, can be named after the next start. Any thread.
class CaptureJournal {
 public:
  /// @param folder  is made where it is missing. @error disk_full, io
  static Result<CaptureJournal> open(const std::filesystem::path& folder);

  /// Captures that an earlier process began, oldest first. @error io
  Result<std::vector<std::string>> unfinished() const;

  /// From now on the entry outlives this process; does not wait for the disk. @error disk_full, io
  Result<void> begin(const std::string& id) const;
  /// From now on it outlives a power cut; waits for the disk. @error disk_full, io
  Result<void> sync(const std::string& id) const;
  /// There is no such entry any more; waits for the disk. None before is a success. @error io
  Result<void> end(const std::string& id) const;

 private:
  explicit CaptureJournal(std::filesystem::path folder) : folder_(std::move(folder)) {}

  std::filesystem::path folder_;
};

}  // namespace booth
