#include <gmock/gmock.h>
#include <signal.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstring>

#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::HasSubstr;

constexpr std::chrono::seconds watchdog{4};

/// boothd as systemd starts it: with a socket that hears what it says of itself, and a watchdog.
class Watchdog : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    const fs::path path = folder_.path() / "notify";
    socket_ = ::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, path.c_str(), sizeof(address.sun_path) - 1);
    ASSERT_EQ(::bind(socket_, reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
    const fs::path config = folder_.path() / "boothd.toml", log = folder_.path() / "log";
    std::ofstream(config) << write_config(options_.config);
    const std::string notify = "NOTIFY_SOCKET=" + path.string();
    const std::string limit =
        "WATCHDOG_USEC=" + std::to_string(std::chrono::duration_cast<std::chrono::microseconds>(watchdog).count());
    const std::string command = reconstruct_.path();
    boothd_ = ::fork();
    if (boothd_ == 0) {
      if (::freopen(log.c_str(), "a", stderr) == nullptr) ::_exit(127);
      ::execl("/usr/bin/env", "env", notify.c_str(), limit.c_str(), BOOTHD, "--config", config.c_str(), "--reconstruct",
              command.c_str(), nullptr);
      ::_exit(127);
    }
    ASSERT_TRUE(wait_until([&] { return hear() == "READY=1"; }));
  }
  void TearDown() override {
    if (boothd_ > 0) {
      ::kill(boothd_, SIGTERM);
      int status = 0;
      ::waitpid(boothd_, &status, 0);
      EXPECT_EQ(status, 0);
    }
    ::close(socket_);
  }
  /// What it says next; empty when it says nothing for a while.
  std::string hear(std::chrono::milliseconds patience = std::chrono::milliseconds(100)) const {
    const timeval limit{patience.count() / 1000, patience.count() % 1000 * 1000};
    ::setsockopt(socket_, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof(limit));
    std::array<char, 512> text{};
    const ssize_t size = ::recv(socket_, text.data(), text.size(), 0);
    return size > 0 ? std::string(text.data(), static_cast<size_t>(size)) : "";
  }
  /// Whether the watchdog is fed in time: it is twice a second, where nothing hangs.
  bool is_fed(std::chrono::milliseconds within = watchdog) const {
    const auto deadline = std::chrono::steady_clock::now() + within;
    while (std::chrono::steady_clock::now() < deadline)
      if (hear() == "WATCHDOG=1") return true;
    return false;
  }
  void forget_what_was_said() const {
    while (!hear(std::chrono::milliseconds(1)).empty()) {
    }
  }
  std::vector<pid_t> threads(const std::string& name) const {
    std::vector<pid_t> found;
    for (const auto& entry : fs::directory_iterator("/proc/" + std::to_string(boothd_) + "/task")) {
      std::string comm;
      std::getline(std::ifstream(entry.path() / "comm") >> std::ws, comm);
      if (comm == name) found.push_back(std::stoi(entry.path().filename()));
    }
    return found;
  }

  int socket_ = -1;
  pid_t boothd_ = -1;
};

TEST_F(Watchdog, IsFedWhileEveryVitalThreadLives) {
  EXPECT_TRUE(is_fed());
  for (const char* name : {"api", "house", "capture", "jobs", "disk"}) {
    const auto found = threads(name);
    ASSERT_FALSE(found.empty()) << name;
    // A debugger's stop holds this one thread as a hang would.
    if (::ptrace(PTRACE_ATTACH, found[0], nullptr, nullptr) != 0) GTEST_SKIP() << "threads may not be stopped here";
    ASSERT_EQ(::waitpid(found[0], nullptr, __WALL), found[0]);
    // Its last sign of life is half of the time young at most; what was said before does not count.
    std::this_thread::sleep_for(watchdog / 2 + std::chrono::seconds(1));
    forget_what_was_said();
    EXPECT_FALSE(is_fed(std::chrono::milliseconds(1500))) << name << " hangs";
    ASSERT_EQ(::ptrace(PTRACE_DETACH, found[0], nullptr, nullptr), 0);
    EXPECT_TRUE(wait_until([&] { return hear() == "WATCHDOG=1"; })) << name << " is back";
  }
}

TEST_F(Watchdog, TheStatusLineSaysWhatTheBoothDoes) {
  std::string status;
  ASSERT_TRUE(wait_until([&] {
    status = hear();
    return status.starts_with("STATUS=") && status.find("idle, ready") != std::string::npos;
  }));
  ::kill(boothd_, SIGTERM);
  ASSERT_TRUE(wait_until([&] {
    status = hear();
    return status.starts_with("STOPPING=1");
  }));
  EXPECT_THAT(status, HasSubstr("STATUS=stopping"));
  int code = 0;
  ::waitpid(boothd_, &code, 0);
  boothd_ = -1;
  EXPECT_EQ(code, 0);
}

}  // namespace
}  // namespace booth::test
