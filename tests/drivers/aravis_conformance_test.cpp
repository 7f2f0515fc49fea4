#include <optional>

#include "tests/drivers/aravis_booth.h"
#include "tests/drivers/camera_conformance.h"

namespace booth {
namespace {

[[maybe_unused]] const auto* const network = testing::AddGlobalTestEnvironment(new OwnNetwork);

/// Aravis against a camera that speaks GigE Vision over a real network.
std::optional<DriverUnderTest> virtual_camera(const Clock& clock, AravisTriggerSource trigger, bool by_serial) {
  if (!no_network_reason().empty()) return std::nullopt;
  GigeCameraOptions options{.address = virtual_booth::camera_address(0), .serial = "VB0001"};
  for (int i = 0; i < 3; ++i) options.scenes.push_back(test_scene(160, 120, i));
  const auto peer = std::make_shared<GigeCamera>(options);
  AravisSettings settings{.cameras = {virtual_settings(0)}, .action = {.acknowledge_timeout_ms = 5000}};
  settings.cameras[0].trigger = trigger;
  if (by_serial) {
    settings.cameras[0].address.clear();
    settings.cameras[0].serial = options.serial;
  }
  auto source = AravisSource::create(settings, clock);
  if (!source) {
    ADD_FAILURE() << source.error().message;
    return std::nullopt;
  }
  std::shared_ptr<DeviceSource> driven = *source;
  if (trigger == AravisTriggerSource::line) driven = std::make_shared<PulsedSource>(*source, std::vector{peer}, clock);
  return DriverUnderTest{.source = driven,
                         .camera = settings.cameras[0].id,
                         .unplug_camera = [peer] { peer->power_off(); },
                         .plug_in_camera = [peer] { peer->power_on(); }};
}

DriverFactory factory(AravisTriggerSource trigger, bool by_serial) {
  return [=](const Clock& clock) { return virtual_camera(clock, trigger, by_serial); };
}

INSTANTIATE_TEST_SUITE_P(AravisByLine, CameraConformance, testing::Values(factory(AravisTriggerSource::line, false)));
INSTANTIATE_TEST_SUITE_P(AravisBySoftware, CameraConformance,
                         testing::Values(factory(AravisTriggerSource::software, true)));
INSTANTIATE_TEST_SUITE_P(AravisByAction, CameraConformance,
                         testing::Values(factory(AravisTriggerSource::action, false)));

}  // namespace
}  // namespace booth
