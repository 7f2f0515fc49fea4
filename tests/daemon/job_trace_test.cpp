#include "daemon/job_trace.h"

#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <map>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "pipeline/thread_pool.h"

namespace booth {
namespace {

using Json = nlohmann::json;

std::vector<Json> events_of(const JobTrace& trace, const std::string& phase) {
  std::vector<Json> found;
  const Json document = Json::parse(trace.json());
  for (const Json& event : document.at("traceEvents"))
    if (event.at("ph") == phase) found.push_back(event);
  return found;
}

bool holds(const Json& outer, const Json& inner) {
  const double begin = outer["ts"], end = begin + outer["dur"].get<double>();
  return outer["tid"] == inner["tid"] && begin <= inner["ts"] &&
         inner["ts"].get<double>() + inner["dur"].get<double>() <= end;
}

TEST(JobTrace, ShowsStepsWithinSteps) {
  JobTrace trace;
  const Work work = trace.watch({});
  {
    const Step outer(work, "hull");
    const Step inner(work, "hull: carving");
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  const auto steps = events_of(trace, "X");
  ASSERT_EQ(steps.size(), 2U);
  EXPECT_EQ(steps[0]["name"], "hull: carving");
  EXPECT_EQ(steps[1]["name"], "hull");
  EXPECT_TRUE(holds(steps[1], steps[0]));
  EXPECT_GE(steps[0]["dur"].get<double>(), 5000);
  EXPECT_LT(steps[0]["tdur"].get<double>(), steps[0]["dur"].get<double>()) << "a sleeping thread takes no processor";
}

TEST(JobTrace, NamesPiecesByTheStepThatStartedTheirLoopOnEveryThread) {
  JobTrace trace;
  ThreadPool pool(3);
  const Work work = trace.watch(pool.work());
  std::atomic<int> begun{0};
  {
    const Step step(work, "surface");
    work.parallel_for(3, 1, [&](size_t, size_t) {
      ++begun;
      while (begun < 3) std::this_thread::yield();
    });
  }
  std::map<int, int> pieces_by_thread;
  for (const Json& event : events_of(trace, "X")) {
    EXPECT_EQ(event["name"], "surface");
    if (event["cat"] == "piece") ++pieces_by_thread[event["tid"].get<int>()];
  }
  EXPECT_EQ(pieces_by_thread, (std::map<int, int>{{0, 1}, {1, 1}, {2, 1}}));
  EXPECT_EQ(events_of(trace, "M").size(), 3U) << "every thread has a name";
}

TEST(JobTrace, EndsThePieceThatThrows) {
  JobTrace trace;
  ThreadPool pool(2);
  const Work work = trace.watch(pool.work());
  EXPECT_THROW(work.parallel_for(8, 1,
                                 [](size_t begin, size_t) {
                                   if (begin == 3) throw std::runtime_error("piece");
                                 }),
               std::runtime_error);
  { const Step step(work, "after"); }
  EXPECT_EQ(events_of(trace, "X").back()["name"], "after");
}

TEST(JobTrace, SamplesTheMemoryAtEachStep) {
  JobTrace trace;
  const Work work = trace.watch({});
  constexpr size_t mebibytes = 64;
  std::vector<char> held;
  {
    const Step step(work, "load");
    held.assign(mebibytes << 20, 'x');
  }
  const auto samples = events_of(trace, "C");
  ASSERT_EQ(samples.size(), 2U);
  EXPECT_GT(samples[1]["args"]["MiB"].get<double>() - samples[0]["args"]["MiB"].get<double>(), mebibytes / 2);
}

}  // namespace
}  // namespace booth
