#pragma once

#include <chrono>
#include <cstdint>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

enum class BoothState { starting, idle, countdown, capturing, learning_background, calibrating, fault, stopping };
std::string_view to_string(BoothState state);

enum class DeviceState { online, offline, degraded };
std::string_view to_string(DeviceState state);

enum class Severity { info, warning, error };
std::string_view to_string(Severity severity);

/// A stable word that programs branch on, and a sentence for an operator.
struct Reason {
  std::string kind;
  std::string message;
  bool operator==(const Reason&) const = default;
};

// What the booth tells whoever listens. The topics and their fields are those of the interface's contract.
struct StateChanged {
  BoothState state, previous;
  bool ready;
  std::vector<Reason> not_ready;
};
struct CountdownTick {
  std::string capture;
  double remaining_s;
};
struct ShotTaken {
  std::string capture;
  ShotRole role;
  int index;    ///< of the trigger within the shot
  int of;       ///< triggers of the shot
  int cameras;  ///< how many delivered
  std::vector<std::string> missing;
  double skew_us;  ///< between the first and the last exposure
};
struct CaptureDone {
  std::string capture, job;
};
struct CaptureFailed {
  std::string capture;
  Error error;
};
struct JobProgressed {
  std::string job, capture, stage;
  double fraction;
};
struct JobFailed {
  std::string job, capture;
  Reason error;
};
struct JobCancelled {
  std::string job, capture;
};
struct AvatarPublished {
  std::string avatar, job, capture, label;
  std::vector<std::string> files;
};
struct AvatarDeleted {
  std::string avatar;
};
struct CameraChanged {
  std::string camera;
  DeviceState state;
  std::string message;
};
struct Alert {
  Severity severity;
  std::string kind, message;
};
struct Heartbeat {
  BoothState state;
  bool ready;
};

using Event = std::variant<StateChanged, CountdownTick, ShotTaken, CaptureDone, CaptureFailed, JobProgressed, JobFailed,
                           JobCancelled, AvatarPublished, AvatarDeleted, CameraChanged, Alert, Heartbeat>;

struct NumberedEvent {
  uint64_t sequence;  ///< from 1, without gaps
  std::chrono::system_clock::time_point time;
  Event event;
};

}  // namespace booth
