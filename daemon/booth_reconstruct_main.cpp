// booth-reconstruct: one recording in, one avatar folder out. For batches, tests, benchmarks, and as the child
// process in which boothd runs a job.

#include <fcntl.h>
#include <malloc.h>
#include <signal.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <nlohmann/json.hpp>
#include <optional>
#include <stop_token>
#include <string>
#include <thread>

#include "config/booth_config.h"
#include "daemon/face_model_loader.h"
#include "daemon/job_trace.h"
#include "daemon/progress_pipe.h"
#include "daemon/reconstruct_job.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"

namespace booth {
namespace {

constexpr int exit_failed = 1;
constexpr int exit_usage = 2;

/// A bar on a terminal that is drawn over itself.
class ProgressBar {
 public:
  void draw(std::string_view stage, double fraction) {
    const int percent = static_cast<int>(100 * fraction);
    if (percent == percent_ && stage == stage_) return;
    percent_ = percent;
    stage_ = stage;
    constexpr int width = 40;
    const int filled = static_cast<int>(width * fraction);
    std::string bar;
    for (int i = 0; i < width; ++i) bar += i < filled ? "█" : "·";
    std::fprintf(stderr, "\r%s %3d %%  %-14s", bar.c_str(), percent, stage_.c_str());
    drawn_ = true;
  }
  /// Leaves the line to whatever is written next.
  void clear() {
    if (drawn_) std::fputs("\r\033[K", stderr);
    drawn_ = false;
  }

 private:
  int percent_ = -1;
  std::string stage_;
  bool drawn_ = false;
};

/// Turns SIGINT and SIGTERM into a stop request, so that a job that is ended leaves no half-made folder.
class StopOnSignal {
 public:
  StopOnSignal() {
    sigset_t signals;
    sigemptyset(&signals);
    for (const int signal : {SIGINT, SIGTERM, SIGUSR1}) sigaddset(&signals, signal);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);
    waiter_ = std::jthread([this, signals] {
      int signal = 0;
      sigwait(&signals, &signal);
      if (signal != SIGUSR1) stop_.request_stop();
    });
  }
  ~StopOnSignal() { pthread_kill(waiter_.native_handle(), SIGUSR1); }
  StopOnSignal(const StopOnSignal&) = delete;
  StopOnSignal& operator=(const StopOnSignal&) = delete;

  std::stop_token token() const { return stop_.get_token(); }

 private:
  std::stop_source stop_;
  std::jthread waiter_;
};

struct Arguments {
  std::string recording, avatar, config, face, texture, trace, cache;
  bool timings = false, learn = false, growing = false;
  int progress_fd = -1;
  unsigned threads = 0;
};

void tell_health(const ProgressPipe& pipe, const std::vector<CameraHealth>& cameras) {
  for (const CameraHealth& camera : cameras)
    pipe.tell({{"health",
                {{"camera", camera.camera},
                 {"moved", camera.moved},
                 {"offset_px", camera.offset_px},
                 {"deviation", camera.deviation},
                 {"light_factor", camera.light_factor},
                 {"shifted", camera.shifted},
                 {"background_px", camera.background_px},
                 {"background_share", camera.background_share}}}});
  pipe.tell({{"health", nullptr}});
}

int fail(const ProgressPipe& pipe, const Error& error, int status) {
  pipe.tell({{"error", {{"kind", to_string(error.code)}, {"message", error.message}}}});
  std::cerr << "booth-reconstruct: " << error.message << "\n";
  return status;
}

/// Learns the empty booth into the cache, and no more.
int learn(const Arguments& arguments) {
  const auto recording = read_recording(arguments.recording);
  const Shot* background = recording ? recording->find(ShotRole::background) : nullptr;
  if (background == nullptr) {
    std::cerr << "booth-reconstruct: "
              << (recording ? "recording.json: shots has none with the role background" : recording.error().message)
              << "\n";
    return exit_failed;
  }
  ThreadPool pool(arguments.threads);
  const EmptyViewStore kept(arguments.cache);
  const EmptyBooth learned = learn_background(*recording, *background, &kept, pool.work());
  for (const std::string& fault : learned.faults) std::cerr << "warning: " << fault << "\n";
  return 0;
}

int run(const Arguments& arguments) {
  if (arguments.learn) return learn(arguments);
  const ProgressPipe pipe(arguments.progress_fd);
  BoothConfig config;
  if (!arguments.config.empty()) {
    auto loaded = load_config(arguments.config);
    if (!loaded) return fail(pipe, loaded.error(), exit_usage);
    config = std::move(*loaded);
  }
  ReconstructionOptions options = config.reconstruct;
  if (!arguments.face.empty()) options.face = *face_mode_from(arguments.face);
  if (!arguments.texture.empty()) options.atlas.method = *texture_method_from(arguments.texture);

  const auto started = std::chrono::steady_clock::now();
  const StopOnSignal stop;
  ThreadPool pool(arguments.threads);
  JobTrace trace;
  Work work = arguments.trace.empty() ? pool.work() : trace.watch(pool.work());
  work.stop = stop.token();
  ProgressBar bar;
  const bool draw = isatty(STDERR_FILENO) != 0 && arguments.progress_fd < 0;
  std::optional<EmptyViewStore> kept;
  if (!arguments.cache.empty()) kept.emplace(arguments.cache);
  FaceModelLoader face_model(config.face.landmark_model);
  // Beside the stages that come before it, so that it need not be waited for.
  if (options.face == FaceMode::passive) face_model.start();
  const auto on_complete = [&](const Recording& recording) {
    if (options.face == FaceMode::automatic && recording.find(ShotRole::gray_code) == nullptr) face_model.start();
  };
  auto recording =
      arguments.growing ? RecordingSource(arguments.recording, STDIN_FILENO) : RecordingSource(arguments.recording);
  const auto made = reconstruct_recording(
      recording, arguments.avatar, options,
      {.model = [&] { return face_model.get(); },
       .detector = [&] { return load_face_detector(config.face.cascade); },
       .kept = kept ? &*kept : nullptr,
       .on_complete = on_complete},
      config.files, work,
      [&](std::string_view stage, double fraction) {
        if (draw) bar.draw(stage, fraction);
        pipe.tell({{"stage", stage}, {"fraction", fraction}});
      },
      [&](const std::vector<CameraHealth>& cameras) { tell_health(pipe, cameras); });
  bar.clear();
  if (!arguments.trace.empty() && !(std::ofstream(arguments.trace) << trace.json() << std::flush))
    std::cerr << "warning: " << arguments.trace << ": the trace cannot be written\n";
  if (!made) return fail(pipe, made.error(), exit_failed);
  for (const std::string& warning : made->warnings) std::cerr << "warning: " << warning << "\n";
  if (arguments.timings) {
    nlohmann::ordered_json times;
    for (const auto& [stage, seconds] : made->stage_seconds) times[stage] = seconds;
    times["total"] = std::chrono::duration<double>(std::chrono::steady_clock::now() - started).count();
    std::cout << times.dump() << std::endl;
  }
  return 0;
}

}  // namespace
}  // namespace booth

