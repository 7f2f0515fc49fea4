#pragma once

#include <string>

#include "drivers/clock.h"
#include "pipeline/types/result.h"

namespace booth {

/// What makes all cameras expose at one instant.
class Trigger {
 public:
  virtual ~Trigger() = default;
  /// "replay", "gpio", "software", "action".
  virtual const std::string& driver() const = 0;
  /// Fires once. @return when, on the booth's clock. @error device_lost
  virtual Result<Timestamp> fire() = 0;
};

}  // namespace booth
