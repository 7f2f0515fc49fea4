#include <gmock/gmock.h>
#include <signal.h>

#include "daemon/job_queue.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;

class Jobs : public TestBooth {
 protected:
  void start_with(const std::string& behaviour) {
    reconstruct_.behave(behaviour);
    start();
  }
  std::string quick_capture() { return capture({{"face", "none"}}); }
  bool session_busy() { return !call("system.status")["capture"].is_null(); }
  bool avatars_are_clean() { return entries(options_.config.booth.avatars()).empty(); }
};

TEST_F(Jobs, WhatWasLearnedOfTheEmptyBoothIsPreparedBeforeTheFirst) {
  start_with("good");
  ASSERT_TRUE(wait_until([&] { return !reconstruct_.learned().empty(); }));
  const std::string background = entries(options_.config.booth.backgrounds()).at(0);
  EXPECT_EQ(reconstruct_.learned(), (options_.config.booth.backgrounds() / background).string() + " --learn --cache " +
                                        options_.config.booth.cache().string());
  EXPECT_EQ(reconstruct_.calls(), 0U);
  EXPECT_TRUE(wait_job(quick_capture(), "done"));
}

TEST_F(Jobs, OneBeginsWhileItsCaptureIsUnderWay) {
  start();
  const std::string id = capture({{"countdown_s", 0.5}});
  ASSERT_TRUE(wait_until([&] { return !reconstruct_.news().empty(); }));
  EXPECT_EQ(job(id)["state"], "not_found");
  ASSERT_TRUE(wait_job(id, "done"));
  EXPECT_EQ(reconstruct_.calls(), 1U);
  const auto news = reconstruct_.news();
  ASSERT_GE(news.size(), 2U);
  EXPECT_THAT(Json::parse(news.front())["so_far"].get<std::string>(), HasSubstr(".partial-" + id));
  EXPECT_EQ(Json::parse(news.back()), Json({{"complete", true}}));
}

TEST_F(Jobs, NoneBeginsEarlyWhereThatIsSwitchedOff) {
  options_.config.jobs.head_start = false;
  start();
  ASSERT_TRUE(wait_job(quick_capture(), "done"));
  EXPECT_EQ(reconstruct_.early(), 0);
}

TEST_F(Jobs, NoneBeginsEarlyWhileEveryWorkerHasAJob) {
  start_with("hang");
  const std::string first = quick_capture();
  ASSERT_TRUE(wait_job(first, "running"));
  ASSERT_TRUE(wait_until([&] { return reconstruct_.calls() == 1; }));
  const size_t told = reconstruct_.news().size();
  ASSERT_TRUE(wait_job(quick_capture(), "queued"));
  EXPECT_EQ(reconstruct_.news().size(), told);
}

TEST_F(Jobs, OneThatBeganEarlyEndsWithACancelledCapture) {
  start();
  const std::string id = capture({{"countdown_s", 60}});
  ASSERT_TRUE(wait_until([&] { return !reconstruct_.news().empty(); }));
  const pid_t process = reconstruct_.early();
  ASSERT_GT(process, 0);
  call("capture.cancel", {{"capture", id}});
  EXPECT_TRUE(wait_until([&] { return !session_busy(); }));
  EXPECT_EQ(::kill(process, 0), -1);
  EXPECT_TRUE(avatars_are_clean());
  EXPECT_TRUE(wait_job(quick_capture(), "done"));
}

TEST_F(Jobs, OneThatBeganEarlyEndsWithADeletedCapture) {
  start();
  const std::string id = capture({{"countdown_s", 60}});
  ASSERT_TRUE(wait_until([&] { return !reconstruct_.news().empty(); }));
  call("capture.delete", {{"capture", id}});
  EXPECT_TRUE(wait_until([&] { return traces(id).empty(); }));
  EXPECT_EQ(::kill(reconstruct_.early(), 0), -1);
}

TEST_F(Jobs, OneWhoseEarlyProcessDiedIsDoneAllTheSame) {
  start_with("die_early");
  const std::string id = capture({{"countdown_s", 0.2}});
  ASSERT_TRUE(wait_job(id, "done"));
  EXPECT_GT(reconstruct_.early(), 0);
  EXPECT_EQ(reconstruct_.calls(), 1U);
  EXPECT_TRUE(wait_job(quick_capture(), "done"));
}

TEST_F(Jobs, TheBoothStopsWithACaptureWhoseJobBeganEarly) {
  start();
  capture({{"countdown_s", 60}});
  ASSERT_TRUE(wait_until([&] { return !reconstruct_.news().empty(); }));
  const pid_t process = reconstruct_.early();
  stop();
  EXPECT_EQ(::kill(process, 0), -1);
}

