#include "daemon/disk_guard.h"

#include <sys/stat.h>
#include <sys/statvfs.h>

#include <system_error>
#include <utility>

#include "pipeline/types/shot.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr uint64_t mebibyte = 1024 * 1024;
constexpr uint64_t avatar_bytes = 64 * mebibyte;  ///< several times what the default settings make
constexpr uint64_t bytes_per_pixel = 3;
constexpr uint64_t jpeg_divisor = 3;  ///< at quality 95 noisy pictures take a quarter

std::string in_mebibytes(uint64_t bytes) { return std::to_string(bytes / mebibyte) + " MiB"; }

uint64_t size_of_folder(const fs::path& folder) {
  constexpr uint64_t block = 4096;  // the blocks that the disk gave are not told before it has written
  uint64_t bytes = 0;
  std::error_code code;
  for (fs::recursive_directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code)) {
    struct stat status {};
    if (::lstat(entry->path().c_str(), &status) == 0 && S_ISREG(status.st_mode))
      bytes += (static_cast<uint64_t>(status.st_size) + block - 1) / block * block / status.st_nlink;
  }
  return bytes;
}

}  // namespace

std::optional<uint64_t> free_space_at(const fs::path& folder) {
  struct statvfs space {};
  if (::statvfs(folder.c_str(), &space) != 0) return std::nullopt;
  return static_cast<uint64_t>(space.f_bavail) * space.f_frsize;
}

uint64_t largest_capture_bytes(const Rig& rig, const SpoolOptions& images, int frames, bool patterns) {
  uint64_t pattern_frames = 0;
  if (patterns && rig.projector) {
    const Intrinsics& projector = rig.projector->intrinsics;
    pattern_frames = static_cast<uint64_t>(pattern_count(
        {.width = projector.width, .height = projector.height, .columns = true, .rows = true, .inverse = true}));
  }
  uint64_t bytes = 0;
  for (const RigCamera& camera : rig.cameras) {
    const uint64_t frame = static_cast<uint64_t>(camera.intrinsics.width) *
                           static_cast<uint64_t>(camera.intrinsics.height) * bytes_per_pixel;
    bytes += frame * (static_cast<uint64_t>(frames) + (camera.role == CameraRole::face ? pattern_frames : 0));
  }
  if (images.format == SpoolOptions::Format::jpeg) bytes /= jpeg_divisor;
  return bytes + avatar_bytes;
}

DiskGuard::DiskGuard(const IdentityConfig& booth, const DiskConfig& config, FreeSpace free_space)
    : booth_(booth),
      reserve_(static_cast<uint64_t>(config.reserve_mib) * mebibyte),
      quota_(static_cast<uint64_t>(config.limit_mib) * mebibyte),
      free_space_(std::move(free_space)) {}

void DiskGuard::measure() {
  if (const auto free = free_space_(booth_.state_directory)) free_bytes_ = *free;
  std::map<fs::path, uint64_t> folders;
  uint64_t used = 0;
  for (const fs::path& parent : {booth_.recordings(), booth_.avatars(), booth_.backgrounds()}) {
    std::error_code code;
    for (fs::directory_iterator entry(parent, code), end; !code && entry != end; entry.increment(code)) {
      // One in the making still grows; its room was asked for.
      if (!is_safe_id(entry->path().filename().string())) continue;
      const auto known = folders_.find(entry->path());
      const uint64_t bytes = known != folders_.end() ? known->second : size_of_folder(entry->path());
      folders.emplace(entry->path(), bytes);
      used += bytes;
    }
  }
  folders_ = std::move(folders);
  used_bytes_ = used;
}

Result<void> DiskGuard::check(uint64_t bytes) const {
  const uint64_t free = free_bytes_, used = used_bytes_;
  if (free < reserve_ + bytes)
    return Error{ErrorCode::disk_full, in_mebibytes(free) + " are free on the disk, but it may take " +
                                           in_mebibytes(bytes) + " and " + in_mebibytes(reserve_) +
                                           " must stay free: delete avatars or make room"};
  if (quota_ > 0 && used + bytes > quota_)
    return Error{ErrorCode::disk_full, "recordings and avatars take " + in_mebibytes(used) + " of the " +
                                           in_mebibytes(quota_) + " allowed, and it may take " + in_mebibytes(bytes) +
                                           " more: delete avatars"};
  return {};
}

}  // namespace booth
