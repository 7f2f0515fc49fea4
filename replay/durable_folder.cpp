#include "replay/durable_folder.h"

#include <dirent.h>
#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstring>
#include <system_error>
#include <utility>

#include "pipeline/types/rig.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr std::string_view partial_prefix = ".partial-";

/// What errno says about a path.
Error system_error(const std::string& doing, const fs::path& path, int number) {
  const bool full = number == ENOSPC || number == EDQUOT;
  const ErrorCode code = full ? ErrorCode::disk_full : number == ENOENT ? ErrorCode::not_found : ErrorCode::io;
  return {code, path.string() + ": " + doing + ": " + std::generic_category().message(number)};
}
/// The same where an absent path is a refusal like any other.
Error write_error(const std::string& doing, const fs::path& path, int number) {
  Error error = system_error(doing, path, number);
  if (error.code == ErrorCode::not_found) error.code = ErrorCode::io;
  return error;
}

/// An open file descriptor.
class Descriptor {
 public:
  explicit Descriptor(int number) : number_(number) {}
  ~Descriptor() {
    if (number_ >= 0) ::close(number_);
  }
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  int get() const { return number_; }
  int release() { return std::exchange(number_, -1); }
  /// Closes and says whether that went well; errors of a delayed write may appear only here.
  bool close() { return ::close(std::exchange(number_, -1)) == 0; }

 private:
  int number_;
};

int open_retrying(const fs::path& path, int flags, mode_t mode = 0) {
  int descriptor = -1;
  do descriptor = ::open(path.c_str(), flags | O_CLOEXEC, mode);
  while (descriptor < 0 && errno == EINTR);
  return descriptor;
}

bool write_all(int descriptor, std::span<const uint8_t> bytes) {
  while (!bytes.empty()) {
    const ssize_t written = ::write(descriptor, bytes.data(), bytes.size());
    if (written < 0 && errno == EINTR) continue;
    if (written < 0) return false;
    bytes = bytes.subspan(static_cast<size_t>(written));
  }
  return true;
}

std::span<const uint8_t> bytes_of(std::string_view text) {
  return {reinterpret_cast<const uint8_t*>(text.data()), text.size()};
}

Result<void> flush(const fs::path& path, int flags) {
  const Descriptor descriptor(open_retrying(path, flags | O_NOFOLLOW));
  if (descriptor.get() < 0) return write_error("cannot be opened to be flushed", path, errno);
  if (::fsync(descriptor.get()) != 0) return write_error("cannot be flushed", path, errno);
  return {};
}
Result<void> flush_folder(const fs::path& folder) { return flush(folder, O_RDONLY | O_DIRECTORY); }

/// Flushes all regular files and folders in and below `folder`, `folder` last.
Result<void> flush_tree(const fs::path& folder) {
  std::error_code code;
  for (fs::directory_iterator entry(folder, code), end; entry != end; entry.increment(code)) {
    if (code) break;
    const fs::file_status status = entry->symlink_status(code);
    if (code) break;
    Result<void> flushed;
    if (fs::is_directory(status)) flushed = flush_tree(entry->path());
    if (fs::is_regular_file(status)) flushed = flush(entry->path(), O_RDONLY);
    if (!flushed) return flushed;
  }
  if (code) return write_error("cannot be listed", folder, code.value());
  return flush_folder(folder);
}

/// A name that no other process and no other call uses: the process's number and a count. The kernel gives a number
/// again only after its process died, and then mkdir and O_EXCL tell.
std::string partial_name(const std::string& name) {
  static std::atomic<uint64_t> count{0};
  return std::string(partial_prefix) + name + "." + std::to_string(::getpid()) + "." + std::to_string(count++);
}

Result<void> make_folders(const fs::path& folder) {
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return write_error("cannot be made", folder, code.value());
  return {};
}

/// Opens and locks a folder so that others see that somebody works in it. -1 with errno where that fails.
int lock_folder(const fs::path& folder) {
  Descriptor descriptor(open_retrying(folder, O_RDONLY | O_DIRECTORY | O_NOFOLLOW));
  if (descriptor.get() < 0) return -1;
  // A file system without locks is no reason not to write to it; only a lock that somebody else holds counts.
  if (::flock(descriptor.get(), LOCK_EX | LOCK_NB) != 0 && errno == EWOULDBLOCK) return -1;
  struct stat status {};
  if (::fstat(descriptor.get(), &status) != 0) return -1;
  if (status.st_nlink == 0) {  // removed by remove_partial_folders between mkdir and flock
    errno = ENOENT;
    return -1;
  }
  return descriptor.release();
}

}  // namespace