TEST_F(Jobs, AFailureIsTold) {
  start_with("fail");
  Listener listener(options_.config.api.events, booth_.get());
  const std::string id = quick_capture();
  const auto failed = listener.find("job.failed");
  ASSERT_TRUE(failed);
  EXPECT_EQ(failed->fields["error"], Json({{"kind", "no_subject"}, {"message", "nobody is in the pictures"}}));
  EXPECT_EQ(job(id)["state"], "failed");
  EXPECT_EQ(job(id)["error"]["kind"], "no_subject");
  EXPECT_TRUE(job(id).at("avatar").is_null());
  EXPECT_THAT(call("system.status")["queue"], SizeIs(1));
  EXPECT_TRUE(avatars_are_clean());
  EXPECT_EQ(refusal("job.cancel", {{"job", id}}), "invalid_state");
}

TEST_F(Jobs, AFailureWithoutAWordIsToldToo) {
  start_with("silent_fail");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "failed"));
  EXPECT_EQ(job(id)["error"]["kind"], "internal");
  EXPECT_THAT(job(id)["error"]["message"].get<std::string>(), HasSubstr("status 3: out of luck"));
}

TEST_F(Jobs, ACrashIsRetriedOnceThenFails) {
  start_with("crash");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "failed"));
  EXPECT_EQ(reconstruct_.calls(), 2);
  EXPECT_EQ(job(id)["error"]["kind"], "internal");
  EXPECT_THAT(job(id)["error"]["message"].get<std::string>(), HasSubstr("signal 11"));
  EXPECT_EQ(call("system.status")["state"], "idle");
}

TEST_F(Jobs, ACrashThatDoesNotRepeatIsMended) {
  start_with("crash_once");
  EXPECT_TRUE(wait_job(quick_capture(), "done"));
}

TEST_F(Jobs, NoAvatarIsAFailure) {
  start_with("nothing");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "failed"));
  EXPECT_EQ(job(id)["error"]["kind"], "internal");
}

TEST_F(Jobs, AProgramThatIsNotThereIsAFailure) {
  options_.reconstruct_command = folder_.path() / "nothing";
  start();
  EXPECT_TRUE(wait_job(quick_capture(), "failed"));
}

TEST_F(Jobs, TakesNoLongerThanAllowed) {
  options_.config.jobs.timeout_s = 1;
  start_with("hang");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "failed"));
  EXPECT_EQ(job(id)["error"]["kind"], "timeout");
  EXPECT_EQ(reconstruct_.calls(), 2) << "it was tried again once";
  reconstruct_.behave("good");
  EXPECT_TRUE(wait_job(quick_capture(), "done")) << "the next one runs";
}

TEST_F(Jobs, TakesNoMoreMemoryThanAllowed) {
  options_.config.jobs.memory_mib = 200;
  start_with("glutton");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "failed"));
  EXPECT_EQ(job(id)["error"]["kind"], "out_of_memory");
  EXPECT_EQ(reconstruct_.calls(), 2) << "it was tried again once";
  reconstruct_.behave("good");
  EXPECT_TRUE(wait_job(quick_capture(), "done")) << "the next one runs";
}

TEST_F(Jobs, TheBoothTakesTheNextCaptureMeanwhile) {
  start_with("hang");
  ASSERT_TRUE(wait_job(quick_capture(), "running"));
  EXPECT_EQ(call("system.status")["state"], "idle");
  EXPECT_TRUE(wait_job(quick_capture(), "queued"));
}

TEST_F(Jobs, ARunningOneIsCancelledAndRetried) {
  start_with("hang");
  Listener listener(options_.config.api.events, booth_.get());
  const std::string id = quick_capture();
  ASSERT_TRUE(listener.find("job.progress"));
  EXPECT_EQ(job(id)["stage"], "hull");
  EXPECT_EQ(refusal("job.retry", {{"job", id}}), "invalid_state");
  call("job.cancel", {{"job", id}});
  EXPECT_EQ(job(id)["state"], "cancelled");
  const auto cancelled = listener.find("job.cancelled");
  ASSERT_TRUE(cancelled);
  EXPECT_EQ(cancelled->fields["job"], id);
  EXPECT_EQ(refusal("job.cancel", {{"job", id}}), "invalid_state");

  reconstruct_.behave("good");
  call("job.retry", {{"job", id}});
  ASSERT_TRUE(listener.find("avatar.published"));
  EXPECT_EQ(job(id)["state"], "done");
  EXPECT_EQ(refusal("job.retry", {{"job", id}}), "invalid_state");
}

