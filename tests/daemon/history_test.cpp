#include <gmock/gmock.h>

#include "daemon/health_history.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::Each;
using testing::ElementsAre;
using testing::IsEmpty;
using testing::SizeIs;

constexpr std::chrono::sys_seconds monday{std::chrono::sys_days{std::chrono::year{2026} / 11 / 23}};
constexpr size_t all_samples = 100'000;

/// A booth's history that is shown one observation after the other, on a clock turned by hand.
class History : public testing::Test {
 protected:
  void SetUp() override { spdlog::set_level(spdlog::level::off); }
  void start() {
    history_.emplace(file_);
    now_.totals = {};
    now_.cameras = {{.id = "b0"}, {.id = "b1"}};
    history_->observe(now_);
  }
  void pass(std::chrono::seconds time) {
    now_.time += time;
    now_.steady += time;
    saves_ += history_->observe(now_);
  }
  std::vector<HealthSample> all() const { return history_->samples({}, all_samples); }
  HealthSample sum() const { return history_->samples({}, 1).at(0); }

  const ScratchFolder folder_;
  const fs::path file_ = folder_.path() / "history.json";
  HealthObservation now_{.time = monday, .steady = {}, .ready = true};
  std::optional<HealthHistory> history_;
  int saves_ = 0;
};

TEST_F(History, SumsUpWhatHappenedAndKeepsTheWorst) {
  start();
  now_.free_bytes = 500;
  now_.queued = 3;
  now_.totals = {.captures_done = 2, .jobs_done = 1, .job_seconds = 4.5};
  now_.cameras = {{.id = "b0", .frames = 20, .dropped = 1}, {.id = "b1", .offline = true, .frames = 7}};
  pass(std::chrono::seconds(100));
  now_.ready = false;
  now_.free_bytes = 900;
  now_.queued = 0;
  now_.totals.captures_failed = 1;
  now_.cameras[0].frames = 30;
  now_.cameras[1].offline = false;
  pass(std::chrono::seconds(50));
  ASSERT_THAT(all(), SizeIs(1));
  const HealthSample sample = sum();
  EXPECT_EQ(sample.begin, monday);
  EXPECT_EQ(sample.end, monday + std::chrono::seconds(150));
  EXPECT_EQ(sample.observed_s, 150);
  EXPECT_EQ(sample.ready_s, 100);
  EXPECT_EQ(sample.starts, 1U);
  EXPECT_EQ(sample.totals.captures_done, 2);
  EXPECT_EQ(sample.totals.captures_failed, 1);
  EXPECT_EQ(sample.totals.jobs_done, 1);
  EXPECT_EQ(sample.totals.job_seconds, 4.5);
  EXPECT_EQ(sample.most_queued, 3U);
  EXPECT_EQ(sample.least_free_bytes, 0U) << "as the first observation had it";
  EXPECT_EQ(sample.cameras.at("b0").frames, 30U);
  EXPECT_EQ(sample.cameras.at("b0").dropped, 1U);
  EXPECT_EQ(sample.cameras.at("b1").offline_s, 100);
}

TEST_F(History, GrowsCoarserWithAgeAndLosesNothingOfItsSums) {
  start();
  constexpr int days = 30;
  for (int step = 0; step < days * 288; ++step) {
    now_.totals.captures_done += 1;
    pass(std::chrono::minutes(5));
  }
  EXPECT_EQ(saves_, days * 288) << "one whenever a sample is complete";
  EXPECT_THAT(all(), SizeIs(testing::AllOf(testing::Gt(600U), testing::Lt(660U))));
  EXPECT_EQ(sum().totals.captures_done, days * 288);
  EXPECT_EQ(sum().observed_s, days * 86400);
  for (size_t i = 1; i < all().size(); ++i) EXPECT_LE(all()[i - 1].end, all()[i].begin);
  const auto latest = history_->samples(now_.time - std::chrono::hours(6), all_samples);
  EXPECT_THAT(latest, SizeIs(73)) << "those of five minutes";
  EXPECT_THAT(history_->samples(now_.time - std::chrono::hours(6), 10), SizeIs(10));
}

TEST_F(History, IsBoundedForEver) {
  start();
  for (int day = 0; day < 3000; ++day) {
    now_.cameras[0].frames += 1;
    pass(std::chrono::hours(24));
  }
  EXPECT_LE(all().size(), 288U + 336U + 400U);
  EXPECT_EQ(all().back().end, now_.time);
}

TEST_F(History, GoesOnAfterARestart) {
  start();
  now_.totals.captures_done = 5;
  pass(std::chrono::seconds(40));
  ASSERT_TRUE(history_->save());
  now_.time += std::chrono::seconds(20);
  now_.steady = {};
  start();
  now_.totals.captures_done = 2;
  pass(std::chrono::seconds(60));
  ASSERT_THAT(all(), SizeIs(1)) << "a short sample is gone on with";
  EXPECT_EQ(sum().starts, 2U);
  EXPECT_EQ(sum().totals.captures_done, 7);
  EXPECT_EQ(sum().observed_s, 100) << "the time between was nobody's";
  EXPECT_EQ(sum().end, monday + std::chrono::seconds(120));
}

