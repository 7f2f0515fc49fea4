#pragma once

#include <filesystem>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include "drivers/aravis/aravis_settings.h"
#include "drivers/display/display_settings.h"
#include "drivers/gpio/gpio_settings.h"
#include "drivers/v4l2/v4l2_settings.h"
#include "pipeline/export/avatar_files.h"
#include "pipeline/reconstruct.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"
#include "replay/recording_writer.h"
#include "replay/replay_options.h"

namespace booth {

struct IdentityConfig {
  std::string name = "booth";                                ///< shown to operators, ≤ 64 characters
  std::filesystem::path state_directory = "/var/lib/booth";  ///< absolute

  std::filesystem::path recordings() const { return state_directory / "recordings"; }
  std::filesystem::path backgrounds() const { return state_directory / "backgrounds"; }
  std::filesystem::path jobs() const { return state_directory / "jobs"; }
  std::filesystem::path captures_under_way() const { return state_directory / "capturing"; }
  std::filesystem::path cache() const { return state_directory / "cache"; }
  std::filesystem::path avatars() const { return state_directory / "avatars"; }
  std::filesystem::path rig() const { return state_directory / "calibration" / "rig.json"; }
};

struct ApiConfig {
  std::string control = "ipc:///run/booth/control";  ///< ipc:// or tcp://; the latter is always encrypted
  std::string events = "ipc:///run/booth/events";
  std::string remote_control;  ///< tcp:// besides the first; empty: none
  std::string remote_events;
  std::filesystem::path server_key = "/etc/booth/keys/server.key";  ///< see api/curve_keys.h; of tcp:// endpoints
  std::filesystem::path client_keys = "/etc/booth/keys/clients";    ///< folder
};

struct CaptureConfig {
  int frame_timeout_ms = 220;  ///< how long after a trigger a frame may arrive, 50 … 60000
  int retries = 1;             ///< triggers in place of one that a camera missed, 0 … 5
  int max_skew_ms = 100;       ///< how far from its trigger a frame may be exposed, 1 … 60000
  int min_cameras = 3;         ///< body cameras that must deliver, or the capture fails, 1 … 256
  int background_frames = 10;  ///< of background.learn without a number, 1 … 100
  SpoolOptions images;         ///< how recordings store them
};

struct BackgroundConfig {
  int max_age_h = 24;             ///< older than that it is to be learned again, 1 … 8760; 0: never
  double max_light_factor = 1.5;  ///< by how much the light may have changed since it was learned, 1.05 … 10
  bool relearn = true;            ///< the booth learns it again by itself when nobody is in it
  int quiet_s = 60;               ///< so long after the last capture it is taken to be empty, 5 … 86400
};

struct CalibrationConfig {
  /// That is shown to the cameras; where everything is played from a recording, that of its shots counts.
  CalibrationBoard board{
      .squares_x = 8, .squares_y = 11, .square_m = 0.06, .marker_m = 0.045, .dictionary = "DICT_5X5_250"};
  int timeout_s = 3600;  ///< after which a solution is stopped and has failed, 10 … 86400
};

struct DiskConfig {
  int reserve_mib = 2048;  ///< space that is never used: below it no capture starts, 0 … 10^7
  int limit_mib = 0;       ///< most that the state directory may hold, 0 … 10^8; 0: no limit
};

/// What the booth deletes by itself, recording and avatar together, the oldest first; never what is not done yet.
struct RetentionConfig {
  int max_age_h = 0;       ///< what is older goes, 0 … 10^6; 0: nothing goes for its age
  int max_captures = 0;    ///< when there are more, the oldest go, 0 … 10^7; 0: any number
  bool make_room = false;  ///< the oldest go when a capture would find no room
};

struct JobsConfig {
  int workers = 1;         ///< reconstructions at the same time, 1 … 64
  bool head_start = true;  ///< a reconstruction begins while its capture is still under way
  int threads = 0;         ///< of one reconstruction, 0 … 256; 0: as many as there are processors
  int timeout_s = 300;     ///< after which a reconstruction is stopped and has failed, 1 … 86400
  int memory_mib = 0;      ///< most that one reconstruction may take, 0 … 10^7; 0: three quarters of the machine's
  int retries = 1;         ///< of a reconstruction whose process died, hung or took too much memory, 0 … 10
};

struct FaceConfig {
  /// Of the passive face: 68 landmarks, in dlib's format.
  std::filesystem::path landmark_model = "/usr/share/dlib/shape_predictor_68_face_landmarks.dat";
  /// Of the scanned one: finds it in pictures, in OpenCV's format.
  std::filesystem::path cascade = "/usr/share/opencv4/haarcascades/haarcascade_frontalface_alt2.xml";
};

enum class LogLevel { error, warning, info, debug };

struct LogConfig {
  LogLevel level = LogLevel::info;
};

/// A camera that the recording of [replay] plays: the one of the same id.
struct ReplayCameraSettings {};

struct CameraConfig {
  std::string id;  ///< is_safe_id; as in the rig
  CameraRole role = CameraRole::body;
  int mount_rotation_deg = 0;  ///< see RigCamera; for pictures that people see before the booth is calibrated
  /// The driver, by its settings; their own id and role are those above.
  std::variant<ReplayCameraSettings, AravisCameraSettings, V4l2CameraSettings> driver;
};

enum class TriggerDriver {
  replay,  ///< of the recording
  gpio,    ///< a line that is wired to all cameras
  aravis,  ///< orders and action commands for the Aravis cameras that listen to them
  none     ///< nothing fires: cameras that stream all the time choose their frames by the instant
};

struct TriggerConfig {
  TriggerDriver driver = TriggerDriver::replay;
  GpioTriggerSettings gpio;
  AravisActionSettings action;
};

enum class ProjectorDriver {
  replay,  ///< of the recording, where it was made with one
  display,
  gpio,
  none
};

struct ProjectorConfig {
  ProjectorDriver driver = ProjectorDriver::replay;
  GpioProjectorSettings gpio;
  DisplaySettings display;
};

/// Everything that an operator sets: the options of all modules, composed. What it holds has been checked.
///
/// Cameras of several drivers may be mixed. Where cameras are listed, the rig is that of IdentityConfig::rig(); without
/// any, everything is played from the recording of [replay], its rig included.
struct BoothConfig {
  IdentityConfig booth;
  ApiConfig api;
  CaptureConfig capture;
  BackgroundConfig background;
  CalibrationConfig calibration;
  DiskConfig disk;
  RetentionConfig retention;
  JobsConfig jobs;
  LogConfig log;
  std::vector<CameraConfig> cameras;  ///< none: all that the recording of [replay] has
  TriggerConfig trigger;
  ProjectorConfig projector;
  ReplayOptions replay;
  FaceConfig face;
  ReconstructionOptions reconstruct;
  AvatarFileOptions files;  ///< section [export]
};

/// The configured cameras of the live drivers, as these take them.
std::pair<AravisSettings, V4l2Settings> live_cameras(const BoothConfig& config);

/// "replay", "aravis" or "v4l2".
std::string_view driver_name(const CameraConfig& camera);

/// One thing wrong with a configuration: `path: value, expected …`.
struct ConfigFault {
  std::string path;      ///< "capture.frame_timeout_ms", "replay.faults[2].kind"; empty for the file as a whole
  std::string value;     ///< as TOML writes it
  std::string expected;  ///< what would do

  std::string to_string() const;
};

/// A configuration and everything that is wrong with it. With faults, the config is not to be used.
struct ConfigReading {
  BoothConfig config;
  std::vector<ConfigFault> faults;
};

/// Reads TOML text; keys that are absent keep their default. Unknown keys and bad values are all reported.
/// @param folder  what relative paths in the text are relative to
ConfigReading parse_config(std::string_view toml, const std::filesystem::path& folder);

/// Reads a TOML file. Relative paths in it are relative to its folder.
/// @error not_found, io; invalid_file  every fault, one a line
Result<BoothConfig> load_config(const std::filesystem::path& file);

/// Every key with its value, as a TOML file that parse_config reads back to the same configuration.
std::string write_config(const BoothConfig& config);

/// Every key that the reader knows, dotted, in the order of the default file; members of an array of tables as
/// "replay.faults[].kind", those of cameras once for each driver.
std::vector<std::string> config_keys();

}  // namespace booth
