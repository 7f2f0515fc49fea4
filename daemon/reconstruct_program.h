#pragma once

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

namespace booth {

/// The program that reconstructs, and within what limits it does so.
struct ReconstructProgram {
  std::filesystem::path command;      ///< COMMAND RECORDING AVATAR --face MODE …
  std::filesystem::path config_file;  ///< handed to it; may be empty
  std::filesystem::path recordings;   ///< folder
  std::filesystem::path avatars;      ///< folder
  std::filesystem::path cache;        ///< folder that it may keep things in from one job to the next; empty: none
  int threads = 0;                    ///< of one reconstruction; 0: as many as there are processors
  std::chrono::milliseconds timeout{300'000};
  uint64_t most_bytes = 0;  ///< of memory that one process may take; 0: three quarters of the machine's

  /// Its command line for one job.
  /// @param face  how the capture asked for the face; may be empty
  std::vector<std::string> arguments(const std::string& job, const std::string& face) const;
  /// Of memory; never 0.
  uint64_t memory_limit() const;
};

}  // namespace booth
