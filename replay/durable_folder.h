#pragma once

#include <cstdint>
#include <filesystem>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/types/result.h"

namespace booth {

/// A folder that appears whole or not at all: it is built beside its final place as PARENT/.partial-NAME-…, flushed
/// to the disk, and renamed. A process that is killed on the way leaves a leftover that nobody takes for a result
/// and that remove_partial_folders removes.
///
/// write may be called from several threads for different files; everything else by one thread at a time.
class DurableFolder {
 public:
  /// Makes PARENT where it is missing, and the folder under construction in it, with the permissions that the
  /// process's umask leaves.
  ///
  /// @param name  the final name, is_safe_id
  /// @error invalid_argument  an unsafe name; @error disk_full, io  with the path
  static Result<DurableFolder> begin(const std::filesystem::path& parent, const std::string& name);

  DurableFolder(DurableFolder&& other) noexcept;
  DurableFolder& operator=(DurableFolder&& other) noexcept;
  DurableFolder(const DurableFolder&) = delete;
  DurableFolder& operator=(const DurableFolder&) = delete;
  /// Without commit(): removes what was built.
  ~DurableFolder();

  /// Where it is being built. Files put there by others are flushed by commit() too.
  const std::filesystem::path& path() const { return partial_; }
  /// Where it will appear.
  const std::filesystem::path& final_path() const { return final_; }

  /// Writes a new file below path(), and the folders on the way to it. An existing one is an error.
  ///
  /// @param file  relative, is_safe_relative_path
  /// @error invalid_argument, disk_full, io  with the path
  Result<void> write(const std::string& file, std::span<const uint8_t> bytes);
  Result<void> write(const std::string& file, std::string_view text);

  /// As write, in place of what may be there: who reads that file sees the old bytes or the new ones.
  Result<void> replace(const std::string& file, std::string_view text);

  /// Flushes every file and folder and lets the folder appear at final_path(). Afterwards the object is done.
  /// An empty folder that is already there is replaced. After an error nothing has appeared.
  ///
  /// @error invalid_state  something that is not an empty folder is already there; @error disk_full, io
  Result<void> commit();

 private:
  DurableFolder() = default;
  void abandon() noexcept;

  std::filesystem::path partial_;
  std::filesystem::path final_;
  int lock_ = -1;  ///< an open descriptor of the folder, locked while this process builds it
};

/// Replaces or makes one file, whole or not at all: a temporary file beside it, flushed, renamed, and the folder
/// flushed. The folder must exist.
/// @error disk_full, io  with the path
Result<void> write_file_atomically(const std::filesystem::path& file, std::span<const uint8_t> bytes);
Result<void> write_file_atomically(const std::filesystem::path& file, std::string_view text);

/// Brings a file or a folder, not what is in it, to the disk, and waits for that. @error disk_full, io
Result<void> flush_to_disk(const std::filesystem::path& path);

/// Removes what killed processes left in `parent` (not below it): folders under construction or being deleted, and
/// temporary files. What a living process is building is left alone. A missing parent is no error.
/// @return how many were removed; @error io
Result<int> remove_partial_folders(const std::filesystem::path& parent);

/// Removes PARENT/NAME with all that it holds: it vanishes at once by a rename, then its content is deleted; a
/// process killed on the way leaves a leftover for remove_partial_folders. Nothing there is a success.
/// @error invalid_argument  an unsafe name; @error io
Result<void> remove_folder(const std::filesystem::path& parent, const std::string& name);

/// The whole content of a regular file (a link to one included).
/// @error not_found; @error invalid_file  not a regular file, or more than `most_bytes`; @error io
Result<std::vector<uint8_t>> read_file(const std::filesystem::path& file, size_t most_bytes);

/// Relative, at most 255 bytes, printable, no empty, "." or ".." component and no backslash: it stays below the folder
/// that it is appended to, as long as no symbolic link leads out.
bool is_safe_relative_path(const std::string& path);

}  // namespace booth
