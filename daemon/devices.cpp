#include <string>
#include <utility>

#include "daemon/booth.h"
#include "replay/replay_devices.h"

namespace booth {
namespace {

Result<Devices> open_replay(const BoothConfig& config, const Clock& clock) {
  auto source = ReplaySource::open(config.replay, clock);
  if (!source) return source.error();
  const Recording& recording = (*source)->recording();
  return Devices{*source, recording.rig, recording.created, recording};
}

/// Every driver there is.
struct Driver {
  const char* name;
  Result<Devices> (*open)(const BoothConfig& config, const Clock& clock);
};
constexpr Driver drivers[] = {{"replay", open_replay}};

}  // namespace

Result<Devices> open_devices(const BoothConfig& config, const Clock& clock) {
  for (const Driver& driver : drivers)
    if (config.drivers.camera == driver.name) return driver.open(config, clock);
  return Error{ErrorCode::unsupported, "drivers.camera: \"" + config.drivers.camera + "\" is not in this build"};
}

}  // namespace booth
