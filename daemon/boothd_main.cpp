// boothd: the booth's service.

#include <poll.h>
#include <signal.h>
#include <spdlog/spdlog.h>
#include <sys/resource.h>
#include <sys/signalfd.h>
#include <systemd/sd-daemon.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <string>
#include <system_error>

#include "config/booth_config.h"
#include "config/migration.h"
#include "daemon/api/server.h"
#include "daemon/booth.h"
#include "daemon/log.h"
#include "daemon/wakeup.h"
#include "drivers/clock.h"
#include "drivers/gpio/gpio_devices.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr int exit_failed = 1;
constexpr int exit_config = 2;  ///< systemd does not try again, see the unit
constexpr std::chrono::milliseconds tick{500};
/// A thread that gave no sign of life for so long hangs: the watchdog is no longer fed. Where systemd says after what
/// time it bites, half of that.
constexpr std::chrono::microseconds default_silence = std::chrono::seconds(30);

struct Arguments {
  std::string config_file, reconstruct_command;
  bool check = false, rest = false, migrate = false;
};

/// Signals that end the service come through a descriptor. To be made before any other thread.
class SignalDescriptor {
 public:
  SignalDescriptor() {
    sigset_t signals;
    sigemptyset(&signals);
    for (const int signal : {SIGTERM, SIGINT}) sigaddset(&signals, signal);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);
    ::signal(SIGPIPE, SIG_IGN);
    fd_ = ::signalfd(-1, &signals, SFD_CLOEXEC | SFD_NONBLOCK);
    if (fd_ < 0) throw std::system_error(errno, std::generic_category(), "signalfd");
  }
  ~SignalDescriptor() { ::close(fd_); }
  SignalDescriptor(const SignalDescriptor&) = delete;
  SignalDescriptor& operator=(const SignalDescriptor&) = delete;
  int get() const { return fd_; }

 private:
  int fd_ = -1;
};

/// Each client and each camera takes descriptors; the default is meant for programs that use select().
void allow_many_descriptors() {
  rlimit limit{};
  if (::getrlimit(RLIMIT_NOFILE, &limit) != 0) return;
  limit.rlim_cur = limit.rlim_max;
  if (::setrlimit(RLIMIT_NOFILE, &limit) != 0) spdlog::info("the limit of open files stays as it is");
}

fs::path beside_this_program(const char* name) {
  std::error_code code;
  return fs::read_symlink("/proc/self/exe", code).parent_path() / name;
}

/// One line for `systemctl status`.
std::string summary_of(const BoothStatus& status) {
  std::string text = std::string(to_string(status.state)) + (status.not_ready.empty() ? ", ready" : ", not ready: ");
  if (!status.not_ready.empty()) text += status.not_ready.front().message;
  if (!status.queue.empty()) text += "; jobs: " + std::to_string(status.queue.size());
  return text;
}

/// Until a signal or a client ends it.
void watch(const Booth& booth, const api::Server& server, const SignalDescriptor& signals, const Wakeup& shut_down) {
  uint64_t watchdog_us = 0;
  const auto longest_silence =
      sd_watchdog_enabled(0, &watchdog_us) > 0 ? std::chrono::microseconds(watchdog_us / 2) : default_silence;
  std::string told;
  for (;;) {
    std::array<pollfd, 2> polled{pollfd{signals.get(), POLLIN, 0}, pollfd{shut_down.fd(), POLLIN, 0}};
    if (::poll(polled.data(), polled.size(), static_cast<int>(tick.count())) > 0) return;
    const auto silent_since = std::min(booth.last_pulse(), server.last_pulse());
    if (std::chrono::steady_clock::now() - silent_since > longest_silence) {
      spdlog::error("a thread of the booth hangs");
      continue;
    }
    sd_notify(0, "WATCHDOG=1");
    if (const std::string summary = summary_of(booth.status()); summary != told) {
      sd_notify(0, ("STATUS=" + summary).c_str());
      told = summary;
    }
  }
}

/// The server's key, where systemd hands it over: its own copy, which only this service can read.
void prefer_credential(ApiConfig& api) {
  const char* const folder = std::getenv("CREDENTIALS_DIRECTORY");
  if (folder == nullptr) return;
  const fs::path file = fs::path(folder) / "server.key";
  // A key is a JSON object; the unit's default, for a booth without remote clients, is not.
  if (std::ifstream(file).peek() == '{') api.server_key = file;
}

