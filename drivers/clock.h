#pragma once

#include <chrono>
#include <functional>

#include "pipeline/types/frame.h"

namespace booth {

/// The booth's one clock, handed to whoever needs it so that tests can turn it by hand.
class Clock {
 public:
  virtual ~Clock() = default;
  virtual Timestamp now() const = 0;
};

/// CLOCK_MONOTONIC.
class MonotonicClock final : public Clock {
 public:
  Timestamp now() const override {
    return std::chrono::duration_cast<std::chrono::nanoseconds>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
  }
};

constexpr Timestamp milliseconds(int64_t count) { return count * 1'000'000; }
constexpr Timestamp seconds(int64_t count) { return count * 1'000'000'000; }

}  // namespace booth
