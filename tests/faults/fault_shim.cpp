// Loaded into a program by LD_PRELOAD: makes its file operations below one folder fail, tears its writes, kills it
// between two of them, and steps the clock of the day, as campaign.py tells through shared memory.
//
// Environment: FAULT_CONTROL names the file of that memory (see Control), FAULT_ROOT the folder; FAULT_LOG, where it is
// set, a file that gets a line for each operation that succeeded: its name and its paths, separated by tabs.
//
// Operations are numbered across all processes that share the memory, so that "the 17th" is the same one in each run of
// a program that does one thing after another.

#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <climits>
#include <cstdarg>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <string_view>

namespace {

enum Mode : uint64_t {
  off,
  fail,       ///< operations first … last return `error`
  tear,       ///< the first writes half of its bytes, those up to the last return `error`
  kill_self,  ///< the process is killed before it
  kill_all    ///< so is the process `daemon`, at the same instant
};

/// Little-endian words, as campaign.py writes them.
struct Control {
  std::atomic<uint64_t> counting;  ///< operations count while it is not 0
  std::atomic<uint64_t> count;     ///< how many there were
  std::atomic<uint64_t> mode;
  std::atomic<uint64_t> first, last;  ///< numbers of the operations concerned, from 1
  std::atomic<uint64_t> error;        ///< an errno
  std::atomic<uint64_t> injected;     ///< how many operations failed
  std::atomic<int64_t> clock_step_ns;
  std::atomic<uint64_t> daemon;  ///< a process id
  char what[440];                ///< the first operation that failed
};
static_assert(sizeof(Control) == 512);

struct Setting {
  Control* control = nullptr;
  std::string root;
  int log = -1;

  Setting() {
    const char* file = std::getenv("FAULT_CONTROL");
    const char* folder = std::getenv("FAULT_ROOT");
    if (file == nullptr || folder == nullptr) return;
    const auto descriptor = static_cast<int>(::syscall(SYS_openat, AT_FDCWD, file, O_RDWR | O_CLOEXEC, 0));
    if (descriptor < 0) return;
    void* memory = ::mmap(nullptr, sizeof(Control), PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, 0);
    ::syscall(SYS_close, descriptor);
    if (memory == MAP_FAILED) return;
    control = static_cast<Control*>(memory);
    root = folder;
    if (const char* name = std::getenv("FAULT_LOG"))
      log = static_cast<int>(::syscall(SYS_openat, AT_FDCWD, name, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644));
  }
};

const Setting& setting() {
  static const Setting made;
  return made;
}

template <class Function>
Function* real(const char* name) {
  return reinterpret_cast<Function*>(::dlsym(RTLD_NEXT, name));
}

std::string path_of(int descriptor) {
  char link[PATH_MAX];
  const std::string name = "/proc/self/fd/" + std::to_string(descriptor);
  const ssize_t length = ::readlink(name.c_str(), link, sizeof link);
  return length > 0 ? std::string(link, static_cast<size_t>(length)) : std::string();
}

std::string path_at(int folder, const char* path) {
  if (path == nullptr) return {};
  if (path[0] == '/') return path;
  char here[PATH_MAX];
  std::string base = folder != AT_FDCWD ? path_of(folder) : ::getcwd(here, sizeof here) != nullptr ? here : "";
  return base + "/" + path;
}

bool is_concerned(const std::string& path) {
  const Setting& set = setting();
  return set.control != nullptr && path.starts_with(set.root) &&
         (path.size() == set.root.size() || path[set.root.size()] == '/');
}

enum class Fate { succeed, fail, tear };

/// Numbers an operation and says what becomes of it; errno is set for one that fails.
Fate decide(std::string_view operation, const std::string& path, bool needs_space) {
  if (!is_concerned(path)) return Fate::succeed;
  Control& control = *setting().control;
  if (control.counting == 0) return Fate::succeed;
  const uint64_t number = ++control.count;
  const uint64_t mode = control.mode;
  if (mode == off || number < control.first || number > control.last) return Fate::succeed;
  const auto error = static_cast<int>(control.error.load());
  const bool is_first = number == control.first;
  if ((mode == fail || (mode == tear && !is_first)) && error == ENOSPC && !needs_space) return Fate::succeed;
  if (mode == tear && is_first && operation != "write") return Fate::succeed;
  if (control.injected++ == 0)
    std::snprintf(control.what, sizeof control.what, "%.*s %s", static_cast<int>(operation.size()), operation.data(),
                  path.c_str());
  if (mode == kill_all && control.daemon != 0) ::kill(static_cast<pid_t>(control.daemon.load()), SIGKILL);
  if (mode == kill_all || mode == kill_self) ::kill(::getpid(), SIGKILL);
  if (mode == tear && is_first) return Fate::tear;
  errno = error;
  return Fate::fail;
}

template <class Value>
Value logged(Value result, const char* operation, const std::string& path, const std::string& other = {}) {
  if (result < 0 || setting().log < 0 || !is_concerned(path)) return result;
  const int number = errno;
  const std::string line = std::string(operation) + "\t" + path + (other.empty() ? "" : "\t" + other) + "\n";
  ::syscall(SYS_write, setting().log, line.data(), line.size());
  errno = number;
  return result;
}

int open_at(int folder, const char* file, int flags, mode_t mode) {
  static auto* const next = real<int(int, const char*, int, ...)>("openat64");
  const std::string path = path_at(folder, file);
  const bool makes = (flags & O_CREAT) != 0;
  if (decide(makes ? "create" : "open", path, makes) == Fate::fail) return -1;
  return logged(next(folder, file, flags, mode), makes ? "create" : "open", path);
}

mode_t mode_of(int flags, va_list arguments) {
  return (flags & O_CREAT) != 0 || (flags & O_TMPFILE) == O_TMPFILE ? static_cast<mode_t>(va_arg(arguments, unsigned))
                                                                    : 0;
}

}  // namespace

