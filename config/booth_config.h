#pragma once

#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

#include "pipeline/export/avatar_files.h"
#include "pipeline/reconstruct.h"
#include "pipeline/types/result.h"
#include "replay/recording_writer.h"
#include "replay/replay_options.h"

namespace booth {

struct IdentityConfig {
  std::string name = "booth";                                ///< shown to operators, ≤ 64 characters
  std::filesystem::path state_directory = "/var/lib/booth";  ///< absolute

  std::filesystem::path recordings() const { return state_directory / "recordings"; }
  std::filesystem::path backgrounds() const { return state_directory / "backgrounds"; }
  std::filesystem::path jobs() const { return state_directory / "jobs"; }
  std::filesystem::path avatars() const { return state_directory / "avatars"; }
};

struct ApiConfig {
  std::string control = "ipc:///run/booth/control";
  std::string events = "ipc:///run/booth/events";
};

struct CaptureConfig {
  int frame_timeout_ms = 2000;  ///< how long after a trigger a frame may arrive, 50 … 60000
  int min_cameras = 3;          ///< body cameras that must deliver, or the capture fails, 1 … 256
  int background_frames = 10;   ///< of background.learn without a number, 1 … 100
  SpoolOptions images;          ///< how recordings store them
};

struct DiskConfig {
  int reserve_mib = 2048;  ///< space that is never used: below it no capture starts, 0 … 10^7
  int limit_mib = 0;       ///< most that the state directory may hold, 0 … 10^8; 0: no limit
};

struct JobsConfig {
  int workers = 1;      ///< reconstructions at the same time, 1 … 64
  int threads = 0;      ///< of one reconstruction, 0 … 256; 0: as many as there are processors
  int timeout_s = 300;  ///< after which a reconstruction is stopped and has failed, 1 … 86400
  int retries = 1;      ///< of a reconstruction whose process died, 0 … 10
};

enum class LogLevel { error, warning, info, debug };

struct LogConfig {
  LogLevel level = LogLevel::info;
};

struct DriversConfig {
  std::string camera = "replay";  ///< also opens the trigger and the projector
};

/// Everything that an operator sets: the options of all modules, composed. What it holds has been checked.
struct BoothConfig {
  IdentityConfig booth;
  ApiConfig api;
  CaptureConfig capture;
  DiskConfig disk;
  JobsConfig jobs;
  LogConfig log;
  DriversConfig drivers;
  ReplayOptions replay;
  ReconstructionOptions reconstruct;
  AvatarFileOptions files;  ///< section [export]
};

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
/// "replay.faults[].kind".
std::vector<std::string> config_keys();

}  // namespace booth
