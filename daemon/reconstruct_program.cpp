#include "daemon/reconstruct_program.h"

#include <unistd.h>

namespace booth {

std::vector<std::string> ReconstructProgram::arguments(const std::string& job, const std::string& face) const {
  std::vector<std::string> line{command, recordings / job, avatars / job};
  line.insert(line.end(), {"--progress-fd", "3", "--threads", std::to_string(threads)});
  if (!face.empty()) line.insert(line.end(), {"--face", face});
  if (!cache.empty()) line.insert(line.end(), {"--cache", cache});
  if (!config_file.empty()) line.insert(line.end(), {"--config", config_file});
  return line;
}

uint64_t ReconstructProgram::memory_limit() const {
  if (most_bytes > 0) return most_bytes;
  return static_cast<uint64_t>(::sysconf(_SC_PHYS_PAGES)) * static_cast<uint64_t>(::sysconf(_SC_PAGESIZE)) / 4 * 3;
}

}  // namespace booth
