#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "drivers/camera.h"
#include "pipeline/types/result.h"

namespace booth {

/// What makes a camera expose: its input line, an order over its control channel, or a GigE Vision action command.
enum class AravisTriggerSource { line, software, action };

/// Which edge or level of the line (SFNC TriggerActivation).
enum class AravisActivation { rising_edge, falling_edge, any_edge, level_high, level_low };

/// How samples follow light: proportionally (the camera's gamma is set to 1), or as displays want it (1/2.2). RGB8 is
/// always sRGB.
enum class AravisResponse { linear, srgb };

/// A part of the sensor. Offsets count from the sensor's top left.
struct AravisRegion {
  int x = 0;       ///< pixels, 0 … 65535
  int y = 0;       ///< pixels, 0 … 65535
  int width = 0;   ///< pixels, 1 … 65535; 0: to the sensor's right edge
  int height = 0;  ///< pixels, 1 … 65535; 0: to the sensor's bottom edge
};

/// A feature of the camera's own list (GenICam), set as given and read back: {"LineDebouncerTime", "50"}.
struct AravisFeature {
  std::string name = {};   ///< letters, digits and '_', 1 … 64 of them
  std::string value = {};  ///< a number, an entry's name, text, "true" or "false"; a command takes "execute"
};

/// A GigE Vision or USB3 Vision camera. A value that the camera cannot take is refused when it is opened, with the
/// camera's own range.
struct AravisCameraSettings {
  std::string id = {};                 ///< as in the rig
  CameraRole role = CameraRole::body;  ///< as in the rig
  std::string serial = {};             ///< the device's serial number; either this or `address`
  std::string address = {};            ///< IPv4 address or host name; opening by it needs no discovery broadcast

  double exposure_us = 10000;                      ///< 1 … 10 000 000
  double gain_db = 0;                              ///< 0 … 60
  std::optional<double> pattern_exposure_us = {};  ///< of gray_code shots, 1 … 10 000 000; nothing: exposure_us
  std::optional<double> pattern_gain_db = {};      ///< of gray_code shots, 0 … 60; nothing: gain_db
  std::optional<double> white_balance_red = {};    ///< ratio to green, 0.1 … 16; nothing: as the camera has it
  std::optional<double> white_balance_blue = {};   ///< ratio to green, 0.1 … 16; nothing: as the camera has it
  AravisResponse response = AravisResponse::linear;
  std::string pixel_format = "BayerRG8";  ///< Mono8, BayerRG8, BayerGR8, BayerGB8, BayerBG8 or RGB8
  AravisRegion region = {};

  AravisTriggerSource trigger = AravisTriggerSource::line;
  std::string trigger_line = "Line1";           ///< TriggerSource of a camera that is triggered by a line
  std::string trigger_selector = "FrameStart";  ///< an entry of TriggerSelector
  AravisActivation activation = AravisActivation::rising_edge;  ///< of a line
  double trigger_delay_us = 0;                                  ///< from the edge to the exposure, 0 … 1 000 000
  int action = 0;           ///< ActionSelector and the number in TriggerSource "Action0", 0 … 31
  double preview_fps = 10;  ///< pictures a second while people look, 1 … 60

  int packet_size = 0;            ///< GVSP packets with their headers, bytes, 576 … 16384; 0: the largest that passes
  int packet_delay_ns = 0;        ///< between two packets, 0 … 1 000 000 000; for several cameras on one link
  bool packet_resend = true;      ///< ask again for packets that did not arrive
  double resend_ratio = 0.25;     ///< largest share of a frame's packets that is asked for again, 0 … 1
  int packet_timeout_ms = 20;     ///< before a packet is asked for again, 1 … 1000
  int frame_retention_ms = 200;   ///< after a frame's last packet, before it is given up, 1 … 10 000
  int socket_buffer_kib = 16384;  ///< of the receiving socket, 64 … 1048576; the kernel's net.core.rmem_max bounds it
  bool packet_socket = false;     ///< receive through a packet socket, which needs CAP_NET_RAW
  int buffers = 0;                ///< frames that may be on their way or in use, 2 … 256; 0: as a shot needs
  int heartbeat_ms = 3000;        ///< after which the camera frees itself of a dead booth, 2000 … 60 000
  bool ptp = false;               ///< let the camera's clock follow the network's (IEEE 1588), and watch that it does
  std::vector<AravisFeature> features = {};  ///< set after everything above, in this order; at most 64
};

/// The GigE Vision action command that exposes all cameras whose trigger is AravisTriggerSource::action.
struct AravisActionSettings {
  uint32_t device_key = 1;
  uint32_t group_key = 1;
  uint32_t group_mask = 1;  ///< at least one bit
  /// Where it is sent: the broadcast address of each camera network, or a camera's own; at most 64.
  std::vector<std::string> destinations = {"255.255.255.255"};
  /// The command carries an instant this long ahead at which all expose together, by their PTP clocks, µs, 1000 …
  /// 1 000 000; 0: at once.
  int schedule_ahead_us = 0;
  int acknowledge_timeout_ms = 100;  ///< 1 … 10 000: cameras that have not acknowledged by then are named in a warning
};

struct AravisSettings {
  std::vector<AravisCameraSettings> cameras = {};
  AravisActionSettings action = {};
};

/// Every range above holds; ids are unique and safe, no two cameras share a serial or an address.
/// @error invalid_argument  one sentence that names the camera, the setting, its value and what would do
Result<void> check(const AravisSettings& settings);

}  // namespace booth
