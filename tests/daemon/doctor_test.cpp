#include "daemon/doctor.h"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <sys/stat.h>

#include <algorithm>
#include <fstream>
#include <iterator>
#include <regex>

#include "daemon/api/curve_keys.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

constexpr uint64_t gibibyte = uint64_t{1} << 30;

/// A machine that has all that the booth needs, in files below a scratch folder.
class Doctor : public testing::Test {
 protected:
  void SetUp() override {
    put("/etc/passwd", "root:x:0:0::/:\nbooth:x:900:900::/:\n");
    put("/etc/group", "video:x:44:booth\nbooth:x:900:\n");
    put("/etc/systemd/system/multi-user.target.wants/boothd.service", "");
    put("/etc/systemd/system.conf", "[Manager]\nRuntimeWatchdogSec=30s\n");
    put("/sys/class/watchdog/watchdog0/state", "active");
    put("/dev/video0", "", 0660);
    put("/dev/gpiochip0", "", 0660);
    put("/dev/dri/card0", "", 0660);
    put("/sys/class/drm/card0-HDMI-A-1/status", "connected\n");
    put("/sys/class/drm/card0-DP-1/status", "disconnected\n");
    put("/sys/module/uvcvideo/version", "1");
    put("/sys/module/usbcore/parameters/usbfs_memory_mb", "1000\n");
    put("/proc/sys/net/core/rmem_max", "33554432\n");
    put("/sys/class/net/lo/operstate", "up\n");
    put("/sys/class/net/eth0/operstate", "up\n");
    put("/sys/class/net/eth0/mtu", "9000\n");
    put("/usr/share/dlib/shape_predictor_68_face_landmarks.dat", "");
    put("/usr/share/opencv4/haarcascades/haarcascade_frontalface_alt2.xml", "");
    put("/var/lib/booth/calibration/rig.json", "{}");
    ASSERT_EQ(::chmod((folder_.path() / "var/lib/booth").c_str(), 0700), 0);
    put_background("2026-11-22T09:00:00Z");

    AravisCameraSettings gige;
    V4l2CameraSettings usb;
    usb.device = "/dev/video0";
    config_.cameras = {{"body-00", CameraRole::body, 0, gige}, {"body-01", CameraRole::body, 0, usb}};
    config_.trigger.driver = TriggerDriver::gpio;
    config_.trigger.gpio.trigger.chip = "/dev/gpiochip0";
    config_.projector.driver = ProjectorDriver::display;
    machine_.root = folder_.path();
    machine_.now = std::chrono::system_clock::from_time_t(1795341600);  // 2026-11-22T10:00:00Z
    machine_.clock_synchronised = true;
    machine_.free_bytes = [this](const fs::path&) { return free_; };
    touch_rig(std::chrono::hours(24));
  }

