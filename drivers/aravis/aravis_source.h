#pragma once

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "drivers/aravis/aravis_settings.h"
#include "drivers/clock.h"
#include "drivers/device_source.h"

namespace booth {

/// GigE Vision and USB3 Vision cameras, through Aravis.
///
/// open_camera applies every setting and reads it back. An armed camera answers trigger k with the frame that its
/// sensor exposed at that trigger: frames are counted (also those that did not arrive whole), and where note_trigger
/// tells when triggers fired, the count is checked against the frames' device time. Timestamps are the beginning of
/// the exposure, from the camera's clock, on the booth's. Pixels stay in the memory that they were received in;
/// Bayer frames are delivered raw, with Frame::mosaic.
///
/// open_trigger gives what fires the cameras of AravisTriggerSource::software and action. @error unsupported where
/// every camera listens to a line.
class AravisSource final : public DeviceSource {
 public:
  /// What an operator should know though it works: a socket buffer that the kernel cut, a camera that leaves PTP.
  /// Called from any thread.
  using Warn = std::function<void(const std::string& sentence)>;

  /// Talks to no camera yet.
  /// @param clock  outlives the source and its devices
  /// @param warn   likewise whatever it refers to; may be empty
  /// @error invalid_argument  as check(settings)
  static Result<std::shared_ptr<AravisSource>> create(const AravisSettings& settings, const Clock& clock,
                                                      Warn warn = {});
  ~AravisSource() override;

  /// Every camera that answers, configured or not; takes about a second. A camera that is not configured goes by its
  /// serial number.
  Result<std::vector<CameraInfo>> discover() override;
  Result<std::unique_ptr<Camera>> open_camera(const std::string& id) override;
  Result<std::unique_ptr<Trigger>> open_trigger() override;
  /// @error unsupported
  Result<std::unique_ptr<Projector>> open_projector() override;

 private:
  struct Content;
  explicit AravisSource(std::shared_ptr<Content> content);
  std::shared_ptr<Content> content_;
};

}  // namespace booth
