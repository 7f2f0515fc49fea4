#include "daemon/disk_guard.h"

#include <gmock/gmock.h>

#include "daemon/retention.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;

constexpr uint64_t mebibyte = 1024 * 1024;

class Disk : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    options_.free_space = [this](const fs::path&) { return free_bytes_.load(); };
  }
  std::string done_capture(const Json& params = {{"face", "none"}}) {
    const std::string id = capture(params);
    EXPECT_TRUE(wait_job(id, "done"));
    return id;
  }
  std::vector<std::string> recordings() {
    auto found = entries(options_.config.booth.recordings());
    std::sort(found.begin(), found.end());
    return found;
  }
  std::atomic<uint64_t> free_bytes_{uint64_t{100} * 1024 * mebibyte};
};

TEST_F(Disk, RefusesACaptureThatMayNotFitAndTakesItWhenThereIsRoom) {
  options_.config.disk.reserve_mib = 1000;
  start();
  const uint64_t needed = call("system.status")["disk"]["capture_bytes"];
  EXPECT_GT(needed, 0);
  free_bytes_ = 1000 * mebibyte + needed - 1;
  ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == false; }));
  const Response refused = client().call("capture.start");
  EXPECT_EQ(refused.code(), -32005);
  EXPECT_EQ(refused.kind(), "disk_full");
  EXPECT_THAT(refused.message["error"]["message"].get<std::string>(), HasSubstr("1000 MiB must stay free"));
  EXPECT_THAT(recordings(), IsEmpty());
  free_bytes_ = 1000 * mebibyte + needed;
  ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == true; }));
  done_capture();
  const Json disk = call("system.status")["disk"];
  EXPECT_EQ(disk["free_bytes"], 1000 * mebibyte + needed);
  EXPECT_EQ(disk["limit_bytes"], 1000 * mebibyte);
  EXPECT_EQ(disk["quota_bytes"], 0);
}

TEST_F(Disk, TheQuotaHoldsWhatIsStored) {
  options_.config.disk.limit_mib = 65;  // one capture of tiny pictures, and what its avatar may take
  start();
  EXPECT_EQ(call("system.status")["disk"]["quota_bytes"], 65 * mebibyte);
  const std::string id = done_capture();
  const fs::path made = options_.config.booth.avatars() / ".partial-another.1.1";
  fs::create_directories(made);
  std::ofstream(made / "texture.png") << std::string(2 * mebibyte, 'x');
  fs::rename(made, options_.config.booth.avatars() / "another");
  ASSERT_TRUE(wait_until([&] { return call("system.status")["ready"] == false; }));
  EXPECT_EQ(refusal("capture.start"), "disk_full");
  EXPECT_GE(call("system.status")["disk"]["used_bytes"], 2 * mebibyte);
  fs::remove_all(options_.config.booth.avatars() / "another");
  EXPECT_TRUE(wait_until([&] { return call("system.status")["ready"] == true; }));
}

TEST_F(Disk, ACaptureTakesNoMoreThanForetold) {
  start();
  const std::string id = done_capture({{"face", "active"}});
  uint64_t taken = 0;
  for (const fs::path& folder : {options_.config.booth.recordings() / id, options_.config.booth.avatars() / id})
    for (const auto& entry : fs::recursive_directory_iterator(folder))
      if (entry.is_regular_file()) taken += entry.file_size();
  EXPECT_LE(taken, call("system.status")["disk"]["capture_bytes"].get<uint64_t>());
}

TEST(LargestCapture, GrowsWithCamerasFramesAndPatterns) {
  Rig rig;
  for (const char* id : {"b0", "f0"}) {
    RigCamera& camera = rig.cameras.emplace_back();
    camera.id = id;
    camera.role = id[0] == 'f' ? CameraRole::face : CameraRole::body;
    camera.intrinsics.width = 1000;
    camera.intrinsics.height = 1000;
  }
  const uint64_t base = largest_capture_bytes(rig, {}, 0, false);
  EXPECT_EQ(largest_capture_bytes(rig, {}, 1, false) - base, 6'000'000);
  EXPECT_EQ(largest_capture_bytes(rig, {}, 1, true) - base, 6'000'000) << "there is no projector";
  rig.projector.emplace();
  rig.projector->intrinsics.width = 1024;
  rig.projector->intrinsics.height = 768;
  EXPECT_EQ(largest_capture_bytes(rig, {}, 1, true) - base, 6'000'000 + 42 * 3'000'000);
  EXPECT_LT(largest_capture_bytes(rig, {.format = SpoolOptions::Format::jpeg}, 1, true),
            largest_capture_bytes(rig, {}, 1, true));
}

