// booth-calibrate: what a calibration under way has seen of the board, and the rig that follows from it. The child
// process in which boothd does both, so that no picture takes the booth down.

#include <CLI/CLI.hpp>
#include <cstdio>
#include <iostream>
#include <opencv2/core/utility.hpp>
#include <string>

#include "daemon/board_look.h"
#include "daemon/offline_calibration.h"
#include "daemon/progress_pipe.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"

namespace booth {
namespace {

constexpr int exit_failed = 1;
constexpr int exit_usage = 2;

struct Arguments {
  std::string session, previous;
  bool keep_unseen = false;
  int progress_fd = -1;
  unsigned threads = 0;
};

int fail(const ProgressPipe& pipe, const Error& error) {
  pipe.tell({{"error", {{"kind", to_string(error.code)}, {"message", error.message}}}});
  std::cerr << "booth-calibrate: " << error.message << "\n";
  return exit_failed;
}

Result<void> solve(const BoardSession& session, const Arguments& arguments, const Work& work) {
  OfflineCalibrationOptions options;
  options.out = session.solution();
  options.nominal = true;
  options.keep_unseen = arguments.keep_unseen;
  for (const std::string& shot : session.shots()) options.recordings.push_back(session.shots_folder() / shot);
  if (!arguments.previous.empty()) {
    auto previous = read_rig(arguments.previous);
    if (!previous) return previous.error();
    options.previous = std::move(*previous);
  }
  const auto solved = calibrate_recordings(options, work);
  if (!solved) return solved.error();
  return {};
}

int run(const Arguments& arguments, bool solving) {
  const ProgressPipe pipe(arguments.progress_fd);
  const BoardSession session(arguments.session);
  ThreadPool pool(arguments.threads);
  Work work = pool.work();
  work.progress = [&pipe](double fraction) { pipe.tell({{"fraction", fraction}}); };
  const auto done = solving ? solve(session, arguments, work) : look_at_boards(session, work);
  return done ? 0 : fail(pipe, done.error());
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  cv::setNumThreads(1);  // pictures are looked at side by side already, by as many threads as asked for

  booth::Arguments arguments;
  CLI::App app("Looks at the shots of a calibration under way, or solves it.", "booth-calibrate");
  app.require_subcommand(1);
  app.fallthrough();
  app.add_option("--threads", arguments.threads, "how many to use; 0 for as many as there are processors")
      ->check(CLI::Range(0, 1024));
  app.add_option("--progress-fd", arguments.progress_fd,
                 "write progress as lines of JSON to this open file descriptor");
  app.set_version_flag("--version", BOOTH_VERSION);
  auto* look = app.add_subcommand("look", "find the board in the new shots, and judge all: SESSION/look.json");
  auto* solve = app.add_subcommand("solve", "solve the rig: SESSION/solution");
  for (auto* command : {look, solve})
    command->add_option("SESSION", arguments.session, "the folder of the calibration")->required();
  solve->add_option("--previous", arguments.previous, "the rig.json that was in force until now");
  solve->add_flag("--keep-unseen", arguments.keep_unseen,
                  "cameras that never saw the board keep their previous calibration");
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    const int status = app.exit(e);
    return status == 0 ? 0 : booth::exit_usage;
  }
  try {
    return booth::run(arguments, solve->parsed());
  } catch (const std::exception& e) {
    return booth::fail(booth::ProgressPipe(arguments.progress_fd), {booth::ErrorCode::internal, e.what()});
  }
}
