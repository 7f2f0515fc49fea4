// What the Aravis driver costs and how quick it is, against virtual GigE cameras on a network of this process' own.
//
//   gige_benchmark [SECONDS]
//
// Prints, a line each: frames a second sustained and dropped, and processor time per gigabyte, of the driver and of
// arv-camera-test --auto (Debian package aravis-tools; left out where it is not installed) from the same camera; the
// time from a trigger to the last of three cameras' frames; the time from a camera's return to its first frame.

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "drivers/aravis/aravis_source.h"
#include "tests/virtual_booth/gige/gige_camera.h"

namespace booth {
namespace {

constexpr int cameras = 3;
constexpr int width = 1600, height = 1200;
constexpr double rate_hz = 50;  // 96 MB/s: what a gigabit network carries

double seconds_of(const timeval& time) {
  return static_cast<double>(time.tv_sec) + 1e-6 * static_cast<double>(time.tv_usec);
}
double processor_seconds(const rusage& usage) { return seconds_of(usage.ru_utime) + seconds_of(usage.ru_stime); }
double own_processor_seconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return processor_seconds(usage);
}

/// The cameras, in a process of their own so that their work is not counted as ours.
class Peers {
 public:
  Peers() {
    std::array<int, 2> commands{}, answers{};
    if (pipe(commands.data()) != 0 || pipe(answers.data()) != 0) throw std::runtime_error("no pipe");
    child_ = fork();
    if (child_ == 0) {
      close(commands[1]);
      close(answers[0]);
      serve(commands[0], answers[1]);
      _exit(0);
    }
    close(commands[0]);
    close(answers[1]);
    commands_ = commands[1];
    answers_ = answers[0];
    receive();
  }
  ~Peers() {
    close(commands_);
    close(answers_);
    waitpid(child_, nullptr, 0);
  }
  Peers(const Peers&) = delete;
  Peers& operator=(const Peers&) = delete;

  void pulse() { send('p'); }
  void power_off() { send('0'), receive(); }
  void power_on() { send('1'), receive(); }

 private:
  static void serve(int commands, int answers) {
    std::vector<std::unique_ptr<virtual_booth::GigeCamera>> all;
    auto scene = std::make_shared<Image>(width, height, 1);
    for (size_t i = 0; i < scene->samples.size(); ++i) scene->samples[i] = static_cast<uint8_t>(i * 31);
    for (int i = 0; i < cameras; ++i)
      all.push_back(std::make_unique<virtual_booth::GigeCamera>(
          virtual_booth::GigeCameraOptions{.address = virtual_booth::camera_address(i), .scenes = {scene}}));
    char command = '+';
    do {
      if (command == 'p')
        for (const auto& camera : all) camera->pulse();
      if (command == '0') all[0]->power_off();
      if (command == '1') all[0]->power_on();
      if (command != 'p' && write(answers, &command, 1) != 1) return;
    } while (read(commands, &command, 1) == 1);
  }
  void send(char command) {
    if (write(commands_, &command, 1) != 1) throw std::runtime_error("the cameras are gone");
  }
  void receive() {
    char answer = 0;
    if (read(answers_, &answer, 1) != 1) throw std::runtime_error("the cameras are gone");
  }

