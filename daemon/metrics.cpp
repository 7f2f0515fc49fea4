#include "daemon/metrics.h"

#include <array>
#include <utility>

namespace booth {

void Metrics::add(const std::string& counter, double amount) {
  const std::lock_guard lock(mutex_);
  values_[counter] += amount;
}

void Metrics::observe(const std::string& histogram, double seconds) {
  constexpr std::array<std::pair<const char*, double>, 9> bounds{{{"_le_0.001", 0.001},
                                                                  {"_le_0.01", 0.01},
                                                                  {"_le_0.1", 0.1},
                                                                  {"_le_0.5", 0.5},
                                                                  {"_le_1", 1},
                                                                  {"_le_2", 2},
                                                                  {"_le_5", 5},
                                                                  {"_le_20", 20},
                                                                  {"_le_100", 100}}};
  const std::lock_guard lock(mutex_);
  values_[histogram + "_count"] += 1;
  values_[histogram + "_sum"] += seconds;
  for (const auto& [suffix, bound] : bounds) values_[histogram + suffix] += seconds <= bound ? 1 : 0;
}

std::map<std::string, double> Metrics::snapshot() const {
  const std::lock_guard lock(mutex_);
  return values_;
}

}  // namespace booth