TEST_F(Jobs, AQueuedOneIsCancelledForGood) {
  start_with("hang");
  const std::string first = quick_capture();
  ASSERT_TRUE(wait_job(first, "running"));
  const std::string second = quick_capture();
  ASSERT_TRUE(wait_job(second, "queued"));
  call("job.cancel", {{"job", second}});
  stop();
  reconstruct_.behave("good");
  start();
  EXPECT_TRUE(wait_job(first, "done")) << "the running one goes on";
  EXPECT_EQ(job(second)["state"], "cancelled");
  EXPECT_EQ(job(second)["error"]["kind"], "cancelled");
}

TEST_F(Jobs, ARunningOneIsDeletedWithEverything) {
  start_with("hang");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_until([&] { return job(id)["stage"] == "hull"; }));
  call("capture.delete", {{"capture", id}});
  EXPECT_TRUE(wait_until([&] { return traces(id).empty(); }));
  EXPECT_EQ(job(id)["state"], "not_found");
}

TEST_F(Jobs, CancelledAtAnyMomentLeavesNoAvatar) {
  start();
  for (int i = 0; i < 12; ++i) {
    const std::string id = quick_capture();
    ASSERT_TRUE(wait_until([&] { return job(id)["state"] != "not_found"; }));
    std::this_thread::sleep_for(std::chrono::milliseconds(2 * i));
    const bool cancelled = refusal("job.cancel", {{"job", id}}).empty();
    ASSERT_TRUE(wait_job(id, cancelled ? "cancelled" : "done"));
    if (cancelled) {
      EXPECT_TRUE(wait_until([&] { return !fs::exists(options_.config.booth.avatars() / id); }));
      EXPECT_EQ(refusal("avatar.get", {{"avatar", id}}), "not_found");
    }
  }
}

TEST_F(Jobs, DeletingAnAvatarDeletesThePerson) {
  start();
  Listener listener(options_.config.api.events, booth_.get());
  const std::string id = quick_capture();
  ASSERT_TRUE(listener.find("avatar.published"));
  EXPECT_EQ(call("avatar.delete", {{"avatar", id}}), Json::object());
  EXPECT_TRUE(wait_until([&] { return traces(id).empty(); }));
  const auto deleted = listener.find("avatar.deleted");
  ASSERT_TRUE(deleted);
  EXPECT_EQ(deleted->fields["avatar"], id);
  EXPECT_THAT(call("avatar.list")["avatars"], IsEmpty());
  EXPECT_EQ(call("avatar.delete", {{"avatar", id}}), Json::object());
}

TEST_F(Jobs, ACaptureWithoutAJobGetsOneAtTheStart) {
  start_with("hang");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "running"));
  stop();
  fs::remove(options_.config.booth.jobs() / (id + ".json"));
  std::ofstream(options_.config.booth.jobs() / "broken.json") << "{\"id\":";
  reconstruct_.behave("good");
  start();
  EXPECT_TRUE(wait_job(id, "done"));
  EXPECT_THAT(call("job.list")["jobs"], SizeIs(1));
}

TEST_F(Jobs, AJobWithoutACaptureGoesAtTheStart) {
  start_with("hang");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "running"));
  stop();
  fs::remove_all(options_.config.booth.recordings() / id);
  start();
  EXPECT_THAT(call("job.list")["jobs"], IsEmpty());
}

TEST_F(Jobs, AnInterruptedDeletionIsFinishedAtTheStart) {
  start();
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "done"));
  stop();
  std::ofstream(options_.config.booth.state_directory / "deleting" / id);
  start();
  EXPECT_THAT(traces(id), IsEmpty());
  EXPECT_THAT(call("avatar.list")["avatars"], IsEmpty());
}

TEST_F(Jobs, HalfMadeThingsAreClearedAwayAtTheStart) {
  const auto& config = options_.config.booth;
  for (const fs::path& parent : {config.recordings(), config.avatars(), config.backgrounds()})
    fs::create_directories(parent / ".partial-x.1.1" / "frames");
  start();
  EXPECT_THAT(traces(".partial"), IsEmpty());
}

TEST_F(Jobs, AnAvatarThatAppearedBeforeTheCrashIsPublished) {
  start_with("hang");
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "running"));
  stop();
  const size_t calls = reconstruct_.calls();
  const fs::path folder = options_.config.booth.avatars() / id;
  fs::create_directories(folder);
  std::ofstream(folder / "metadata.json") << Json{{"id", id}, {"recording", id}, {"created", "2026-11-22T10:15:00Z"}};
  start();
  EXPECT_TRUE(wait_job(id, "done"));
  EXPECT_EQ(reconstruct_.calls(), calls);
}

TEST_F(Jobs, ADoneOneWithoutItsAvatarIsDoneAgainAtTheStart) {
  start();
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "done"));
  stop();
  fs::remove_all(options_.config.booth.avatars() / id);
  start();
  EXPECT_TRUE(wait_until([&] { return fs::exists(options_.config.booth.avatars() / id); }));
  EXPECT_TRUE(wait_job(id, "done"));
}