  void put(const std::string& path, const std::string& text, mode_t mode = 0644) {
    const fs::path file = folder_.path() / path.substr(1);
    fs::create_directories(file.parent_path());
    std::ofstream(file) << text;
    ASSERT_EQ(::chmod(file.c_str(), mode), 0);
  }
  void remove(const std::string& path) { fs::remove_all(folder_.path() / path.substr(1)); }
  void put_background(const std::string& created) {
    const fs::path sample = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";
    const fs::path folder = folder_.path() / "var/lib/booth/backgrounds/b";
    fs::create_directories(folder);
    fs::copy(sample, folder, fs::copy_options::recursive | fs::copy_options::overwrite_existing);
    std::ifstream file(sample / "recording.json");
    const std::string text((std::istreambuf_iterator<char>(file)), {});
    put("/var/lib/booth/backgrounds/b/recording.json",
        std::regex_replace(text, std::regex(R"("created": "[^"]*")"), R"("created": ")" + created + "\""));
  }
  void touch_rig(std::chrono::hours age) {
    const auto then = std::chrono::system_clock::to_time_t(machine_.now - age);
    const timespec times[2] = {{then, 0}, {then, 0}};
    ASSERT_EQ(::utimensat(AT_FDCWD, (folder_.path() / "var/lib/booth/calibration/rig.json").c_str(), times, 0), 0);
  }
  /// What is not in order, as "check: level".
  std::vector<std::string> complaints() {
    std::vector<std::string> found;
    for (const Finding& finding : examine(machine_, config_)) {
      if (finding.level == FindingLevel::ok) {
        EXPECT_THAT(finding.advice, IsEmpty()) << finding.check;
        continue;
      }
      EXPECT_THAT(finding.advice, testing::EndsWith(".")) << finding.check << " says what to do";
      EXPECT_THAT(finding.message, Not(IsEmpty()));
      found.push_back(finding.check + ": " + std::string(to_string(finding.level)));
    }
    return found;
  }
  void expect(const char* check, const char* level) {
    EXPECT_THAT(complaints(), testing::ElementsAre(std::string(check) + ": " + level));
  }

  const ScratchFolder folder_;
  BoothConfig config_;
  Machine machine_;
  std::optional<uint64_t> free_ = 100 * gibibyte;
};

TEST_F(Doctor, FindsNothingAmissInAGoodMachine) { EXPECT_THAT(complaints(), IsEmpty()); }

TEST_F(Doctor, NamesABadConfiguration) {
  const auto findings = examine(machine_, Error{ErrorCode::invalid_file, "disk.reserve: 1"});
  EXPECT_EQ(findings[0].level, FindingLevel::problem);
  EXPECT_EQ(findings[0].message, "disk.reserve: 1");
  EXPECT_GT(findings.size(), 10U) << "and goes on";
}

TEST_F(Doctor, WantsTheServicesUser) {
  put("/etc/passwd", "root:x:0:0::/:\nboothby:x:900:900::/:\n");
  expect("service", "problem");
}
TEST_F(Doctor, WantsTheGroupOfDevices) {
  put("/etc/group", "booth:x:900:\n");
  expect("service", "problem");
}
TEST_F(Doctor, WantsTheServiceEnabled) {
  remove("/etc/systemd/system/multi-user.target.wants");
  expect("service", "warning");
}
TEST_F(Doctor, MissesACamera) {
  remove("/dev/video0");
  expect("cameras", "problem");
}
TEST_F(Doctor, SeesACameraThatTheServiceMayNotUse) {
  put("/dev/video0", "", 0600);
  expect("cameras", "problem");
}
TEST_F(Doctor, CountsCamerasThatAreNamedBySerialNumber) {
  auto& usb = std::get<V4l2CameraSettings>(config_.cameras[1].driver);
  usb.device.clear();
  usb.serial = "A1";
  EXPECT_THAT(complaints(), IsEmpty());
  remove("/dev/video0");
  expect("cameras", "problem");
}
TEST_F(Doctor, TellsOfABoothThatPlaysARecording) {
  config_ = {};
  expect("cameras", "warning");
}
TEST_F(Doctor, MissesATriggerChip) {
  remove("/dev/gpiochip0");
  expect("lines", "problem");
  config_.trigger.gpio.trigger.chip = "a label";
  expect("lines", "problem");
}
TEST_F(Doctor, MissesTheProjector) {
  put("/sys/class/drm/card0-HDMI-A-1/status", "disconnected\n");
  expect("display", "problem");
}
TEST_F(Doctor, NamesTheOutputThatIsConnectedInstead) {
  config_.projector.display.connector = "DP-1";
  expect("display", "problem");
  const auto findings = examine(machine_, config_);
  const auto found = std::find_if(findings.begin(), findings.end(), [](const auto& f) { return f.check == "display"; });
  EXPECT_THAT(found->message, HasSubstr("HDMI-A-1"));
}
TEST_F(Doctor, MissesTheGraphicsDevice) {
  remove("/dev/dri");
  expect("display", "problem");
}
TEST_F(Doctor, MissesTheDriverOfUsbCameras) {
  remove("/sys/module/uvcvideo");
  expect("modules", "warning");
}
TEST_F(Doctor, WantsRoomForUsbFrames) {
  put("/sys/module/usbcore/parameters/usbfs_memory_mb", "16\n");
  expect("usb_memory", "warning");
  put("/sys/module/usbcore/parameters/usbfs_memory_mb", "0\n");
  EXPECT_THAT(complaints(), IsEmpty()) << "no limit";
}
TEST_F(Doctor, WantsSocketBuffers) {
  put("/proc/sys/net/core/rmem_max", "212992\n");
  expect("socket_buffers", "problem");
}
TEST_F(Doctor, WantsLargeFrames) {
  put("/sys/class/net/eth0/mtu", "1500\n");
  expect("network", "warning");
}
TEST_F(Doctor, WantsANetwork) {
  put("/sys/class/net/eth0/operstate", "down\n");
  expect("network", "problem");
}
TEST_F(Doctor, WatchesTheDisk) {
  free_ = 3 * gibibyte;
  expect("disk", "warning");
  free_ = gibibyte;
  expect("disk", "problem");
  free_.reset();
  expect("disk", "problem");
}
TEST_F(Doctor, WatchesTheClock) {
  machine_.clock_synchronised = false;
  expect("clock", "warning");
}
TEST_F(Doctor, WatchesTheCalibration) {
  touch_rig(std::chrono::hours(24 * 100));
  expect("calibration", "warning");
  remove("/var/lib/booth/calibration");
  expect("calibration", "problem");
}
TEST_F(Doctor, WatchesTheBackground) {
  put_background("2026-11-20T09:00:00Z");
  expect("background", "warning");
  config_.background.max_age_h = 0;
  EXPECT_THAT(complaints(), IsEmpty());
  remove("/var/lib/booth/backgrounds");
  expect("background", "warning");
}
TEST_F(Doctor, GuardsPeoplesPictures) {
  ASSERT_EQ(::chmod((folder_.path() / "var/lib/booth").c_str(), 0755), 0);
  expect("permissions", "problem");
}
TEST_F(Doctor, GuardsTheKeys) {
  config_.api.remote_control = "tcp://*:7411";
  expect("keys", "problem");
  const fs::path file = folder_.path() / "etc/booth/keys/server.key";
  fs::create_directories(file.parent_path());
  const auto keys = api::make_key_pair();
  ASSERT_TRUE(keys);
  ASSERT_TRUE(api::save_server_keys(file, *keys));
  EXPECT_THAT(complaints(), IsEmpty());
  put("/etc/booth/keys/clients/broken.json", "{");
  expect("keys", "problem");
  remove("/etc/booth/keys/clients");
  ASSERT_EQ(::chmod(file.c_str(), 0644), 0);
  expect("keys", "problem");
}
TEST_F(Doctor, MissesTheLandmarks) {
  remove("/usr/share/dlib");
  expect("landmark_model", "warning");
}
TEST_F(Doctor, MissesTheCascade) {
  remove("/usr/share/opencv4");
  expect("face_cascade", "warning");
}
TEST_F(Doctor, WantsTheMachinesWatchdogUsed) {
  put("/etc/systemd/system.conf", "#RuntimeWatchdogSec=30s\n");
  expect("watchdog", "warning");
  put("/etc/systemd/system.conf.d/booth.conf", "RuntimeWatchdogSec=10s\n");
  EXPECT_THAT(complaints(), IsEmpty());
}

}  // namespace
}  // namespace booth
