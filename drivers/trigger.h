#pragma once

#include <string>

#include "drivers/clock.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

/// What makes all cameras expose at one instant.
class Trigger {
 public:
  virtual ~Trigger() = default;
  /// "replay", "gpio", "software", "action".
  virtual const std::string& driver() const = 0;
  /// What the next triggers are for, where that makes a difference: which shots are lit.
  virtual void prepare(ShotRole /*role*/) noexcept {}
  /// Fires once. @return when, on the booth's clock. @error device_lost
  virtual Result<Timestamp> fire() = 0;
};

}  // namespace booth
