#pragma once

#include <mutex>
#include <optional>
#include <set>
#include <string>

namespace booth {

/// What the cameras' IEEE 1588 clocks say they are. Of one network one clock is the master that the others follow;
/// several masters are networks that do not hear each other, and their cameras do not share a time.
class PtpWatch {
 public:
  /// A camera's state now: "Master", "Slave", "Listening", …
  /// @return a sentence for an operator, once, when there is a further master besides others
  std::optional<std::string> note(const std::string& camera, const std::string& state);

 private:
  std::mutex mutex_;
  std::set<std::string> masters_;  ///< guarded by mutex_
};

}  // namespace booth