/// What a service that was killed may have left on: the trigger, the lights, a stepped projector's pattern. A display
/// goes dark by itself when its program ends.
int bring_to_rest(const BoothConfig& config) {
  const bool trigger = config.trigger.driver == TriggerDriver::gpio;
  const bool projector = config.projector.driver == ProjectorDriver::gpio;
  const auto rested = rest_gpio_lines(trigger ? &config.trigger.gpio : nullptr,
                                      projector ? &config.projector.gpio : nullptr, MonotonicClock());
  if (rested) return 0;
  spdlog::error("{}", rested.error().message);
  return exit_failed;
}

/// Brings the file up to date where it is older. @return whether it is now
bool migrate(const fs::path& file) {
  const auto migrated = migrate_config_file(file);
  if (migrated) {
    if (!migrated->empty()) spdlog::info("{}", *migrated);
    return true;
  }
  if (migrated.error().code == ErrorCode::unsupported) {
    spdlog::error("{}", migrated.error().message);
    return false;
  }
  spdlog::warn(
      "{}; the configuration is of an older version, and is used as it would be migrated: call boothd --migrate with "
      "the "
      "right to change it",
      migrated.error().message);
  return false;
}

int run(const Arguments& arguments) {
  BoothOptions options;
  options.reconstruct_command = arguments.reconstruct_command.empty() ? beside_this_program("booth-reconstruct")
                                                                      : fs::absolute(arguments.reconstruct_command);
  options.calibrate_command = beside_this_program("booth-calibrate");
  set_up_log(LogLevel::info);
  if (!arguments.config_file.empty()) {
    options.config_file = fs::absolute(arguments.config_file);
    if (arguments.migrate) return migrate(options.config_file) ? 0 : exit_config;
    auto config = load_config(options.config_file);
    if (!config) {
      spdlog::error("{}", config.error().message);
      return exit_config;
    }
    options.config = std::move(*config);
    if (!arguments.check && !arguments.rest) migrate(options.config_file);
  }
  set_up_log(options.config.log.level);
  if (arguments.rest) return bring_to_rest(options.config);
  prefer_credential(options.config.api);
  if (::access(options.reconstruct_command.c_str(), X_OK) != 0) {
    spdlog::error("{}: cannot be executed", options.reconstruct_command.string());
    return exit_config;
  }
  if (arguments.check) {
    std::cout << "the configuration is good\n";
    return 0;
  }

  allow_many_descriptors();
  const SignalDescriptor signals;
  const MonotonicClock clock;
  Wakeup shut_down;
  auto opened = Booth::open(options, open_devices(options.config, clock), clock);
  if (!opened) {
    spdlog::error("{}", opened.error().message);
    return exit_failed;
  }
  Booth& booth = **opened;
  auto server = api::Server::start(options.config.api, booth, [&shut_down] { shut_down.signal(); });
  if (!server) {
    spdlog::error("{}", server.error().message);
    return exit_failed;
  }
  spdlog::info("boothd {} serves {}", BOOTH_VERSION, options.config.api.control);
  sd_notify(0, "READY=1");
  watch(booth, **server, signals, shut_down);

  spdlog::info("stopping");
  sd_notify(0, "STOPPING=1\nSTATUS=stopping");
  booth.drain();
  server->reset();  // after the last events
  opened->reset();
  spdlog::info("stopped");
  return 0;
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  booth::Arguments arguments;
  CLI::App app("The booth's service: cameras, captures, reconstructions, avatars, and the interface to them.",
               "boothd");
  app.add_option("--config", arguments.config_file, "configuration file; without it, the defaults");
  app.add_option("--reconstruct", arguments.reconstruct_command,
                 "program that makes avatars; by default booth-reconstruct beside this one");
  app.add_flag("--check", arguments.check, "only check the configuration");
  app.add_flag("--migrate", arguments.migrate, "only bring an older configuration file up to date")
      ->needs(app.get_option("--config"));
  app.add_flag("--rest", arguments.rest, "only bring output lines to rest, after a service that was killed");
  app.set_version_flag("--version", BOOTH_VERSION);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? 0 : booth::exit_config;
  }
  try {
    return booth::run(arguments);
  } catch (const std::exception& fault) {
    spdlog::critical("{}", fault.what());
    return booth::exit_failed;
  }
}
