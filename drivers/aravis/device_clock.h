#pragma once

#include <cstdint>
#include <deque>
#include <optional>

#include "drivers/clock.h"

namespace booth {

/// A camera's clock seen from the booth's: where its zero lies, and how much faster it runs.
///
/// Readings (the camera is asked for its time) bound the offset from both sides: the answer was true at some instant
/// between question and answer. Where a camera cannot be asked, the arrivals of its frames bound it from one side.
class DeviceClock {
 public:
  /// The device's clock showed `device_ns` at some instant from `before` to `after`. A reading that is less certain
  /// than what is known, and agrees with it, is left out.
  void note_reading(int64_t device_ns, Timestamp before, Timestamp after);
  /// Something that happened at `device_ns` had arrived here by `arrival`; counts only without readings.
  void note_arrival(int64_t device_ns, Timestamp arrival);

  bool has_readings() const { return !readings_.empty(); }
  /// On the booth's clock; nothing before the first note.
  std::optional<Timestamp> host_time(int64_t device_ns) const;
  /// On the camera's.
  std::optional<int64_t> device_time(Timestamp host_ns) const;
  /// Half the width of the last reading: how far off host_time may be, drift since then aside.
  Timestamp uncertainty_ns() const;
  /// How much faster the device's clock runs, parts per million; 0 until two readings are far enough apart.
  double drift_ppm() const { return drift_ * 1e6; }

 private:
  struct Reading {
    int64_t device;
    Timestamp host, half_width;
  };
  void estimate_drift();

  std::deque<Reading> readings_;
  std::deque<Timestamp> offsets_;  ///< arrival − device time of the last frames
  double drift_ = 0;
};

}  // namespace booth
