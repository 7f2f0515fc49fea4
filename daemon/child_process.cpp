#include "daemon/child_process.h"

#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <fstream>
#include <string>
#include <system_error>
#include <utility>

namespace booth {
namespace {

constexpr int progress_number = 3;  ///< the descriptor on which the child reports
/// The kernel takes the child before the daemon when memory runs out.
constexpr std::string_view out_of_memory_score = "500";
constexpr int niceness = 10;  ///< captures and answers go before

struct Pipe {
  int read = -1, write = -1;
};

std::optional<Pipe> make_pipe() {
  std::array<int, 2> ends{};
  if (::pipe2(ends.data(), O_CLOEXEC) != 0) return std::nullopt;
  return Pipe{ends[0], ends[1]};
}

/// What a child reads as its standard input.
std::optional<Pipe> make_input(ChildProcess::Input input) {
  if (input == ChildProcess::Input::empty) {
    const int null = ::open("/dev/null", O_RDONLY | O_CLOEXEC);
    return null < 0 ? std::nullopt : std::optional(Pipe{null, -1});
  }
  std::array<int, 2> ends{};
  if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends.data()) != 0) return std::nullopt;
  ::shutdown(ends[0], SHUT_WR);
  return Pipe{ends[0], ends[1]};
}

void close_all(std::initializer_list<int> descriptors) {
  for (const int descriptor : descriptors)
    if (descriptor >= 0) ::close(descriptor);
}

void write_errno(int descriptor) {
  const int number = errno;
  // Nobody is left to tell when this fails; the parent then sees the exit status.
  [[maybe_unused]] const ssize_t written = ::write(descriptor, &number, sizeof number);
}

/// Between fork and exec only async-signal-safe functions may be called: other threads' locks were copied locked.
[[noreturn]] void become(char* const* arguments, pid_t parent, int input, int progress, int output, int fault) {
  constexpr int exec_failed = 127;
  ::setpgid(0, 0);
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (::getppid() != parent) ::_exit(exec_failed);  // the daemon died before the line above

  // Nor does it take the processor from the daemon when that wakes up. Where either is refused, the job runs all the
  // same.
  ::setpriority(PRIO_PROCESS, 0, niceness);
  const sched_param batch{};
  ::sched_setscheduler(0, SCHED_BATCH, &batch);

  sigset_t none;
  sigemptyset(&none);
  ::sigprocmask(SIG_SETMASK, &none, nullptr);
  ::signal(SIGPIPE, SIG_DFL);

  if (const int score = ::open("/proc/self/oom_score_adj", O_WRONLY | O_CLOEXEC); score >= 0) {
    [[maybe_unused]] const ssize_t written = ::write(score, out_of_memory_score.data(), out_of_memory_score.size());
    ::close(score);
  }

  // The numbers used below must not be among those about to be overwritten.
  constexpr int above = progress_number + 2;
  const int moved_input = ::fcntl(input, F_DUPFD_CLOEXEC, above);
  const int moved_progress = ::fcntl(progress, F_DUPFD_CLOEXEC, above);
  const int moved_output = ::fcntl(output, F_DUPFD_CLOEXEC, above);
  const int moved_fault = ::fcntl(fault, F_DUPFD_CLOEXEC, above);
  if (moved_input < 0 || moved_progress < 0 || moved_output < 0 || moved_fault < 0 ||
      ::dup2(moved_input, STDIN_FILENO) < 0 || ::dup2(moved_output, STDOUT_FILENO) < 0 ||
      ::dup2(moved_output, STDERR_FILENO) < 0 || ::dup2(moved_progress, progress_number) < 0) {
    write_errno(fault);
    ::_exit(exec_failed);
  }
  // Some library may have opened a descriptor without close-on-exec.
  ::close_range(progress_number + 1, ~0U, CLOSE_RANGE_CLOEXEC);
  ::execv(arguments[0], arguments);
  write_errno(moved_fault);
  ::_exit(exec_failed);
}

}  // namespace

Result<ChildProcess> ChildProcess::start(const std::vector<std::string>& command, Input kind) {
  const auto input = make_input(kind);
  const auto progress = make_pipe();
  const auto output = make_pipe();
  const auto fault = make_pipe();  // closed by a successful exec, else it says why there was none
  const auto give_up = [&](const std::string& doing, int number) {
    for (const auto& ends : {input, progress, output, fault})
      if (ends) close_all({ends->read, ends->write});
    return Error{number == ENOENT || number == EACCES ? ErrorCode::not_found : ErrorCode::io,
                 command.front() + ": " + doing + ": " + std::generic_category().message(number)};
  };
  if (!input || !progress || !output || !fault) return give_up("no pipe", errno);

  std::vector<std::string> texts = command;
  std::vector<char*> arguments;
  for (std::string& text : texts) arguments.push_back(text.data());
  arguments.push_back(nullptr);

  const pid_t parent = ::getpid();
  const pid_t pid = ::fork();
  if (pid < 0) return give_up("cannot be started", errno);
  if (pid == 0) become(arguments.data(), parent, input->read, progress->write, output->write, fault->write);
  ::setpgid(pid, pid);  // whoever comes first, parent or child
  close_all({input->read, progress->write, output->write, fault->write});

  ChildProcess child;
  child.pid_ = pid;
  child.input_ = input->write;
  child.progress_ = progress->read;
  child.output_ = output->read;
  for (const int descriptor : {child.progress_, child.output_}) ::fcntl(descriptor, F_SETFL, O_NONBLOCK);

  int number = 0;
  ssize_t got = 0;
  do got = ::read(fault->read, &number, sizeof number);
  while (got < 0 && errno == EINTR);
  ::close(fault->read);
  if (got == sizeof number)
    return Error{number == ENOENT || number == EACCES ? ErrorCode::not_found : ErrorCode::io,
                 command.front() + ": cannot be executed: " + std::generic_category().message(number)};
  return child;
}

ChildProcess::ChildProcess(ChildProcess&& other) noexcept
    : pid_(std::exchange(other.pid_, -1)),
      progress_(std::exchange(other.progress_, -1)),
      output_(std::exchange(other.output_, -1)),
      input_(std::exchange(other.input_, -1)),
      status_(other.status_) {}

ChildProcess::~ChildProcess() {
  if (pid_ > 0 && !status_) {
    kill();
    int status = 0;
    while (::waitpid(pid_, &status, 0) < 0 && errno == EINTR) {
    }
  }
  close_all({input_, progress_, output_});
}

bool ChildProcess::tell(std::string_view text) {
  const ssize_t sent = ::send(input_, text.data(), text.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
  return sent == static_cast<ssize_t>(text.size());
}

void ChildProcess::kill() noexcept {
  // A child that was waited for has given its number back.
  if (pid_ > 0 && !status_) ::kill(-pid_, SIGKILL);
}

uint64_t ChildProcess::resident_bytes() const {
  std::ifstream file("/proc/" + std::to_string(pid_) + "/statm");
  uint64_t pages = 0, resident_pages = 0;
  if (!(file >> pages >> resident_pages)) return 0;
  return resident_pages * static_cast<uint64_t>(::sysconf(_SC_PAGESIZE));
}

std::optional<int> ChildProcess::poll_status() {
  if (status_ || pid_ <= 0) return status_;
  int status = 0;
  const pid_t ended = ::waitpid(pid_, &status, WNOHANG);
  if (ended != pid_) return std::nullopt;
  ::kill(-pid_, SIGKILL);  // what it may have started itself
  return status_ = status;
}

}  // namespace booth
