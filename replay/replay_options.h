#pragma once

#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/types/shot.h"

namespace booth {

/// Something that goes wrong on purpose while a recording plays.
struct ReplayFault {
  enum class Kind {
    missing,  ///< the frame never arrives
    late,     ///< it arrives delay_ms later than it should
    corrupt,  ///< it arrives damaged: wait_frame returns invalid_file
    lost      ///< the camera is gone at that trigger, and can be opened again after delay_ms (0: never)
  };
  Kind kind = Kind::missing;
  std::string camera = {};            ///< id; empty: every camera
  std::optional<ShotRole> role = {};  ///< nothing: every role
  std::optional<int> index = {};      ///< trigger within the shot, from 0; nothing: each
  std::optional<int> capture = {};    ///< how often the camera was armed for the role before, from 0; nothing: always
  int delay_ms = 0;                   ///< of late and lost
};

/// A recording that plays in place of hardware.
struct ReplayOptions {
  enum class Pace {
    real,  ///< frames arrive as a camera's would: after exposure, offset and transfer; patterns take their time
    fast   ///< at once
  };
  std::filesystem::path recording = "/usr/share/avatar-booth/recordings/mini";
  Pace pace = Pace::real;
  std::vector<ReplayFault> faults = {};
  size_t cache_mib = 128;  ///< decoded frames that are kept for the next capture
};

}  // namespace booth
