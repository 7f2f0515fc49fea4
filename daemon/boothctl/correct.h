#pragma once

#include <CLI/CLI.hpp>
#include <functional>
#include <memory>

#include "daemon/offline_correction.h"
#include "pipeline/types/result.h"

namespace booth {

/// `boothctl calibrate --correct RECORDING…`: beside what the subcommand does otherwise.
class CorrectCommand {
 public:
  /// Adds its option; `out`, an option of the subcommand that both use, stays the caller's.
  explicit CorrectCommand(CLI::App& calibrate);

  bool wanted() const { return !options_->recordings.empty(); }
  CLI::Option* option() const { return option_; }
  /// Prints what it found. @error as correct_from_recordings
  Result<void> run(const std::filesystem::path& out) const;

 private:
  std::shared_ptr<OfflineCorrectionOptions> options_ = std::make_shared<OfflineCorrectionOptions>();
  CLI::Option* option_ = nullptr;
};

}  // namespace booth
