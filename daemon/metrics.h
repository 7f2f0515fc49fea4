#pragma once

#include <map>
#include <mutex>
#include <string>

namespace booth {

/// Counters and histograms under flat names. Any thread.
class Metrics {
 public:
  void add(const std::string& counter, double amount = 1);
  /// Counts a duration: NAME_count, NAME_sum and, cumulative, NAME_le_0.01 … NAME_le_100 (seconds).
  void observe(const std::string& histogram, double seconds);
  std::map<std::string, double> snapshot() const;

 private:
  mutable std::mutex mutex_;
  std::map<std::string, double> values_;  ///< guarded by mutex_
};

}  // namespace booth