Result<DurableFolder> DurableFolder::begin(const fs::path& parent, const std::string& name) {
  if (!is_safe_id(name)) return Error{ErrorCode::invalid_argument, "\"" + name + "\" is not a plain name for a folder"};
  if (const auto made = make_folders(parent); !made) return made.error();
  DurableFolder folder;
  folder.final_ = parent / name;
  constexpr int most_attempts = 100;  // each lost race or leftover of a process of the same number costs one
  for (int attempt = 0; attempt < most_attempts; ++attempt) {
    const fs::path partial = parent / partial_name(name);
    if (::mkdir(partial.c_str(), 0777) != 0) {
      if (errno == EEXIST) continue;
      return write_error("cannot be made", partial, errno);
    }
    folder.lock_ = lock_folder(partial);
    if (folder.lock_ >= 0) {
      folder.partial_ = partial;
      return folder;
    }
    if (errno != ENOENT && errno != EWOULDBLOCK) return write_error("cannot be opened", partial, errno);
  }
  return Error{ErrorCode::io, parent.string() + ": no folder can be begun in it"};
}

DurableFolder::DurableFolder(DurableFolder&& other) noexcept
    : partial_(std::exchange(other.partial_, {})),
      final_(std::move(other.final_)),
      lock_(std::exchange(other.lock_, -1)) {}

DurableFolder& DurableFolder::operator=(DurableFolder&& other) noexcept {
  if (this == &other) return *this;
  abandon();
  partial_ = std::exchange(other.partial_, {});
  final_ = std::move(other.final_);
  lock_ = std::exchange(other.lock_, -1);
  return *this;
}

DurableFolder::~DurableFolder() { abandon(); }

void DurableFolder::abandon() noexcept {
  std::error_code ignored;  // what cannot be removed now is removed by remove_partial_folders
  if (!partial_.empty()) fs::remove_all(partial_, ignored);
  partial_.clear();
  if (lock_ >= 0) ::close(std::exchange(lock_, -1));
}

Result<void> DurableFolder::write(const std::string& file, std::span<const uint8_t> bytes) {
  if (partial_.empty()) return Error{ErrorCode::invalid_state, final_.string() + ": is complete already"};
  if (!is_safe_relative_path(file))
    return Error{ErrorCode::invalid_argument, "\"" + file + "\" is not a path inside " + final_.string()};
  const fs::path path = partial_ / file;
  if (path.parent_path() != partial_)
    if (const auto made = make_folders(path.parent_path()); !made) return made;
  Descriptor descriptor(open_retrying(path, O_WRONLY | O_CREAT | O_EXCL, 0666));
  if (descriptor.get() < 0) return write_error("cannot be made", path, errno);
  if (!write_all(descriptor.get(), bytes)) return write_error("cannot be written", path, errno);
  // The disk begins now, so that commit() has little left to flush. What fails here fails again there.
  (void)::sync_file_range(descriptor.get(), 0, 0, SYNC_FILE_RANGE_WRITE);
  if (!descriptor.close()) return write_error("cannot be written", path, errno);
  return {};
}

Result<void> DurableFolder::write(const std::string& file, std::string_view text) {
  return write(file, bytes_of(text));
}

Result<void> DurableFolder::replace(const std::string& file, std::string_view text) {
  const std::string fresh = file + ".new";
  if (const auto written = write(fresh, text); !written) return written;
  if (::rename((partial_ / fresh).c_str(), (partial_ / file).c_str()) != 0)
    return write_error("cannot be replaced", partial_ / file, errno);
  return {};
}

Result<void> DurableFolder::commit() {
  if (partial_.empty()) return Error{ErrorCode::invalid_state, final_.string() + ": is complete already"};
  if (const auto flushed = flush_tree(partial_); !flushed) return flushed;
  if (::rename(partial_.c_str(), final_.c_str()) != 0) {
    if (errno == ENOTEMPTY || errno == EEXIST || errno == ENOTDIR)
      return Error{ErrorCode::invalid_state, final_.string() + ": is there already"};
    return write_error("cannot be made", final_, errno);
  }
  const auto flushed = flush_folder(final_.parent_path().empty() ? fs::path(".") : final_.parent_path());
  // Who is told of a failure must find nothing there. A disk that does not even take it back has it, whole.
  if (!flushed && ::rename(final_.c_str(), partial_.c_str()) == 0) return flushed;
  partial_.clear();
  ::close(std::exchange(lock_, -1));
  return {};
}

Result<void> write_file_atomically(const fs::path& file, std::span<const uint8_t> bytes) {
  const fs::path folder = file.has_parent_path() ? file.parent_path() : fs::path(".");
  const fs::path partial = folder / partial_name(file.filename().string());
  Descriptor descriptor(open_retrying(partial, O_WRONLY | O_CREAT | O_EXCL, 0666));
  if (descriptor.get() < 0) return write_error("cannot be made", partial, errno);
  const auto fail = [&](int number) {
    ::unlink(partial.c_str());
    return write_error("cannot be written", file, number);
  };
  ::flock(descriptor.get(), LOCK_EX | LOCK_NB);  // tells remove_partial_folders that it is alive; best effort
  if (!write_all(descriptor.get(), bytes) || ::fsync(descriptor.get()) != 0) return fail(errno);
  if (::rename(partial.c_str(), file.c_str()) != 0) return fail(errno);
  if (!descriptor.close()) return write_error("cannot be written", file, errno);
  return flush_folder(folder);
}

