#include <sys/stat.h>

#include <algorithm>
#include <chrono>
#include <optional>
#include <string>
#include <utility>

#include "daemon/booth.h"
#include "daemon/combined_source.h"
#include "daemon/identifier.h"
#include "daemon/projector_delay.h"
#include "drivers/aravis/aravis_source.h"
#include "drivers/display/display_projector.h"
#include "drivers/gpio/gpio_devices.h"
#include "drivers/v4l2/v4l2_source.h"
#include "replay/replay_devices.h"

namespace booth {
namespace {

/// Every driver that can have cameras; a recording is read only where something of it is played.
struct Drivers {
  std::shared_ptr<ReplaySource> replay;
  std::shared_ptr<AravisSource> aravis;
  std::shared_ptr<V4l2Source> v4l2;

  std::shared_ptr<DeviceSource> of(const CameraConfig& camera) const {
    if (std::holds_alternative<AravisCameraSettings>(camera.driver)) return aravis;
    if (std::holds_alternative<V4l2CameraSettings>(camera.driver)) return v4l2;
    return replay;
  }
};

bool needs_recording(const BoothConfig& config) {
  return config.cameras.empty() || config.trigger.driver == TriggerDriver::replay ||
         config.projector.driver == ProjectorDriver::replay ||
         std::any_of(config.cameras.begin(), config.cameras.end(), [](const CameraConfig& camera) {
           return std::holds_alternative<ReplayCameraSettings>(camera.driver);
         });
}

Result<Drivers> open_drivers(const BoothConfig& config, const std::shared_ptr<WarningRelay>& warnings,
                             const Clock& clock) {
  Drivers drivers;
  if (needs_recording(config)) {
    auto replay = ReplaySource::open(config.replay, clock);
    if (!replay) return replay.error();
    drivers.replay = *std::move(replay);
  }
  const auto [aravis_settings, v4l2_settings] = live_cameras(config);
  auto aravis = AravisSource::create(aravis_settings, clock,
                                     [warnings](const std::string& sentence) { warnings->warn(sentence); });
  if (!aravis) return aravis.error();
  drivers.aravis = *std::move(aravis);
  auto v4l2 = V4l2Source::open(v4l2_settings, clock);
  if (!v4l2) return v4l2.error();
  drivers.v4l2 = *std::move(v4l2);
  return drivers;
}

/// The cameras of the configuration; where it lists none, all that the recording has.
std::vector<CameraConfig> cameras_of(const BoothConfig& config, const Drivers& drivers) {
  if (!config.cameras.empty()) return config.cameras;
  std::vector<CameraConfig> cameras;
  for (const RigCamera& camera : drivers.replay->rig()->cameras)
    cameras.push_back({.id = camera.id,
                       .role = camera.role,
                       .mount_rotation_deg = camera.mount_rotation_deg,
                       .driver = ReplayCameraSettings{}});
  return cameras;
}

CombinedParts::OpenTrigger trigger_of(const TriggerConfig& config, const Drivers& drivers, const Clock& clock) {
  switch (config.driver) {
    case TriggerDriver::replay: return [replay = drivers.replay] { return replay->open_trigger(); };
    case TriggerDriver::gpio: return [gpio = config.gpio, &clock] { return open_gpio_trigger(gpio, clock); };
    case TriggerDriver::aravis: return [aravis = drivers.aravis] { return aravis->open_trigger(); };
    case TriggerDriver::none: break;
  }
  return [&clock]() -> Result<std::unique_ptr<Trigger>> {
    return std::unique_ptr<Trigger>(std::make_unique<InstantTrigger>(clock));
  };
}

std::string name_of(TriggerDriver driver) {
  switch (driver) {
    case TriggerDriver::replay: return "replay";
    case TriggerDriver::gpio: return "gpio";
    case TriggerDriver::aravis: return "aravis";
    case TriggerDriver::none: break;
  }
  return "none";
}

/// The projector's id; nothing: the booth has none.
std::optional<std::string> projector_id(const ProjectorConfig& config, const Drivers& drivers) {
  switch (config.driver) {
    case ProjectorDriver::gpio: return config.gpio.id;
    case ProjectorDriver::display: return config.display.id;
    case ProjectorDriver::replay:
      if (const auto& projector = drivers.replay->rig()->projector) return projector->id;
      break;
    case ProjectorDriver::none: break;
  }
  return std::nullopt;
}

CombinedParts::OpenProjector projector_of(const ProjectorConfig& config, const std::filesystem::path& delay_file,
                                          const Drivers& drivers, const Clock& clock) {
  switch (config.driver) {
    case ProjectorDriver::replay: return [replay = drivers.replay] { return replay->open_projector(); };
    case ProjectorDriver::gpio: return [gpio = config.gpio, &clock] { return open_gpio_projector(gpio, clock); };
    case ProjectorDriver::display:
      return [display = config.display, delay_file, &clock]() -> Result<std::unique_ptr<Projector>> {
        DisplaySettings settings = display;
        // What was measured holds, not what was guessed.
        if (const auto delay = read_projector_delay(delay_file); delay && delay->projector == settings.id)
          settings.delay_us = delay->delay_us;
        auto opened = open_display_projector(settings, clock);
        if (!opened) return opened.error();
        return std::unique_ptr<Projector>(*std::move(opened));
      };
    case ProjectorDriver::none: break;
  }
  return {};
}

/// Whether the booth's own calibration is one of the cameras that the recording has.
bool fits(const Rig& own, const Rig& recorded) {
  return std::all_of(recorded.cameras.begin(), recorded.cameras.end(), [&](const RigCamera& camera) {
    const RigCamera* same = own.find(camera.id);
    return same != nullptr && same->role == camera.role && same->intrinsics.width == camera.intrinsics.width &&
           same->intrinsics.height == camera.intrinsics.height;
  });
}

/// The booth's own calibration, where it has one; else the recording's, where one is played.
void find_rig(const BoothConfig& config, const Drivers& drivers, Devices& devices) {
  const auto take_replayed = [&] {
    devices.rig = *drivers.replay->rig();
    devices.rig_created = drivers.replay->recording().created;
  };
  const std::filesystem::path file = config.booth.rig();
  const auto rig = read_rig(file);
  if (config.cameras.empty() && (!rig || !fits(*rig, *drivers.replay->rig()))) return take_replayed();
  if (rig) {
    devices.rig = *rig;
    struct stat status {};
    if (::stat(file.c_str(), &status) == 0)
      devices.rig_created = iso8601(std::chrono::system_clock::from_time_t(status.st_mtime));
  } else if (rig.error().code != ErrorCode::not_found) {
    devices.rig_fault = rig.error().message;
  } else if (drivers.replay) {
    take_replayed();
  }
}

}  // namespace

Result<Devices> open_devices(const BoothConfig& config, const Clock& clock) {
  Devices devices;
  devices.warnings = std::make_shared<WarningRelay>();
  const auto drivers = open_drivers(config, devices.warnings, clock);
  if (!drivers) return drivers.error();
  CombinedParts parts;
  bool replayed = false;
  for (const CameraConfig& camera : cameras_of(config, *drivers)) {
    const std::string driver(driver_name(camera));
    devices.cameras.push_back({.id = camera.id, .driver = driver, .role = camera.role});
    devices.mount_rotations[camera.id] = camera.mount_rotation_deg;
    parts.cameras[camera.id] = drivers->of(camera);
    replayed |= parts.cameras[camera.id] == drivers->replay;
  }
  parts.trigger = trigger_of(config.trigger, *drivers, clock);
  parts.projector = projector_of(config.projector, projector_delay_file(config.booth.state_directory), *drivers, clock);
  // Cameras that are played back do not see what really happens.
  if (replayed && config.trigger.driver != TriggerDriver::replay) parts.trigger_follower = drivers->replay;
  if (replayed && config.projector.driver != ProjectorDriver::replay) parts.projector_follower = drivers->replay;
  devices.source = std::make_shared<CombinedSource>(std::move(parts));
  if (drivers->replay) devices.drivers.push_back({"replay", drivers->replay});
  devices.drivers.push_back({"aravis", drivers->aravis});
  devices.drivers.push_back({"v4l2", drivers->v4l2});
  devices.trigger = name_of(config.trigger.driver);
  devices.projector = projector_id(config.projector, *drivers);
  find_rig(config, *drivers, devices);
  if (config.cameras.empty()) devices.replayed = drivers->replay->recording();
  return devices;
}

}  // namespace booth