TEST_F(Disk, OnlySoManyCapturesAreKept) {
  options_.config.retention.max_captures = 2;
  start();
  reconstruct_.behave("fail");
  const std::string failed = capture({{"face", "none"}});
  ASSERT_TRUE(wait_job(failed, "failed"));
  reconstruct_.behave("good");
  std::vector<std::string> ids;
  for (int i = 0; i < 4; ++i) ids.push_back(done_capture());
  ASSERT_TRUE(wait_until([&] { return recordings().size() == 3; }));
  EXPECT_THAT(recordings(), ElementsAre(failed, ids[2], ids[3])) << "what has no avatar yet stays";
  EXPECT_TRUE(wait_until([&] { return traces(ids[0]).empty() && traces(ids[1]).empty(); }));
}

TEST_F(Disk, TheOldestMakesRoomForTheNext) {
  options_.config.retention.make_room = true;
  start();
  std::vector<std::string> ids;
  for (int i = 0; i < 3; ++i) ids.push_back(done_capture());
  // There is room while no more than one recording is stored.
  options_.config.disk.reserve_mib = 1000;
  stop();
  options_.free_space = [this](const fs::path&) {
    return recordings().size() > 1 ? 1000 * mebibyte : 100'000 * mebibyte;
  };
  start();
  EXPECT_TRUE(wait_until([&] { return recordings() == std::vector<std::string>{ids[2]}; }));
  EXPECT_EQ(job(ids[2])["state"], "done");
}

class Retention : public testing::Test {
 protected:
  void add(const std::string& id, const std::string& created, JobState state = JobState::done) {
    avatars_.insert(
        avatars_.begin(),
        AvatarSummary{
            .id = id, .created = created, .label = {}, .capture = id, .files = {}, .triangles = {}, .warnings = {}});
    jobs_->add({.id = id, .face = "auto", .state = state});
  }
  std::vector<std::string> chosen(const RetentionConfig& config, bool room = true) {
    return avatars_to_delete(config, avatars_, *jobs_, now_, room);
  }
  const ScratchFolder folder_;
  EventBus events_;
  std::unique_ptr<JobQueue> jobs_ = *JobQueue::open(folder_.path(), events_);
  std::vector<AvatarSummary> avatars_;
  const std::chrono::system_clock::time_point now_ =
      std::chrono::sys_days(std::chrono::year(2026) / 11 / 22) + std::chrono::hours(12);
};

TEST_F(Retention, WhatIsTooOldGoesOldestFirst) {
  add("a", "2026-11-20T12:00:00Z");
  add("b", "2026-11-21T11:59:59Z");
  add("c", "2026-11-21T12:00:00Z");
  add("d", "2026-11-22T12:00:00Z");
  EXPECT_THAT(chosen({.max_age_h = 24}), ElementsAre("a", "b"));
  EXPECT_THAT(chosen({}), IsEmpty());
  EXPECT_THAT(chosen({.max_age_h = 24, .max_captures = 1}), ElementsAre("a", "b", "c"));
}

TEST_F(Retention, WhatIsNotDoneStays) {
  add("a", "2026-11-01T12:00:00Z", JobState::queued);
  add("b", "2026-11-01T12:00:01Z", JobState::running);
  add("c", "2026-11-01T12:00:02Z", JobState::failed);
  add("d", "2026-11-01T12:00:03Z");
  EXPECT_THAT(chosen({.max_age_h = 1, .max_captures = 1, .make_room = true}, false), ElementsAre("d"));
}

TEST_F(Retention, OnlyTheOldestMakesRoom) {
  add("a", "2026-11-01T12:00:00Z");
  add("b", "2026-11-01T12:00:01Z");
  EXPECT_THAT(chosen({.make_room = true}, false), ElementsAre("a"));
  EXPECT_THAT(chosen({.make_room = true}, true), IsEmpty());
  EXPECT_THAT(chosen({.make_room = false}, false), IsEmpty());
}

TEST_F(Retention, AClockThatWasNotSetMakesNothingOld) {
  add("a", "1970-01-01T00:03:00Z");
  EXPECT_THAT(chosen({.max_age_h = 1}), IsEmpty());
}

TEST_F(Retention, AClockThatWasSetBackMakesNothingOld) {
  add("a", "2026-11-22T12:00:00Z");
  add("b", "2031-11-22T12:00:00Z");
  EXPECT_THAT(chosen({.max_age_h = 1}), IsEmpty());
}

}  // namespace
}  // namespace booth::test