TEST_F(History, BeginsANewSampleAfterALongPause) {
  start();
  pass(std::chrono::seconds(40));
  ASSERT_TRUE(history_->save());
  now_.time += std::chrono::hours(60);
  start();
  EXPECT_THAT(all(), SizeIs(2));
}

TEST_F(History, StandsAClockThatIsStepped) {
  start();
  for (const int hours : {1, -48, 400 * 24, -800 * 24}) {
    now_.time += std::chrono::hours(hours);
    now_.totals.captures_done += 1;
    pass(std::chrono::minutes(5));
  }
  EXPECT_EQ(sum().totals.captures_done, 4);
  EXPECT_EQ(sum().observed_s, 4 * 300);
  ASSERT_TRUE(history_->save());
  const HealthHistory read(file_);
  EXPECT_EQ(read.samples({}, 1).at(0).totals.captures_done, 4);
}

TEST_F(History, ADamagedFileIsBegunAnew) {
  start();
  pass(std::chrono::minutes(5));
  ASSERT_TRUE(history_->save());
  const std::string whole = [&] {
    std::ifstream stream(file_);
    return std::string(std::istreambuf_iterator<char>(stream), {});
  }();
  for (const std::string& text : {whole.substr(0, whole.size() / 2), std::string(), std::string("[]"),
                                  std::string(R"({"version": 2, "fine": []})"), std::string(100, '\0')}) {
    std::ofstream(file_) << text;
    const HealthHistory read(file_);
    EXPECT_THAT(read.samples({}, all_samples), IsEmpty());
    EXPECT_TRUE(read.save()) << "it can be kept again";
  }
  // One sample that is none does not take the others along.
  Json file = Json::parse(whole);
  file["fine"].push_back(file["fine"][0]);
  file["fine"][0]["least_free_bytes"] = -1;
  std::ofstream(file_) << file;
  EXPECT_THAT(HealthHistory(file_).samples({}, all_samples), SizeIs(1));
}

TEST_F(History, ASampleIsReadAsItWasWritten) {
  start();
  now_.cameras = {{.id = "b0", .offline = true, .frames = 3, .dropped = 2}};
  now_.used_bytes = 77;
  pass(std::chrono::seconds(7));
  const Json json = to_json(sum());
  const auto read = health_sample_from(json);
  ASSERT_TRUE(read);
  EXPECT_EQ(to_json(*read), json);
  for (const auto& [name, value] : json.items()) {
    Json without = json;
    without.erase(name);
    EXPECT_FALSE(health_sample_from(without)) << name;
  }
  for (const char* beyond_the_clock : {"6220-11-22T10:00:00Z", "0001-01-01T00:00:00Z", "tomorrow"}) {
    Json strange = json;
    strange["end"] = beyond_the_clock;
    EXPECT_FALSE(health_sample_from(strange)) << beyond_the_clock;
  }
}

class HistoryOfABooth : public TestBooth {};

TEST_F(HistoryOfABooth, IsToldAndOutlivesTheService) {
  start();
  capture({{"face", "none"}});
  ASSERT_TRUE(wait_until([&] {
    const Json told = call("system.history")["samples"];
    return !told.empty() && told.back()["captures_done"] == 1 && told.back()["jobs_done"] == 1;
  }));
  stop();
  start();
  ASSERT_TRUE(wait_until([&] { return call("system.history")["samples"].back()["starts"] == 2; }));
  const Json sample = call("system.history", {{"hours", 1}, {"limit", 1}})["samples"].at(0);
  EXPECT_EQ(sample["captures_done"], 1);
  EXPECT_EQ(sample["captures_failed"], 0);
  EXPECT_GT(sample["job_s"], 0);
  EXPECT_GT(sample["observed_s"], 0);
  EXPECT_GT(sample["least_free_bytes"], 0);
  EXPECT_GT(sample["most_threads"], 1);
  ASSERT_THAT(sample["cameras"], SizeIs(6));
  EXPECT_EQ(sample["cameras"][0]["id"], "b0");
  EXPECT_EQ(sample["cameras"][0]["frames"], 1);
  EXPECT_EQ(refusal("system.history", {{"hours", 0}}), "invalid_params");
}

TEST_F(HistoryOfABooth, NeedsNoFileToGoOn) {
  fs::create_directories(options_.config.booth.state_directory / "history.json");  // a folder: cannot be written
  start();
  EXPECT_THAT(call("system.history")["samples"], SizeIs(testing::Le(1U)));
  capture({{"face", "none"}});
  EXPECT_TRUE(wait_until([&] {
    const Json told = call("system.history")["samples"];
    return !told.empty() && told.back()["captures_done"] == 1;
  }));
}

}  // namespace
}  // namespace booth::test
