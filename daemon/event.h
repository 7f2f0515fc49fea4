#pragma once

#include <chrono>
#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "drivers/camera.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

enum class BoothState { starting, idle, countdown, capturing, learning_background, calibrating, fault, stopping };
std::string_view to_string(BoothState state);

enum class DeviceState { online, offline, degraded };
std::string_view to_string(DeviceState state);

enum class TaskKind {
  discover,
  background,
  trigger_test,
  projector_calibration,
  calibration_capture,
  calibration_solve
};
std::string_view to_string(TaskKind kind);

enum class TaskState { running, done, failed };
std::string_view to_string(TaskState state);

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
  double skew_us;                                 ///< between the first and the last exposure
  int retries = 0;                                ///< triggers that were fired again because somebody missed one
  std::map<std::string, double> offsets_us = {};  ///< by camera: from its trigger to its exposure
  double decided_ms = 0;                          ///< from the first trigger until it was clear what the shot has
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
/// Every camera that the drivers see.
struct CamerasDiscovered {
  struct Seen {
    CameraInfo camera;
    bool configured = false;
  };
  std::vector<Seen> cameras;
  std::vector<std::string> faults;  ///< sentences: drivers that could not look
};
struct BackgroundLearned {
  std::string created;
  int frames = 0;                     ///< of each camera, at most
  std::vector<std::string> missing;   ///< cameras that delivered none
  std::vector<std::string> warnings;  ///< sentences
};
struct TriggerTested {
  std::map<std::string, double> offsets_us;  ///< by camera: from the trigger to its exposure
  std::vector<std::string> missing;
  double skew_us = 0;
  std::vector<std::string> warnings;  ///< sentences
};
struct ProjectorCalibrated {
  int delay_us = 0;     ///< in force from now on
  int measured_us = 0;  ///< the shortest that was enough
  double contrast = 0;  ///< of white and black, of 255
  std::string camera;   ///< that looked
};
/// What became of a shot of the board, or of solving: see CalibrationDesk.
struct CalibrationReport {
  std::string json;  ///< an object, as the interface hands it on
};
using TaskResult = std::variant<std::monostate, CamerasDiscovered, BackgroundLearned, TriggerTested,
                                ProjectorCalibrated, CalibrationReport>;
struct TaskChanged {
  std::string task;
  TaskKind kind;
  TaskState state;
  double fraction = 0;
  TaskResult result;           ///< of one that is done
  std::optional<Error> error;  ///< of one that failed
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
                           JobCancelled, AvatarPublished, AvatarDeleted, CameraChanged, TaskChanged, Alert, Heartbeat>;

struct NumberedEvent {
  uint64_t sequence;  ///< from 1, without gaps
  std::chrono::system_clock::time_point time;
  Event event;
};

}  // namespace booth