Result<void> write_file_atomically(const fs::path& file, std::string_view text) {
  return write_file_atomically(file, bytes_of(text));
}

Result<void> flush_to_disk(const fs::path& path) { return flush(path, O_RDONLY); }

Result<int> remove_partial_folders(const fs::path& parent) {
  std::error_code code;
  fs::directory_iterator entry(parent, code);
  if (code == std::errc::no_such_file_or_directory) return 0;
  int removed = 0;
  std::vector<fs::path> leftovers;
  for (const fs::directory_iterator end; !code && entry != end; entry.increment(code))
    if (entry->path().filename().string().starts_with(partial_prefix)) leftovers.push_back(entry->path());
  if (code) return write_error("cannot be listed", parent, code.value());
  for (const fs::path& leftover : leftovers) {
    const Descriptor descriptor(open_retrying(leftover, O_RDONLY | O_NOFOLLOW | O_NONBLOCK));
    if (descriptor.get() >= 0 && ::flock(descriptor.get(), LOCK_EX | LOCK_NB) != 0 && errno == EWOULDBLOCK) continue;
    fs::remove_all(leftover, code);
    if (code) return write_error("cannot be removed", leftover, code.value());
    ++removed;
  }
  return removed;
}

Result<void> remove_folder(const fs::path& parent, const std::string& name) {
  if (!is_safe_id(name)) return Error{ErrorCode::invalid_argument, "\"" + name + "\" is not the name of a folder"};
  const fs::path folder = parent / name;
  const fs::path partial = parent / partial_name(name);
  if (::rename(folder.c_str(), partial.c_str()) != 0) {
    if (errno == ENOENT) return {};
    return write_error("cannot be removed", folder, errno);
  }
  if (const auto flushed = flush_folder(parent); !flushed) return flushed;
  std::error_code code;
  fs::remove_all(partial, code);
  if (code) return write_error("cannot be removed", partial, code.value());
  return flush_folder(parent);
}

Result<std::vector<uint8_t>> read_file(const fs::path& file, size_t most_bytes) {
  const Descriptor descriptor(open_retrying(file, O_RDONLY | O_NONBLOCK));  // a FIFO must not hang the reader
  if (descriptor.get() < 0) return system_error("cannot be opened", file, errno);
  struct stat status {};
  if (::fstat(descriptor.get(), &status) != 0) return system_error("cannot be read", file, errno);
  if (!S_ISREG(status.st_mode)) return Error{ErrorCode::invalid_file, file.string() + ": is not a file"};
  const auto too_large = [&] {
    return Error{ErrorCode::invalid_file, file.string() + ": is larger than " + std::to_string(most_bytes) + " bytes"};
  };
  if (static_cast<uintmax_t>(status.st_size) > most_bytes) return too_large();
  std::vector<uint8_t> bytes(static_cast<size_t>(status.st_size));
  size_t filled = 0;
  while (true) {
    if (filled == bytes.size()) {
      uint8_t more = 0;  // a file that grows is read to its end
      const ssize_t count = ::read(descriptor.get(), &more, 1);
      if (count < 0 && errno == EINTR) continue;
      if (count < 0) return system_error("cannot be read", file, errno);
      if (count == 0) return bytes;
      if (filled == most_bytes) return too_large();
      bytes.push_back(more);
      bytes.resize(std::min(most_bytes, bytes.size() * 2));
      ++filled;
      continue;
    }
    const ssize_t count = ::read(descriptor.get(), bytes.data() + filled, bytes.size() - filled);
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) return system_error("cannot be read", file, errno);
    if (count == 0) {
      bytes.resize(filled);
      return bytes;
    }
    filled += static_cast<size_t>(count);
  }
}

bool is_safe_relative_path(const std::string& path) {
  constexpr size_t longest = 255;
  if (path.empty() || path.size() > longest || path.front() == '/') return false;
  if (std::any_of(path.begin(), path.end(), [](unsigned char c) { return c < 0x20 || c == 0x7f || c == '\\'; }))
    return false;
  for (size_t begin = 0; begin <= path.size();) {
    const size_t end = std::min(path.find('/', begin), path.size());
    const std::string_view component = std::string_view(path).substr(begin, end - begin);
    if (component.empty() || component == "." || component == "..") return false;
    begin = end + 1;
  }
  return true;
}

}  // namespace booth