int main(int argc, char** argv) {
  // Stages take and give back rasters of megabytes: kept by the process, they need not be zeroed anew each time.
  constexpr int largest_kept_bytes = 32 << 20;
  constexpr int most_kept_bytes = 1 << 30;
  mallopt(M_MMAP_THRESHOLD, largest_kept_bytes);
  mallopt(M_TRIM_THRESHOLD, most_kept_bytes);

  booth::Arguments arguments;
  CLI::App app("Makes a rigged, textured avatar from a recorded capture.", "booth-reconstruct");
  app.add_option("RECORDING", arguments.recording, "folder in the recording format")->required();
  auto* avatar = app.add_option("OUT_DIR", arguments.avatar, "where the avatar's folder will appear");
  app.add_option("--face", arguments.face, "how the face is made")
      ->check(CLI::IsMember({"active", "passive", "none", "auto"}));
  app.add_option("--texture", arguments.texture, "how the photographs become one texture")
      ->check(CLI::IsMember({"full", "blend", "best_view"}));
  app.add_option("--config", arguments.config, "the booth's configuration file");
  app.add_flag("--timings", arguments.timings, "print the seconds of each stage as JSON");
  app.add_option("--trace", arguments.trace,
                 "write where time and memory went to this file, for ui.perfetto.dev or chrome://tracing");
  auto* cache = app.add_option("--cache", arguments.cache,
                               "folder in which what was learned of the empty booth is kept for the next job");
  auto* learn = app.add_flag("--learn", arguments.learn, "learn the empty booth into the cache, make no avatar")
                    ->needs(cache)
                    ->excludes(avatar);
  app.add_flag(
         "--growing", arguments.growing,
         "the recording is still being written: standard input says, a line each, {\"so_far\": \"FOLDER\"} for what "
         "can be read already, and at last {\"complete\": true}")
      ->excludes(learn);
  app.add_option("--threads", arguments.threads, "how many to use; 0 for as many as there are processors")
      ->check(CLI::Range(0, 1024));
  app.add_option("--progress-fd", arguments.progress_fd,
                 "write progress as lines of JSON to this open file descriptor");
  app.set_version_flag("--version", BOOTH_VERSION);
  try {
    app.parse(argc, argv);
    if (learn->empty() && avatar->empty()) throw CLI::RequiredError("OUT_DIR");
  } catch (const CLI::ParseError& e) {
    const int status = app.exit(e);
    return status == 0 ? 0 : booth::exit_usage;
  }
  try {
    return booth::run(arguments);
  } catch (const std::exception& e) {
    return booth::fail(booth::ProgressPipe(arguments.progress_fd), {booth::ErrorCode::internal, e.what()},
                       booth::exit_failed);
  }
}
