#include "drivers/aravis/device_clock.h"

#include <algorithm>
#include <cmath>

namespace booth {
namespace {

constexpr size_t most_readings = 64;
constexpr size_t most_arrivals = 64;
constexpr Timestamp shortest_baseline = seconds(1);  ///< between two readings that tell the drift
constexpr double residual_drift = 50e-6;             ///< that may be left when the drift is estimated
constexpr double largest_drift = 500e-6;             ///< of any quartz; what seems more is a mistaken reading

}  // namespace

void DeviceClock::note_reading(int64_t device_ns, Timestamp before, Timestamp after) {
  // A clock that was set (PTP began to steer it) or reset makes older readings worthless.
  if (const auto expected = host_time(device_ns); has_readings() && expected) {
    const auto elapsed = static_cast<double>(after - readings_.back().host);
    const auto tolerance = static_cast<Timestamp>(largest_drift * elapsed) + (after - before) + uncertainty_ns();
    if (*expected < before - tolerance || *expected > after + tolerance) {
      readings_.clear();
      drift_ = 0;
    } else if (after - before > 2 * uncertainty_ns() + static_cast<Timestamp>(residual_drift * elapsed)) {
      return;  // what is known already is better
    }
  }
  readings_.push_back({device_ns, before + (after - before) / 2, (after - before + 1) / 2});
  if (readings_.size() > most_readings) readings_.pop_front();
  estimate_drift();
}

void DeviceClock::note_arrival(int64_t device_ns, Timestamp arrival) {
  offsets_.push_back(arrival - device_ns);
  if (offsets_.size() > most_arrivals) offsets_.pop_front();
}

void DeviceClock::estimate_drift() {
  const Reading &first = readings_.front(), &last = readings_.back();
  const Timestamp baseline = last.host - first.host;
  if (baseline < shortest_baseline) return;
  const double drift = static_cast<double>(last.device - first.device - baseline) / static_cast<double>(baseline);
  drift_ = std::clamp(drift, -largest_drift, largest_drift);
}

std::optional<Timestamp> DeviceClock::host_time(int64_t device_ns) const {
  if (has_readings()) {
    const Reading& last = readings_.back();
    return last.host + std::llround(static_cast<double>(device_ns - last.device) / (1 + drift_));
  }
  if (offsets_.empty()) return std::nullopt;
  return device_ns + *std::min_element(offsets_.begin(), offsets_.end());
}

std::optional<int64_t> DeviceClock::device_time(Timestamp host_ns) const {
  if (!has_readings()) return std::nullopt;
  const Reading& last = readings_.back();
  return last.device + std::llround(static_cast<double>(host_ns - last.host) * (1 + drift_));
}

Timestamp DeviceClock::uncertainty_ns() const { return has_readings() ? readings_.back().half_width : 0; }

}  // namespace booth
