#include "tests/virtual_booth/guest/gpio_peer.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <utility>

namespace booth {
namespace {

namespace fs = std::filesystem;

const fs::path configuration = "/sys/kernel/config/gpio-sim/booth";
const fs::path tracing = "/sys/kernel/tracing/instances/booth";

void write(const fs::path& file, const std::string& text) {
  std::ofstream stream(file);
  stream << text << std::flush;
  if (!stream) throw std::runtime_error("cannot write " + file.string());
}

std::string read(const fs::path& file) {
  std::string text;
  std::ifstream(file) >> text;
  return text;
}

int first_line_of(const std::string& chip) {
  std::ifstream lines("/sys/kernel/debug/gpio");
  std::string line;
  while (std::getline(lines, line)) {
    int first = 0;
    if (line.starts_with(chip + ":") && std::sscanf(line.c_str() + chip.size(), ": GPIOs %d-", &first) == 1)
      return first;
  }
  throw std::runtime_error("the kernel does not know " + chip);
}

}  // namespace

GpioPeer::GpioPeer(int lines, const std::vector<std::string>& names, Listener listener)
    : listener_(std::move(listener)) {
  const fs::path bank = configuration / "bank0";
  fs::create_directories(bank);
  for (size_t i = 0; i < names.size(); ++i) {
    fs::create_directory(bank / ("line" + std::to_string(i)));
    write(bank / ("line" + std::to_string(i)) / "name", names[i]);
  }
  write(bank / "num_lines", std::to_string(lines));
  write(configuration / "live", "1");
  chip_ = read(bank / "chip_name");
  device_ = "/sys/devices/platform/" + read(configuration / "dev_name") + "/" + chip_;
  first_line_ = first_line_of(chip_);
  fs::create_directory(tracing);
  write(tracing / "trace_clock", "mono");
  write(tracing / "events/gpio/gpio_value/filter", "get==0");
  write(tracing / "events/gpio/gpio_value/enable", "1");
  thread_ = std::jthread([this] { watch(); });
}

GpioPeer::~GpioPeer() {
  ends_ = true;
  write(tracing / "trace_marker", "end");  // wakes the reader
  thread_.join();
  std::error_code ignored;
  fs::remove(tracing, ignored);
  write(configuration / "live", "0");
  for (int i = 0; fs::exists(configuration / "bank0" / ("line" + std::to_string(i))); ++i)
    fs::remove(configuration / "bank0" / ("line" + std::to_string(i)), ignored);
  fs::remove(configuration / "bank0", ignored);
  fs::remove(configuration, ignored);
}

int GpioPeer::level(int line) const { return std::stoi(read(device_ + "/sim_gpio" + std::to_string(line) + "/value")); }

void GpioPeer::set_pull(int line, bool up) {
  write(device_ + "/sim_gpio" + std::to_string(line) + "/pull", up ? "pull-up" : "pull-down");
}

void GpioPeer::watch() {
  std::ifstream trace(tracing / "trace_pipe");
  std::string line;
  while (!ends_ && std::getline(trace, line)) {
    // "… <seconds>.<microseconds>: gpio_value: <number> set <level>"
    const size_t event = line.find(": gpio_value: ");
    if (event == std::string::npos) continue;
    long long s = 0, us = 0;
    int number = 0, level = 0;
    const size_t time = line.rfind(' ', event) + 1;
    if (std::sscanf(line.c_str() + time, "%lld.%lld", &s, &us) != 2 ||
        std::sscanf(line.c_str() + event, ": gpio_value: %d set %d", &number, &level) != 2)
      continue;
    const Edge edge{s * 1'000'000 + us, number - first_line_, level};
    listener_(edge);
    const std::lock_guard lock(mutex_);
    edges_.push_back(edge);
    changed_.notify_all();
  }
}

std::vector<GpioPeer::Edge> GpioPeer::wait_edges(const std::vector<int>& lines, size_t count) {
  std::vector<Edge> found;
  std::unique_lock lock(mutex_);
  EXPECT_TRUE(changed_.wait_for(lock, std::chrono::seconds(60),
                                [&] {
                                  found.clear();
                                  std::copy_if(edges_.begin(), edges_.end(), std::back_inserter(found),
                                               [&](const Edge& edge) {
                                                 return std::find(lines.begin(), lines.end(), edge.line) != lines.end();
                                               });
                                  return found.size() >= count;
                                }))
      << found.size() << " of " << count << " edges came";
  return found;
}

void GpioPeer::forget_edges() {
  const std::lock_guard lock(mutex_);
  edges_.clear();
}

}  // namespace booth
