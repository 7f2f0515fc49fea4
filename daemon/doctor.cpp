#include "daemon/doctor.h"

#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/timex.h>

#include <algorithm>
#include <fstream>
#include <iterator>
#include <optional>
#include <system_error>
#include <utility>

#include "daemon/api/curve_keys.h"
#include "daemon/identifier.h"
#include "replay/recording.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using SystemClock = std::chrono::system_clock;

constexpr uint64_t mebibyte = 1024 * 1024;
constexpr int usbfs_wanted_mib = 1000;
constexpr int jumbo_mtu = 8000;  ///< frames of 9000 bytes, less what switches take
constexpr std::chrono::hours day{24};
constexpr int calibration_days = 90;  ///< after which mounts have settled and somebody has leaned on a camera

std::string read_text(const fs::path& file) {
  std::ifstream stream(file);
  std::string text((std::istreambuf_iterator<char>(stream)), {});
  while (!text.empty() && text.back() == '\n') text.pop_back();
  return text;
}

std::optional<int64_t> read_number(const fs::path& file) {
  std::ifstream stream(file);
  int64_t number = 0;
  if (!(stream >> number)) return std::nullopt;
  return number;
}

std::vector<fs::path> entries(const fs::path& folder, const std::string& prefix = "") {
  std::vector<fs::path> found;
  std::error_code code;
  for (fs::directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code))
    if (entry->path().filename().string().starts_with(prefix)) found.push_back(entry->path());
  std::sort(found.begin(), found.end());
  return found;
}

bool is_there(const fs::path& file) {
  std::error_code code;
  return fs::exists(file, code);
}

std::string in_mebibytes(uint64_t bytes) { return std::to_string(bytes / mebibyte) + " MiB"; }

std::string in_days(std::chrono::seconds age) {
  return std::to_string(std::chrono::duration_cast<std::chrono::hours>(age) / day) + " days";
}

class Examination {
 public:
  Examination(const Machine& machine, const BoothConfig& config) : machine_(machine), config_(config) {
    for (const CameraConfig& camera : config.cameras) {
      aravis_ |= std::holds_alternative<AravisCameraSettings>(camera.driver);
      v4l2_ |= std::holds_alternative<V4l2CameraSettings>(camera.driver);
    }
  }

  std::vector<Finding> run() {
    service();
    cameras();
    trigger_lines();
    display();
    modules();
    usb_memory();
    socket_buffers();
    network();
    disk();
    clock();
    calibration();
    background();
    permissions();
    keys();
    landmark_model();
    face_cascade();
    watchdog();
    return std::move(findings_);
  }

 private:
  void ok(const char* check, std::string message) {
    findings_.push_back({check, FindingLevel::ok, std::move(message), ""});
  }
  void warn(const char* check, std::string message, std::string advice) {
    findings_.push_back({check, FindingLevel::warning, std::move(message), std::move(advice)});
  }
  void problem(const char* check, std::string message, std::string advice) {
    findings_.push_back({check, FindingLevel::problem, std::move(message), std::move(advice)});
  }
  /// Where a path of the machine is.
  fs::path at(const fs::path& path) const { return machine_.root / path.relative_path(); }

  /// Whether a line of /etc/passwd or /etc/group is of that name.
  bool has_account(const char* file, const std::string& name) const {
    std::ifstream stream(at(file));
    for (std::string line; std::getline(stream, line);)
      if (line.starts_with(name + ":")) return true;
    return false;
  }

  void service() {
    if (!has_account("/etc/passwd", "booth") || !has_account("/etc/group", "booth"))
      return problem("service", "there is no user or no group booth",
                     "Install the package again, or run systemd-sysusers with its file booth.conf.");
    if (!has_account("/etc/group", "video"))
      return problem("service", "there is no group video, to which cameras and displays belong",
                     "Run addgroup --system video.");
    if (!is_there(at("/etc/systemd/system/multi-user.target.wants/boothd.service")) &&
        !fs::is_symlink(at("/etc/systemd/system/multi-user.target.wants/boothd.service")))
      return warn("service", "boothd does not start with the machine", "Run systemctl enable --now boothd.");
    ok("service", "boothd starts with the machine, as the user booth");
  }

  /// Devices belong to the group video, which the service is in.
  void device(const char* check, const std::string& who, const fs::path& node, const std::string& if_missing) {
    struct stat status {};
    if (::stat(at(node).c_str(), &status) != 0)
      return problem(check, who + ": " + node.string() + " is not there", if_missing);
    constexpr mode_t group_uses = S_IRGRP | S_IWGRP;
    if ((status.st_mode & group_uses) != group_uses)
      return problem(check, who + ": its group may not use " + node.string(),
                     "Install the package's udev rules, and run udevadm trigger.");
    ok(check, who + ": " + node.string());
  }

