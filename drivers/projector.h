#pragma once

#include <string>

#include "drivers/clock.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

struct ProjectorInfo {
  std::string id;
  std::string driver;
  GrayCodePattern pattern;  ///< the sequence that it can show
};

/// The projector that lights the face with Gray codes. It is dark unless a pattern is shown, also after a fault
/// and in its destructor.
class Projector {
 public:
  virtual ~Projector() = default;
  virtual const ProjectorInfo& info() const = 0;
  /// Shows the pattern of that index (0 … pattern_count − 1) and returns when it is on the subject.
  /// @error device_lost, invalid_argument
  virtual Result<void> show(int index) = 0;
  virtual void dark() noexcept = 0;
};

}  // namespace booth
