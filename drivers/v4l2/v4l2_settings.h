#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"

namespace booth {

/// How pixels travel from the camera. Bayer formats are named by the first two samples of the first two rows.
enum class V4l2Format { automatic, mjpg, yuyv, grey, bayer_rggb, bayer_grbg, bayer_gbrg, bayer_bggr };

/// The format's name in the configuration: "auto", "mjpg", "yuyv", "grey", "rggb", "grbg", "gbrg", "bggr".
std::string_view to_string(V4l2Format format);
/// The format of that name, if it is one.
std::optional<V4l2Format> v4l2_format_from(std::string_view name);

/// What makes a camera expose: nothing, it streams all the time and a trigger chooses a frame; or a line of its own,
/// for which its maker's controls must have been set.
enum class V4l2TriggerSource { stream, line };

/// One USB camera. Exactly one of `device`, `serial` and `bus` says which. What is left out of the optional values
/// stays as the camera has it, its automatics included; whatever is set is verified by reading it back.
struct V4l2CameraSettings {
  std::string id;  ///< as in the rig
  CameraRole role = CameraRole::body;

  std::string device = {};  ///< a node or a link to one: "/dev/video0", "/dev/v4l/by-path/…-video-index0"
  std::string serial = {};  ///< the USB device's serial number; cheap cameras share one, then `bus` tells them apart
  std::string bus = {};     ///< the port, as `v4l2-ctl --list-devices` shows it: "usb-0000:00:14.0-2"

  V4l2Format format = V4l2Format::automatic;  ///< automatic: the first offered of MJPG, YUYV, Bayer, GREY
  int width = 0;                              ///< pixels, 0 … 65535; 0 with height 0: the largest offered
  int height = 0;                             ///< pixels, 0 … 65535
  double fps = 0;                             ///< frames a second, 0 … 1000; 0: the most offered

  std::optional<int> exposure_us = {};            ///< 100 … 10'000'000, a multiple of 100
  std::optional<int> gray_code_exposure_us = {};  ///< likewise, of Gray-code shots; absent: as the others
  std::optional<int> gain = {};                   ///< in the camera's own steps: V4L2 does not say how many dB
  std::optional<int> white_balance_k = {};        ///< kelvin, 1000 … 20000
  std::optional<int> focus = {};                  ///< in the camera's own steps
  /// Further controls by their name as `v4l2-ctl --list-ctrls` shows it ("power_line_frequency"), in the camera's own
  /// units; booleans are 0 and 1, a menu's entries are numbered.
  std::map<std::string, int64_t> controls = {};

  /// A camera with a line of its own has no preview, and its stream is not waited for.
  V4l2TriggerSource trigger = V4l2TriggerSource::stream;
  int buffers = 4;          ///< that the kernel fills in turn, 2 … 32
  int warm_up_frames = 2;   ///< first ones of a stream, which are not used, 0 … 100; none where a line triggers
  int latency_us = 0;       ///< from the beginning of the exposure to the driver's time stamp, 0 … 1'000'000
  int max_offset_ms = 100;  ///< a frame farther from its trigger does not answer it, 1 … 60000
};

struct V4l2Settings {
  std::vector<V4l2CameraSettings> cameras;
};

/// Ids unique and file-name safe, one way each to find the device, everything within its range.
/// @error invalid_argument  naming camera, setting, value and what would do
Result<void> check(const V4l2Settings& settings);

}  // namespace booth
