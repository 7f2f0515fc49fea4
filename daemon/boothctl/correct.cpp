#include "daemon/boothctl/correct.h"

#include <iostream>

#include "pipeline/hull/rig_correction_report.h"
#include "pipeline/thread_pool.h"

namespace booth {

CorrectCommand::CorrectCommand(CLI::App& calibrate) {
  option_ = calibrate.add_option("--correct", options_->recordings,
                                 "without a board: recordings of people, from which a correction is proposed for "
                                 "cameras that were moved since");
}

Result<void> CorrectCommand::run(const std::filesystem::path& out) const {
  OfflineCorrectionOptions options = *options_;
  options.out = out;
  ThreadPool pool;
  const auto correction = correct_from_recordings(options, pool.work());
  if (!correction) return correction.error();
  for (const std::string& message : correction->messages) std::cout << "note: " << message << "\n";
  for (const CameraCorrection& camera : correction->cameras)
    if (camera.moved) std::cout << describe(camera) << "\n";
  std::cout << describe(*correction) << "\n";
  if (correction->needed)
    std::cout << "proposed in " << (out / "rig.json").string() << ", with its evidence in "
              << (out / "report.html").string() << "; nothing was changed\n";
  return {};
}

}  // namespace booth
