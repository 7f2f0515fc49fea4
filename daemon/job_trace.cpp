#include "daemon/job_trace.h"

#include <time.h>
#include <unistd.h>

#include <fstream>
#include <nlohmann/json.hpp>
#include <utility>

namespace booth {
namespace {

int64_t nanoseconds(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return now.tv_sec * 1'000'000'000LL + now.tv_nsec;
}

double resident_mebibytes() {
  static const double page_mebibytes = static_cast<double>(sysconf(_SC_PAGESIZE)) / (1 << 20);
  std::ifstream file("/proc/self/statm");
  double size = 0, resident = 0;
  file >> size >> resident;
  return resident * page_mebibytes;
}

double microseconds(int64_t nanoseconds) { return static_cast<double>(nanoseconds) / 1000; }

}  // namespace

JobTrace::JobTrace() : started_ns_(nanoseconds(CLOCK_MONOTONIC)) {}

Work JobTrace::watch(Work work) {
  work.mark = [this](std::string_view step) { mark(step); };
  if (!work.parallel) return work;
  work.parallel = [this, parallel = std::move(work.parallel)](size_t count, size_t grain, const Work::Range& body) {
    const std::string step = innermost();
    parallel(count, grain, [&](size_t from, size_t to) {
      begin(step, true);
      try {
        body(from, to);
      } catch (...) {
        end();
        throw;
      }
      end();
    });
  };
  return work;
}

void JobTrace::mark(std::string_view step) {
  if (step.empty())
    end();
  else
    begin(step, false);
}

std::string JobTrace::innermost() {
  const std::lock_guard lock(mutex_);
  const std::vector<Open>& open = open_[static_cast<size_t>(thread())];
  return open.empty() ? "loop" : open.back().name;
}

void JobTrace::begin(std::string_view name, bool piece) {
  const int64_t now = nanoseconds(CLOCK_MONOTONIC);
  const int64_t processor = nanoseconds(CLOCK_THREAD_CPUTIME_ID);
  const std::lock_guard lock(mutex_);
  open_[static_cast<size_t>(thread())].push_back({std::string(name), piece, now, processor});
  if (!piece) memory_.push_back({now - started_ns_, resident_mebibytes()});
}

void JobTrace::end() {
  const int64_t now = nanoseconds(CLOCK_MONOTONIC);
  const int64_t processor = nanoseconds(CLOCK_THREAD_CPUTIME_ID);
  const std::lock_guard lock(mutex_);
  const int here = thread();
  std::vector<Open>& open = open_[static_cast<size_t>(here)];
  if (open.empty()) return;
  Open& done = open.back();
  if (!done.piece) memory_.push_back({now - started_ns_, resident_mebibytes()});
  events_.push_back({std::move(done.name), here, done.piece, done.begin_ns - started_ns_, now - done.begin_ns,
                     processor - done.begin_processor_ns});
  open.pop_back();
}

int JobTrace::thread() {
  const auto [entry, is_new] = threads_.try_emplace(std::this_thread::get_id(), static_cast<int>(threads_.size()));
  if (is_new) open_.emplace_back();
  return entry->second;
}

std::string JobTrace::json() const {
  const std::lock_guard lock(mutex_);
  nlohmann::json events = nlohmann::json::array();
  for (size_t i = 0; i < open_.size(); ++i)
    events.push_back({{"ph", "M"},
                      {"name", "thread_name"},
                      {"pid", 1},
                      {"tid", i},
                      {"args", {{"name", i == 0 ? "main" : "helper " + std::to_string(i)}}}});
  for (const Event& event : events_)
    events.push_back({{"ph", "X"},
                      {"name", event.name},
                      {"cat", event.piece ? "piece" : "step"},
                      {"pid", 1},
                      {"tid", event.thread},
                      {"ts", microseconds(event.begin_ns)},
                      {"dur", microseconds(event.wall_ns)},
                      {"tdur", microseconds(event.processor_ns)}});
  for (const Sample& sample : memory_)
    events.push_back({{"ph", "C"},
                      {"name", "resident memory"},
                      {"pid", 1},
                      {"ts", microseconds(sample.at_ns)},
                      {"args", {{"MiB", sample.mebibytes}}}});
  return nlohmann::json{{"traceEvents", std::move(events)}, {"displayTimeUnit", "ms"}}.dump();
}

}  // namespace booth