extern "C" {

// The C library declares these with noexcept or attributes that differ from one release to another; what is asked for
// here is only that the names are the same.
#define SHIM __attribute__((visibility("default")))

SHIM int open(const char* file, int flags, ...) {
  va_list arguments;
  va_start(arguments, flags);
  const mode_t mode = mode_of(flags, arguments);
  va_end(arguments);
  return open_at(AT_FDCWD, file, flags, mode);
}

SHIM int open64(const char* file, int flags, ...) {
  va_list arguments;
  va_start(arguments, flags);
  const mode_t mode = mode_of(flags, arguments);
  va_end(arguments);
  return open_at(AT_FDCWD, file, flags, mode);
}

SHIM int openat(int folder, const char* file, int flags, ...) {
  va_list arguments;
  va_start(arguments, flags);
  const mode_t mode = mode_of(flags, arguments);
  va_end(arguments);
  return open_at(folder, file, flags, mode);
}

SHIM int openat64(int folder, const char* file, int flags, ...) {
  va_list arguments;
  va_start(arguments, flags);
  const mode_t mode = mode_of(flags, arguments);
  va_end(arguments);
  return open_at(folder, file, flags, mode);
}

SHIM ssize_t write(int descriptor, const void* bytes, size_t size) {
  static auto* const next = real<ssize_t(int, const void*, size_t)>("write");
  if (setting().control == nullptr) return next(descriptor, bytes, size);
  const std::string path = path_of(descriptor);
  switch (decide("write", path, true)) {
    case Fate::fail: return -1;
    case Fate::tear: return logged(next(descriptor, bytes, size > 1 ? size / 2 : size), "write", path);
    case Fate::succeed: break;
  }
  return logged(next(descriptor, bytes, size), "write", path);
}

SHIM ssize_t writev(int descriptor, const iovec* pieces, int count) {
  static auto* const next = real<ssize_t(int, const iovec*, int)>("writev");
  if (setting().control == nullptr) return next(descriptor, pieces, count);
  const std::string path = path_of(descriptor);
  switch (decide("write", path, true)) {
    case Fate::fail: return -1;
    case Fate::tear: return write(descriptor, pieces[0].iov_base, pieces[0].iov_len / 2);
    case Fate::succeed: break;
  }
  return logged(next(descriptor, pieces, count), "write", path);
}

SHIM int fsync(int descriptor) {
  static auto* const next = real<int(int)>("fsync");
  const std::string path = path_of(descriptor);
  if (decide("fsync", path, true) == Fate::fail) return -1;
  return logged(next(descriptor), "fsync", path);
}

SHIM int fdatasync(int descriptor) {
  static auto* const next = real<int(int)>("fdatasync");
  const std::string path = path_of(descriptor);
  if (decide("fsync", path, true) == Fate::fail) return -1;
  return logged(next(descriptor), "fsync", path);
}

SHIM int renameat2(int from_folder, const char* from, int to_folder, const char* to, unsigned flags) {
  static auto* const next = real<int(int, const char*, int, const char*, unsigned)>("renameat2");
  const std::string path = path_at(from_folder, from);
  if (decide("rename", path, true) == Fate::fail) return -1;
  return logged(next(from_folder, from, to_folder, to, flags), "rename", path, path_at(to_folder, to));
}
SHIM int renameat(int from_folder, const char* from, int to_folder, const char* to) {
  return renameat2(from_folder, from, to_folder, to, 0);
}
SHIM int rename(const char* from, const char* to) { return renameat2(AT_FDCWD, from, AT_FDCWD, to, 0); }

SHIM int mkdirat(int folder, const char* name, mode_t mode) {
  static auto* const next = real<int(int, const char*, mode_t)>("mkdirat");
  const std::string path = path_at(folder, name);
  if (decide("mkdir", path, true) == Fate::fail) return -1;
  return logged(next(folder, name, mode), "mkdir", path);
}
SHIM int mkdir(const char* name, mode_t mode) { return mkdirat(AT_FDCWD, name, mode); }

SHIM int linkat(int from_folder, const char* from, int to_folder, const char* to, int flags) {
  static auto* const next = real<int(int, const char*, int, const char*, int)>("linkat");
  const std::string path = path_at(to_folder, to);
  if (decide("link", path, true) == Fate::fail) return -1;
  return logged(next(from_folder, from, to_folder, to, flags), "link", path, path_at(from_folder, from));
}
SHIM int link(const char* from, const char* to) { return linkat(AT_FDCWD, from, AT_FDCWD, to, 0); }

SHIM int unlinkat(int folder, const char* name, int flags) {
  static auto* const next = real<int(int, const char*, int)>("unlinkat");
  const std::string path = path_at(folder, name);
  if (decide("unlink", path, false) == Fate::fail) return -1;
  return logged(next(folder, name, flags), "unlink", path);
}
SHIM int unlink(const char* name) { return unlinkat(AT_FDCWD, name, 0); }
SHIM int rmdir(const char* name) { return unlinkat(AT_FDCWD, name, AT_REMOVEDIR); }

SHIM int ftruncate(int descriptor, off_t size) {
  static auto* const next = real<int(int, off_t)>("ftruncate");
  const std::string path = path_of(descriptor);
  if (decide("truncate", path, true) == Fate::fail) return -1;
  return logged(next(descriptor, size), "truncate", path);
}

SHIM int clock_gettime(clockid_t clock, timespec* time) {
  static auto* const next = real<int(clockid_t, timespec*)>("clock_gettime");
  const int result = next(clock, time);
  if (result != 0 || (clock != CLOCK_REALTIME && clock != CLOCK_REALTIME_COARSE)) return result;
  const Control* control = setting().control;
  if (control == nullptr || control->clock_step_ns == 0) return result;
  constexpr int64_t second = 1'000'000'000;
  const int64_t stepped = time->tv_sec * second + time->tv_nsec + control->clock_step_ns;
  time->tv_sec = stepped / second;
  time->tv_nsec = stepped % second;
  return result;
}

SHIM int gettimeofday(timeval* time, void*) {
  timespec now{};
  const int result = clock_gettime(CLOCK_REALTIME, &now);
  time->tv_sec = now.tv_sec;
  time->tv_usec = now.tv_nsec / 1000;
  return result;
}

SHIM time_t time(time_t* into) {
  timespec now{};
  clock_gettime(CLOCK_REALTIME, &now);
  if (into != nullptr) *into = now.tv_sec;
  return now.tv_sec;
}

}  // extern "C"