TEST_F(Jobs, AnAvatarWithoutAJobKeepsItAndIsNotMadeAgain) {
  start();
  const std::string id = quick_capture();
  ASSERT_TRUE(wait_job(id, "done"));
  stop();
  fs::remove(options_.config.booth.jobs() / (id + ".json"));
  start();
  EXPECT_EQ(job(id)["state"], "done");
  EXPECT_EQ(reconstruct_.calls(), 1);
}

/// A queue that another version of the program left.
TEST_F(Jobs, AQueueSurvivesAnUpgradeAndTheWayBack) {
  start_with("hang");
  std::vector<std::string> ids;
  for (int i = 0; i < 3; ++i) {
    ids.push_back(quick_capture());
    ASSERT_TRUE(wait_until([&] { return !session_busy(); }));
  }
  ASSERT_TRUE(wait_job(ids[2], "queued"));
  stop();
  const fs::path folder = options_.config.booth.jobs();
  // The first program's, a newer one's, and this one's.
  std::ofstream(folder / (ids[0] + ".json"))
      << Json{{"id", ids[0]}, {"face", "none"}, {"label", ""}, {"died", 0}, {"interrupted", 1}, {"state", "running"}};
  std::ofstream(folder / (ids[1] + ".json"))
      << Json{{"version", 7}, {"id", ids[1]}, {"state", "waiting_for_cloud"}, {"priority", "high"}};
  EXPECT_EQ(Json::parse(std::ifstream(folder / (ids[2] + ".json")))["version"], 1);
  reconstruct_.behave("good");
  start();
  for (const std::string& id : ids) EXPECT_TRUE(wait_job(id, "done")) << id;
}

TEST(JobQueue, AJobThatDiedWaitsForTheOthers) {
  const ScratchFolder folder;
  EventBus events;
  auto queue = JobQueue::open(folder.path(), events);
  ASSERT_TRUE(queue);
  for (const char* id : {"a", "b", "c"}) (*queue)->add({.id = id, .face = "auto"}), (*queue)->release(id);
  const auto take = [&] { return (*queue)->take({}, std::chrono::milliseconds(0)); };
  const auto first = take();
  ASSERT_EQ(first->job.id, "a");
  EXPECT_TRUE((*queue)->died(*first, 1, {"internal", "it crashed"}));
  (*queue)->release(*first);
  for (const char* id : {"b", "c", "a"}) {
    const auto next = take();
    ASSERT_EQ(next->job.id, id);
    if (next->job.id == "a") {
      (*queue)->died(*next, 1, {"internal", "it crashed"});
    } else {
      (*queue)->finish(*next);
    }
    (*queue)->release(*next);
  }
  EXPECT_EQ((*queue)->find("a")->state, JobState::failed);
  EXPECT_FALSE(take());
}

TEST(JobQueue, CountsThatAreNoneAreNotCounted) {
  const ScratchFolder folder;
  EventBus events;
  for (const char* count : {"1e300", "-9223372036854775808", "\"many\"", "null", "2.5"}) {
    std::ofstream(folder.path() / "a.json")
        << R"({"id": "a", "state": "queued", "interrupted": )" << count << R"(, "died": )" << count << "}";
    const auto queue = JobQueue::open(folder.path(), events);
    ASSERT_TRUE(queue);
    const auto job = (*queue)->find("a");
    ASSERT_TRUE(job) << count;
    EXPECT_EQ(job->state, JobState::queued) << count;
    EXPECT_EQ(job->died, 0) << count;
    EXPECT_LE(job->interrupted, 1) << count;
  }
}

TEST(JobQueue, AJobThatIsThereWheneverTheDaemonDiesFailsAtLast) {
  const ScratchFolder folder;
  EventBus events;
  {
    auto queue = JobQueue::open(folder.path(), events);
    ASSERT_TRUE(queue);
    (*queue)->add({.id = "poison", .face = "auto"});
    (*queue)->release("poison");
    ASSERT_TRUE((*queue)->persist("poison"));
  }
  int starts = 0;
  for (; starts < 100; ++starts) {
    auto queue = JobQueue::open(folder.path(), events);
    ASSERT_TRUE(queue);
    const auto lease = (*queue)->take({}, std::chrono::milliseconds(0));
    if (!lease) break;
    ASSERT_TRUE((*queue)->persist("poison"));  // and here the daemon dies
  }
  EXPECT_GT(starts, 3);
  EXPECT_LT(starts, 100);
  auto queue = JobQueue::open(folder.path(), events);
  EXPECT_EQ((*queue)->find("poison")->state, JobState::failed);
  ASSERT_TRUE((*queue)->retry("poison"));
  EXPECT_EQ((*queue)->find("poison")->state, JobState::queued);
}

}  // namespace
}  // namespace booth::test
