#pragma once

#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <utility>

#include "pipeline/types/result.h"

namespace booth {

/// The peak of the resident memory since the last reset, from the kernel.
class PeakMemory {
 public:
  static void reset() { std::ofstream("/proc/self/clear_refs") << "5"; }
  static double mebibytes() {
    std::ifstream status("/proc/self/status");
    for (std::string word; status >> word;)
      if (double kibibytes = 0; word == "VmHWM:" && status >> kibibytes) return kibibytes / 1024;
    return 0;
  }
};

/// What a benchmark cannot go on without; otherwise the program ends with the reason.
template <class T>
T must(Result<T> result) {
  if (result) return std::move(*result);
  std::cerr << result.error().message << "\n";
  std::exit(1);
}

}  // namespace booth
