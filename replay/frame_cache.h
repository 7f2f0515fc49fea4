#pragma once

#include <cstddef>
#include <list>
#include <map>
#include <mutex>
#include <string>

#include "pipeline/types/frame.h"

namespace booth {

/// Decoded frames by file name, the least recently used dropped first. Safe for several threads.
class FrameCache {
 public:
  explicit FrameCache(size_t most_bytes) : most_bytes_(most_bytes) {}

  /// The frame of that file; without pixels when it is not here.
  Frame find(const std::string& file);
  void keep(const std::string& file, const Frame& frame);

 private:
  struct Entry {
    std::string file;
    Frame frame;
  };

  const size_t most_bytes_;
  std::mutex mutex_;
  std::list<Entry> entries_;                                 ///< guarded by mutex_; most recently used first
  std::map<std::string, std::list<Entry>::iterator> files_;  ///< guarded by mutex_
  size_t bytes_ = 0;                                         ///< guarded by mutex_
};

}  // namespace booth
