#pragma once

#include <cstdint>
#include <filesystem>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// What is known about a published avatar without opening its files.
struct AvatarSummary {
  std::string id;
  std::string created;  ///< ISO 8601, UTC
  std::string label;    ///< may be empty
  std::string capture;  ///< the recording it was made from; empty when its metadata does not say
  std::vector<std::string> files;
  std::optional<uint64_t> triangles;
  std::vector<std::string> warnings;
};

/// A piece of one of an avatar's files.
struct FilePiece {
  uint64_t size = 0;   ///< of the whole file
  std::string sha256;  ///< of the whole file
  std::vector<uint8_t> bytes;
};

/// The published avatars: folders below one folder, listed in memory. Any thread.
class AvatarStore {
 public:
  /// Reads the folders that are there; what is not an avatar is left alone and not listed.
  /// @error io
  static Result<std::unique_ptr<AvatarStore>> open(const std::filesystem::path& folder);

  const std::filesystem::path& folder() const { return folder_; }

  // From memory, blocking nobody.
  /// Newest first. @param before  only avatars older than that one; empty: from the newest
  /// @error not_found  no avatar `before`
  Result<std::vector<AvatarSummary>> list(size_t limit, const std::string& before) const;
  std::optional<AvatarSummary> find(const std::string& id) const;
  /// Avatars made from that capture.
  std::vector<std::string> of_capture(const std::string& capture) const;
  /// No longer listed. The folder stays.
  void forget(const std::string& id);

  // From the disk, waiting for it.
  /// Lists a folder that has appeared. @error not_found, invalid_file  it is no avatar
  Result<AvatarSummary> publish(const std::string& id);
  /// metadata.json's text. @error not_found, io
  Result<std::string> metadata(const std::string& id) const;
  /// @param length  at most; fewer bytes at the end of the file
  /// @error not_found  no such avatar or file; invalid_argument  `offset` behind the end; io
  Result<FilePiece> fetch(const std::string& id, const std::string& file, uint64_t offset, uint64_t length);
  /// Removes the folder, listed or not. @error io
  Result<void> remove(const std::string& id);

 private:
  struct File {
    uint64_t size = 0;
    std::string sha256;  ///< empty until somebody asked
  };
  struct Entry {
    AvatarSummary summary;
    std::map<std::string, File> files;
  };
  explicit AvatarStore(std::filesystem::path folder) : folder_(std::move(folder)) {}
  Result<Entry> read(const std::string& id) const;

  const std::filesystem::path folder_;
  mutable std::mutex mutex_;
  std::map<std::string, Entry> entries_;  ///< guarded by mutex_
};

}  // namespace booth