  void cameras() {
    if (config_.cameras.empty())
      return warn("cameras", "no camera is configured: the booth plays a recording",
                  "List the cameras in the configuration; boothctl discover shows what the drivers see.");
    const size_t nodes = entries(at("/dev"), "video").size();
    size_t unnamed = 0;
    for (const CameraConfig& camera : config_.cameras)
      if (const auto* usb = std::get_if<V4l2CameraSettings>(&camera.driver)) {
        if (usb->device.empty())
          ++unnamed;
        else
          device("cameras", camera.id, usb->device, "Plug it in, or correct its device in the configuration.");
      }
    if (unnamed > nodes)
      problem("cameras",
              std::to_string(unnamed) + " USB cameras are configured, and " + std::to_string(nodes) +
                  " video devices are there",
              "Check cables and power; boothctl discover names those that are there.");
    else
      ok("cameras", std::to_string(config_.cameras.size()) + " are configured, " + std::to_string(nodes) +
                        " video devices are there");
  }

  void trigger_lines() {
    std::vector<std::pair<std::string, std::string>> chips;
    if (config_.trigger.driver == TriggerDriver::gpio) {
      chips.emplace_back("the trigger", config_.trigger.gpio.trigger.chip);
      if (config_.trigger.gpio.lights) chips.emplace_back("the lights", config_.trigger.gpio.lights->chip);
    }
    if (config_.projector.driver == ProjectorDriver::gpio)
      chips.emplace_back("the projector", config_.projector.gpio.step.chip);
    if (chips.empty()) return ok("lines", "no GPIO line is used");
    const bool any = !entries(at("/dev"), "gpiochip").empty();
    for (const auto& [who, chip] : chips)
      if (chip.starts_with("/"))
        device("lines", who, chip, "Correct the chip in the configuration; gpiodetect lists them.");
      else if (any)
        ok("lines", who + ": the chip " + chip + ", by its label");
      else
        problem("lines", who + ": the machine has no GPIO chip",
                "Load the driver of the board that holds the lines; gpiodetect lists the chips.");
  }

  void display() {
    if (config_.projector.driver != ProjectorDriver::display) return ok("display", "no display output is used");
    if (entries(at("/dev/dri"), "card").empty())
      return problem("display", "the machine has no graphics device",
                     "Install the firmware of the graphics card, and look at dmesg.");
    const std::string& wanted = config_.projector.display.connector;
    std::string connected;
    for (const fs::path& connector : entries(at("/sys/class/drm"), "card")) {
      const std::string name = connector.filename().string();
      const size_t dash = name.find('-');
      if (dash == std::string::npos || read_text(connector / "status") != "connected") continue;
      if (wanted.empty() || name.substr(dash + 1) == wanted)
        return ok("display", "the projector is connected to " + name.substr(dash + 1));
      connected += (connected.empty() ? "" : ", ") + name.substr(dash + 1);
    }
    problem("display",
            (wanted.empty() ? "nothing is connected to any output"
                            : "nothing is connected to the output " + wanted +
                                  (connected.empty() ? "" : "; connected: " + connected)),
            "Switch the projector on and check its cable, or correct projector.display.connector.");
  }

  void modules() {
    if (!v4l2_) return ok("modules", "no kernel module is needed");
    if (is_there(at("/sys/module/uvcvideo"))) return ok("modules", "uvcvideo is loaded");
    warn("modules", "uvcvideo, the driver of USB cameras, is not loaded",
         "Plug a camera in, or run modprobe uvcvideo; where that fails, install the kernel's extra modules.");
  }

  void usb_memory() {
    if (!aravis_) return ok("usb_memory", "no USB3 Vision camera is configured");
    const auto mib = read_number(at("/sys/module/usbcore/parameters/usbfs_memory_mb"));
    if (!mib) return warn("usb_memory", "the kernel does not tell its limit for USB buffers", "Look for usbcore.");
    if (*mib != 0 && *mib < usbfs_wanted_mib)
      return warn("usb_memory", "USB3 Vision cameras share " + std::to_string(*mib) + " MiB of buffers",
                  "Write 1000 to /sys/module/usbcore/parameters/usbfs_memory_mb, as the package's tmpfiles do.");
    ok("usb_memory", std::to_string(*mib) + " MiB of buffers");
  }