  pid_t child_ = 0;
  int commands_ = -1, answers_ = -1;
};

AravisSettings settings() {
  AravisSettings all;
  for (int i = 0; i < cameras; ++i)
    all.cameras.push_back({.id = "cam-" + std::to_string(i),
                           .address = virtual_booth::camera_address(i),
                           .exposure_us = 1000,
                           .pixel_format = "Mono8",
                           .preview_fps = rate_hz,
                           .packet_size = 1500,
                           .buffers = 50});  // as arv-camera-test has
  return all;
}

template <class Value>
Value must(Result<Value> result) {
  if (!result) throw std::runtime_error(result.error().message);
  return *std::move(result);
}
void must(const Result<void>& result) {
  if (!result) throw std::runtime_error(result.error().message);
}

double statistic(const Camera& camera, const std::string& name) {
  for (const Statistic& one : camera.statistics())
    if (one.name == name) return one.value;
  return 0;
}

void report_throughput(const char* who, double frames, double dropped, double duration, double processor_s) {
  const double gigabytes = frames * width * height / 1e9;
  std::printf("%-16s %5.1f frames/s %6.1f MB/s  %4.0f of %4.0f dropped  %.2f CPU s/GB\n", who, frames / duration,
              1000 * gigabytes / duration, dropped, frames + dropped, processor_s / gigabytes);
}

void measure_own_throughput(AravisSource& source, const Clock& clock, int duration_s) {
  const auto camera = must(source.open_camera("cam-0"));
  const double processor_before = own_processor_seconds();
  must(camera->arm({.mode = CaptureMode::preview}, 1));
  const Timestamp begin = clock.now(), end = begin + seconds(duration_s);
  double frames = 0;
  int last = -1, skipped = 0;
  while (clock.now() < end) {
    const auto frame = camera->wait_frame(end);
    if (!frame) continue;
    ++frames;
    skipped += frame->index - last - 1;
    last = frame->index;
  }
  const double lasted = static_cast<double>(clock.now() - begin) / 1e9;
  const double dropped = skipped + statistic(*camera, "n_underruns") + statistic(*camera, "n_missing_frames");
  report_throughput("driver", frames, dropped, lasted, own_processor_seconds() - processor_before);
}

/// One of the counters that arv-camera-test prints at its end: "n_failures  = 0".
double counter(const std::string& output, const std::string& name) {
  const size_t at = output.find(name);
  const size_t value = at == std::string::npos ? at : output.find('=', at);
  return value == std::string::npos ? 0 : std::strtod(output.c_str() + value + 1, nullptr);
}

void measure_their_throughput(int duration_s) {
  std::array<int, 2> output{};
  if (pipe(output.data()) != 0) throw std::runtime_error("no pipe");
  const std::string name = virtual_booth::camera_address(0), duration = std::to_string(duration_s),
                    rate = std::to_string(rate_hz), size = "--gv-packet-size=1500";
  const pid_t child = fork();
  if (child == 0) {
    dup2(output[1], STDOUT_FILENO);
    close(output[0]);
    execlp("arv-camera-test-0.8", "arv-camera-test-0.8", "--name", name.c_str(), "--duration", duration.c_str(),
           "--frequency", rate.c_str(), "--exposure", "1000", "--no-packet-socket", "--auto", size.c_str(), nullptr);
    _exit(127);
  }
  close(output[1]);
  std::string text;
  std::array<char, 4096> part{};
  for (ssize_t count = 0; (count = read(output[0], part.data(), part.size())) > 0;)
    text.append(part.data(), static_cast<size_t>(count));
  close(output[0]);
  int status = 0;
  rusage usage{};
  wait4(child, &status, 0, &usage);
  if (WIFEXITED(status) && WEXITSTATUS(status) == 127) {
    std::printf("arv-camera-test  left out: it is not installed\n");
    return;
  }
  const double dropped = counter(text, "n_failures") + counter(text, "n_underruns") + counter(text, "n_missing_frames");
  report_throughput("arv-camera-test", counter(text, "n_completed_buffers"), dropped, duration_s,
                    processor_seconds(usage));
}

void measure_latency(AravisSource& source, Peers& peers, const Clock& clock) {
  std::vector<std::unique_ptr<Camera>> all;
  for (int i = 0; i < cameras; ++i) all.push_back(must(source.open_camera("cam-" + std::to_string(i))));
  constexpr size_t pulses = 100;
  std::vector<double> latencies;
  for (size_t i = 0; i < pulses; ++i) {
    for (const auto& camera : all) must(camera->arm({}, 1));
    const Timestamp fired = clock.now();
    peers.pulse();
    for (const auto& camera : all) must(camera->wait_frame(clock.now() + seconds(5)));
    latencies.push_back(static_cast<double>(clock.now() - fired) / 1e6);
  }
  std::sort(latencies.begin(), latencies.end());
  std::printf("trigger to the last of %d frames (1 ms exposure): median %.1f ms, 95 %% %.1f ms, worst %.1f ms\n",
              cameras, latencies[pulses / 2], latencies[pulses * 95 / 100], latencies.back());
}

void measure_reconnection(AravisSource& source, Peers& peers, const Clock& clock) {
  auto camera = must(source.open_camera("cam-0"));
  must(camera->arm({}, 1));
  peers.power_off();
  const Timestamp off = clock.now();
  camera->note_trigger(0, off);
  while (camera->wait_frame(clock.now() + seconds(1)).error().code != ErrorCode::device_lost) {
  }
  const double noticed_s = static_cast<double>(clock.now() - off) / 1e9;
  camera.reset();
  peers.power_on();
  const Timestamp back = clock.now();
  for (;;) {
    auto opened = source.open_camera("cam-0");
    if (opened) {
      camera = *std::move(opened);
      break;
    }
  }
  must(camera->arm({}, 1));
  peers.pulse();
  must(camera->wait_frame(clock.now() + seconds(5)));
  std::printf("loss noticed %.2f s after the trigger it did not answer, first frame %.3f s after its return\n",
              noticed_s, static_cast<double>(clock.now() - back) / 1e9);
}

void measure(int duration_s) {
  Peers peers;
  const MonotonicClock clock;
  const auto source =
      must(AravisSource::create(settings(), clock, [](const std::string& warning) { std::cerr << warning << "\n"; }));
  measure_own_throughput(*source, clock, duration_s);
  measure_their_throughput(duration_s);
  measure_latency(*source, peers, clock);
  measure_reconnection(*source, peers, clock);
}

}  // namespace
}  // namespace booth

int main(int count, char** arguments) {
  const int duration_s = count > 1 ? std::atoi(arguments[1]) : 10;
  if (duration_s < 1) {
    std::cerr << "usage: gige_benchmark [SECONDS]\n";
    return 2;
  }
  const std::string reason = booth::virtual_booth::enter_own_network(booth::cameras);
  if (!reason.empty()) {
    std::cerr << reason << "\n";
    return 1;
  }
  try {
    booth::measure(duration_s);
  } catch (const std::exception& fault) {
    std::cerr << fault.what() << "\n";
    return 1;
  }
}
