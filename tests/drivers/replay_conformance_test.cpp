#include <optional>

#include "replay/replay_devices.h"
#include "tests/drivers/camera_conformance.h"

namespace booth {
namespace {

std::optional<DriverUnderTest> replay(const Clock& clock, ReplayOptions::Pace pace) {
  auto source = ReplaySource::open({.recording = BOOTH_SOURCE_DIR "/replay/recordings/mini", .pace = pace}, clock);
  if (!source) {
    ADD_FAILURE() << source.error().message;
    return std::nullopt;
  }
  const std::weak_ptr<ReplaySource> replayed = *source;
  return DriverUnderTest{.source = *source,
                         .camera = "body-03",
                         .unplug_camera = [replayed] { replayed.lock()->unplug("body-03"); },
                         .plug_in_camera = [replayed] { replayed.lock()->plug_in("body-03"); }};
}

INSTANTIATE_TEST_SUITE_P(RealReplay, CameraConformance, testing::Values(DriverFactory([](const Clock& clock) {
                           return replay(clock, ReplayOptions::Pace::real);
                         })));
INSTANTIATE_TEST_SUITE_P(FastReplay, CameraConformance, testing::Values(DriverFactory([](const Clock& clock) {
                           return replay(clock, ReplayOptions::Pace::fast);
                         })));

}  // namespace
}  // namespace booth