  void socket_buffers() {
    int wanted_kib = 0;
    for (const CameraConfig& camera : config_.cameras)
      if (const auto* gige = std::get_if<AravisCameraSettings>(&camera.driver))
        wanted_kib = std::max(wanted_kib, gige->socket_buffer_kib);
    if (wanted_kib == 0) return ok("socket_buffers", "no network camera is configured");
    const auto most = read_number(at("/proc/sys/net/core/rmem_max"));
    const int64_t wanted = int64_t{1024} * wanted_kib;
    if (!most) return warn("socket_buffers", "the kernel does not tell its limit", "Look at sysctl net.core.rmem_max.");
    if (*most < wanted)
      return problem("socket_buffers",
                     "net.core.rmem_max is " + std::to_string(*most) + ", cameras want " + std::to_string(wanted) +
                         ": packets will be lost",
                     "Run sysctl -w net.core.rmem_max=" + std::to_string(wanted) +
                         ", and install the package's sysctl file to keep it.");
    ok("socket_buffers", "up to " + std::to_string(*most) + " bytes");
  }

  void network() {
    if (!aravis_) return ok("network", "no network camera is configured");
    std::string small, large;
    for (const fs::path& interface : entries(at("/sys/class/net"))) {
      const std::string name = interface.filename().string();
      if (name == "lo" || read_text(interface / "operstate") != "up") continue;
      const auto mtu = read_number(interface / "mtu");
      std::string& list = mtu && *mtu >= jumbo_mtu ? large : small;
      list += (list.empty() ? "" : ", ") + name + " (" + (mtu ? std::to_string(*mtu) : "?") + ")";
    }
    if (small.empty() && large.empty())
      return problem("network", "no network interface is up", "Plug the cameras' network in, and see ip link.");
    if (large.empty())
      return warn("network", "no interface takes large frames: " + small,
                  "Set the MTU of the cameras' interface and switch to 9000, which takes load off the processor.");
    ok("network", "large frames on " + large);
  }

  void disk() {
    const fs::path& state = config_.booth.state_directory;
    fs::path folder = at(state);
    std::error_code code;
    while (!fs::exists(folder, code) && folder.has_relative_path()) folder = folder.parent_path();
    const auto free = machine_.free_bytes(folder);
    if (!free) return problem("disk", state.string() + ": its disk does not answer", "Check the mount and the disk.");
    const uint64_t reserve = static_cast<uint64_t>(config_.disk.reserve_mib) * mebibyte;
    const std::string seen = in_mebibytes(*free) + " are free for " + state.string();
    if (*free < reserve)
      return problem("disk", seen + ", at least " + in_mebibytes(reserve) + " must be: no capture starts",
                     "Delete avatars with boothctl avatars delete, or make room.");
    if (*free < 2 * reserve)
      return warn("disk", seen + ", near to the reserve of " + in_mebibytes(reserve),
                  "Delete avatars soon, or make room.");
    ok("disk", seen);
  }

  void clock() {
    if (!machine_.clock_synchronised)
      return warn("clock", "the clock is not synchronised: names and dates of captures may be wrong",
                  "Install systemd-timesyncd or chrony, or set the clock by hand where there is no network.");
    ok("clock", "synchronised");
  }

  void calibration() {
    if (config_.cameras.empty()) return ok("calibration", "the recording brings its own");
    struct stat status {};
    if (::stat(at(config_.booth.rig()).c_str(), &status) != 0)
      return problem("calibration", "the booth is not calibrated: " + config_.booth.rig().string() + " is not there",
                     "Print a board with boothctl board, capture it, and run boothctl calibrate.");
    const auto age =
        std::chrono::duration_cast<std::chrono::seconds>(machine_.now - SystemClock::from_time_t(status.st_mtime));
    if (age > calibration_days * day)
      return warn("calibration", "the calibration is " + in_days(age) + " old", "Calibrate again.");
    ok("calibration", in_days(age) + " old");
  }

  void background() {
    if (config_.cameras.empty()) return ok("background", "the recording brings its own");
    std::optional<SystemClock::time_point> newest;
    for (const fs::path& folder : entries(at(config_.booth.backgrounds()))) {
      if (folder.filename().string().starts_with(".")) continue;
      if (const auto recording = read_recording(folder))
        if (const auto created = parse_iso8601(recording->created))
          newest = std::max(newest.value_or(*created), *created);
    }
    if (!newest)
      return warn("background", "the empty booth was never learned",
                  "Run boothctl background learn with nobody in the booth.");
    const auto age = std::chrono::duration_cast<std::chrono::seconds>(machine_.now - *newest);
    const int limit_h = config_.background.max_age_h;
    if (limit_h > 0 && age > std::chrono::hours(limit_h))
      return warn("background", "it was learned " + in_days(age) + " ago",
                  "Run boothctl background learn with nobody in the booth.");
    ok("background", "learned within the last " + std::to_string(limit_h) + " hours");
  }

