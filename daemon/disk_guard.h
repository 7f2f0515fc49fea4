#pragma once

#include <atomic>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <string>

#include "config/booth_config.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"

namespace booth {

/// Bytes that are free for this program where a folder is; nothing where that cannot be found out.
using FreeSpace = std::function<std::optional<uint64_t>(const std::filesystem::path& folder)>;

/// As statvfs says.
std::optional<uint64_t> free_space_at(const std::filesystem::path& folder);

/// The most that a capture can take on the disk, its avatar included: pictures of all cameras as they are in memory,
/// for no lossless code makes noise smaller, and a third of that for JPEG. The background is shared between captures.
///
/// @param frames    of each camera's first shot
/// @param patterns  whether the projector's patterns are taken, with the cameras of the face
uint64_t largest_capture_bytes(const Rig& rig, const SpoolOptions& images, int frames, bool patterns);

/// Watches the space that recordings and avatars take, and what is left. measure() by one thread, the rest by any.
class DiskGuard {
 public:
  DiskGuard(const IdentityConfig& booth, const DiskConfig& config, FreeSpace free_space = free_space_at);

  /// Waits for the disk. Folders that were measured before are not read again: they never change.
  void measure();

  /// Whether that much can still be stored.
  /// @error disk_full  a sentence with the numbers and what to do
  Result<void> check(uint64_t bytes) const;

  uint64_t free_bytes() const { return free_bytes_; }
  /// Of recordings, avatars and backgrounds; a file that several share counts in parts.
  uint64_t used_bytes() const { return used_bytes_; }
  uint64_t reserve_bytes() const { return reserve_; }
  uint64_t quota_bytes() const { return quota_; }  ///< 0: there is none

 private:
  const IdentityConfig booth_;
  const uint64_t reserve_, quota_;
  const FreeSpace free_space_;
  std::map<std::filesystem::path, uint64_t> folders_;  ///< of measure(): bytes of each
  std::atomic<uint64_t> free_bytes_{0}, used_bytes_{0};
};

}  // namespace booth