  void permissions() {
    const fs::path& state = config_.booth.state_directory;
    struct stat status {};
    if (::stat(at(state).c_str(), &status) != 0)
      return warn("permissions", state.string() + " is not there yet", "Start boothd, which makes it.");
    if ((status.st_mode & 077U) != 0)
      return problem("permissions", state.string() + ": others than the service may look at people's pictures",
                     "Run chmod 700 " + state.string() + ".");
    ok("permissions", state.string() + " is open to the service alone");
  }

  void keys() {
    const ApiConfig& api = config_.api;
    bool remote = false;
    for (const std::string& endpoint : {api.control, api.events, api.remote_control, api.remote_events})
      remote |= endpoint.starts_with("tcp://");
    const fs::path file = at(api.server_key);
    if (!remote && !is_there(file)) return ok("keys", "no other machine may connect");
    if (const auto read = api::read_server_keys(file); !read)
      return problem("keys", read.error().message, "Make a new one with boothctl keys server --replace.");
    const auto clients = api::read_allowed_clients(at(api.client_keys));
    for (const std::string& fault : clients.faults)
      problem("keys", fault, "Remove the file, and add the client again with boothctl keys add.");
    if (clients.faults.empty())
      ok("keys", std::to_string(clients.clients.size()) + " clients may connect over the network");
  }

  void landmark_model() {
    if (is_there(at(config_.face.landmark_model))) return ok("landmark_model", config_.face.landmark_model.string());
    warn("landmark_model",
         config_.face.landmark_model.string() + " is not there: faces without a projector stay the hull's own",
         "Install libdlib-data, or name another in [face].");
  }

  void face_cascade() {
    if (is_there(at(config_.face.cascade))) return ok("face_cascade", config_.face.cascade.string());
    warn("face_cascade",
         config_.face.cascade.string() + " is not there: a scanned face is looked for by the body's shape alone",
         "Install opencv-data, or name another in [face].");
  }

  /// The service's own watchdog notices when boothd hangs; the machine's, when the kernel does.
  void watchdog() {
    if (entries(at("/sys/class/watchdog"), "watchdog").empty())
      return ok("watchdog", "systemd watches over boothd; the machine has no watchdog of its own");
    std::vector<fs::path> files = entries(at("/etc/systemd/system.conf.d"));
    files.push_back(at("/etc/systemd/system.conf"));
    for (const fs::path& file : files) {
      std::ifstream stream(file);
      for (std::string line; std::getline(stream, line);)
        if (line.starts_with("RuntimeWatchdogSec=") && !line.ends_with("=0") && !line.ends_with("=off"))
          return ok("watchdog", "the machine restarts when its kernel hangs");
    }
    warn("watchdog", "the machine's watchdog is not used: should the kernel hang, somebody must pull the plug",
         "Set RuntimeWatchdogSec=30s in /etc/systemd/system.conf.");
  }

  const Machine& machine_;
  const BoothConfig& config_;
  bool aravis_ = false, v4l2_ = false;
  std::vector<Finding> findings_;
};

}  // namespace

std::string_view to_string(FindingLevel level) {
  switch (level) {
    case FindingLevel::ok: return "ok";
    case FindingLevel::warning: return "warning";
    case FindingLevel::problem: return "problem";
  }
  return "";
}

Machine this_machine() {
  timex time{};
  const int state = ::adjtimex(&time);
  return {.root = "/",
          .now = SystemClock::now(),
          .clock_synchronised = state >= 0 && state != TIME_ERROR && (time.status & STA_UNSYNC) == 0,
          .free_bytes = [](const fs::path& folder) -> std::optional<uint64_t> {
            struct statvfs space {};
            if (::statvfs(folder.c_str(), &space) != 0) return std::nullopt;
            return static_cast<uint64_t>(space.f_bavail) * space.f_frsize;
          }};
}

std::vector<Finding> examine(const Machine& machine, const Result<BoothConfig>& config) {
  std::vector<Finding> findings;
  if (config)
    findings.push_back({"configuration", FindingLevel::ok, "every key and value is understood", ""});
  else
    findings.push_back({"configuration", FindingLevel::problem, config.error().message,
                        "Correct it; boothd --config FILE --check says when it is good."});
  const BoothConfig by_default;
  std::vector<Finding> more = Examination(machine, config ? *config : by_default).run();
  findings.insert(findings.end(), std::make_move_iterator(more.begin()), std::make_move_iterator(more.end()));
  return findings;
}

}  // namespace booth
