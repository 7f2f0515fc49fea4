#include "replay/replay_devices.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <atomic>
#include <thread>

#include "pipeline/image/codec.h"
#include "replay/durable_folder.h"
#include "replay/recording_writer.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

/// A clock that only the test turns.
class HandClock final : public Clock {
 public:
  Timestamp now() const override { return now_; }
  void advance(Timestamp by) { now_ += by; }

 private:
  std::atomic<Timestamp> now_ = seconds(1000);
};

constexpr GrayCodePattern pattern{.width = 4, .height = 2, .columns = true, .rows = true, .inverse = true};

CalibratedView view(const std::string& id) {
  CalibratedView made;
  made.id = id;
  made.intrinsics = {.width = 16, .height = 8, .fx = 20, .fy = 20, .cx = 8, .cy = 4};
  return made;
}

/// A grey picture whose every pixel is `value`.
Frame plain(const std::string& camera, int index, int value) {
  return {.camera = camera,
          .index = index,
          .timestamp_ns = seconds(5) + milliseconds(40) * index + (camera == "left" ? 0 : 70'000),
          .exposure_us = 4000,
          .pixels = std::make_shared<const Image>(16, 8, 1, static_cast<uint8_t>(value))};
}

/// Three backgrounds (10, 11, 12), a body (20), patterns (100 …) and three boards (30, 31, 32): the grey values of the
/// left camera; the right one's are higher by 128, and it has no background 1.
class Replay : public testing::Test {
 protected:
  void SetUp() override {
    Rig rig;
    rig.volume = {Eigen::Vector3d(-1, 0, -1), Eigen::Vector3d(1, 2, 1)};
    for (const char* id : {"left", "right"}) static_cast<CalibratedView&>(rig.cameras.emplace_back()) = view(id);
    rig.projector = view("projector");
    auto writer = RecordingWriter::begin(scratch_.path(), {.id = "played", .created = "2026-11-22T10:15:00Z"}, rig);
    ASSERT_TRUE(writer) << writer.error().message;
    const CalibrationBoard board{.squares_x = 8, .squares_y = 11, .square_m = 0.06, .marker_m = 0.04, .dictionary = ""};
    ASSERT_TRUE((*writer)->begin_shot({.name = "background", .role = ShotRole::background}));
    ASSERT_TRUE((*writer)->begin_shot({.name = "body", .role = ShotRole::body}));
    ASSERT_TRUE((*writer)->begin_shot({.name = "face", .role = ShotRole::gray_code, .pattern = pattern}));
    ASSERT_TRUE((*writer)->begin_shot({.name = "board", .role = ShotRole::calibration_board, .board = board}));
    for (const char* camera : {"left", "right"}) {
      const int higher = camera == std::string("left") ? 0 : 128;
      for (int i = 0; i < 3; ++i) {
        if (higher == 0 || i != 1) {
          ASSERT_TRUE((*writer)->add("background", plain(camera, i, higher + 10 + i)));
        }
        ASSERT_TRUE((*writer)->add("board", plain(camera, i, higher + 30 + i)));
      }
      ASSERT_TRUE((*writer)->add("body", plain(camera, 0, higher + 20)));
      for (int i = 0; i < pattern_count(pattern); ++i)
        ASSERT_TRUE((*writer)->add("face", plain(camera, i, higher + 100 + i)));
    }
    const auto committed = (*writer)->commit();
    ASSERT_TRUE(committed) << committed.error().message;
  }

  /// Opens everything.
  void play(std::vector<ReplayFault> faults = {}, ReplayOptions::Pace pace = ReplayOptions::Pace::fast) {
    left.reset(), right.reset(), trigger.reset(), projector.reset();
    auto opened = ReplaySource::open(
        {.recording = scratch_.path() / "played", .pace = pace, .faults = std::move(faults), .cache_mib = 1}, clock);
    ASSERT_TRUE(opened) << opened.error().message;
    source = *opened;
    left = *source->open_camera("left");
    right = *source->open_camera("right");
    trigger = *source->open_trigger();
    projector = *source->open_projector();
  }

  void arm(ShotRole role, int count) const {
    for (Camera* camera : {left.get(), right.get()}) ASSERT_TRUE(camera->arm({.role = role}, count));
  }
  /// What the next frame shows, or why there is none.
  std::string next(Camera& camera, Timestamp wait = 0) const {
    const auto frame = camera.wait_frame(clock.now() + wait);
    if (!frame) return std::string(to_string(frame.error().code));
    return std::to_string(frame->index) + ":" + std::to_string(frame->pixels->samples[0]);
  }

  ScratchFolder scratch_;
  HandClock clock;
  std::shared_ptr<ReplaySource> source;
  std::unique_ptr<Camera> left, right;
  std::unique_ptr<Trigger> trigger;
  std::unique_ptr<Projector> projector;
};

TEST_F(Replay, EveryRoleHasItsFrames) {
  play();
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:20");
  EXPECT_EQ(next(*right), "0:148");
  arm(ShotRole::background, 3);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:10");
  EXPECT_EQ(next(*left), "1:11");
  EXPECT_EQ(next(*left), "2:12");
  EXPECT_EQ(next(*right), "0:138");
  EXPECT_EQ(next(*right), "2:140") << "the frame that was not recorded is missing again";
  EXPECT_EQ(next(*right), "timeout");
}

TEST_F(Replay, MoreTriggersThanRecordedFramesBeginAnew) {
  play();
  arm(ShotRole::background, 5);
  for (int i = 0; i < 5; ++i) ASSERT_TRUE(trigger->fire());
  for (const char* expected : {"0:10", "1:11", "2:12", "3:10", "4:11"}) EXPECT_EQ(next(*left), expected);
}

TEST_F(Replay, CapturesRepeatTheSame) {
  play();
  for (int capture = 0; capture < 50; ++capture) {
    arm(ShotRole::body, 1);
    ASSERT_TRUE(trigger->fire());
    ASSERT_EQ(next(*left), "0:20");
    ASSERT_EQ(next(*right), "0:148");
    left->stop();
  }
}

TEST_F(Replay, GrayCodeFramesShowWhatTheProjectorShows) {
  play();
  arm(ShotRole::gray_code, 4);
  for (const int shown : {0, 7, 3}) {
    ASSERT_TRUE(projector->show(shown));
    ASSERT_TRUE(trigger->fire());
  }
  projector->dark();
  ASSERT_TRUE(trigger->fire());
  for (const char* expected : {"0:100", "1:107", "2:103", "3:107"}) EXPECT_EQ(next(*left), expected);
  EXPECT_EQ(projector->show(pattern_count(pattern)).error().code, ErrorCode::invalid_argument);
  EXPECT_EQ(projector->show(-1).error().code, ErrorCode::invalid_argument);
  EXPECT_EQ(pattern_count(projector->info().pattern), pattern_count(pattern));
}

TEST_F(Replay, ClosingTheProjectorDarkensIt) {
  play();
  ASSERT_TRUE(projector->show(0));
  projector.reset();
  arm(ShotRole::gray_code, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:107");
  EXPECT_TRUE(source->open_projector());
}

TEST_F(Replay, TheBoardMovesOnFromShotToShot) {
  play();
  for (const char* expected : {"0:30", "0:31", "0:32", "0:30"}) {
    arm(ShotRole::calibration_board, 1);
    ASSERT_TRUE(trigger->fire());
    EXPECT_EQ(next(*left), expected);
  }
}

TEST_F(Replay, TimestampsAreTheTriggersWithTheRecordedSkew) {
  play();
  arm(ShotRole::body, 1);
  clock.advance(seconds(7));
  const auto fired = trigger->fire();
  ASSERT_TRUE(fired);
  EXPECT_EQ(*fired, clock.now());
  const auto first = left->wait_frame(clock.now());
  const auto second = right->wait_frame(clock.now());
  ASSERT_TRUE(first && second);
  EXPECT_EQ(first->timestamp_ns, *fired);
  EXPECT_EQ(second->timestamp_ns, *fired + 70'000);
  EXPECT_EQ(first->exposure_us, 4000);
  EXPECT_EQ(first->encoded->size(), fs::file_size(scratch_.path() / "played/frames/body/left.png"));
}

TEST_F(Replay, AtRealPaceFramesTakeExposureAndTransfer) {
  play({}, ReplayOptions::Pace::real);
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "timeout");
  clock.advance(milliseconds(4));
  EXPECT_EQ(next(*left), "timeout") << "exposed, but not transferred";
  clock.advance(milliseconds(30));
  EXPECT_EQ(next(*left), "0:20");
  EXPECT_EQ(next(*right), "0:148");
}

TEST_F(Replay, AtRealPacePatternsTakeTheirTime) {
  play({}, ReplayOptions::Pace::real);
  ASSERT_TRUE(projector->show(0));
  std::atomic<bool> shown = false;
  std::jthread shower([&] {
    EXPECT_TRUE(projector->show(1));
    shown = true;
  });
  clock.advance(milliseconds(39));
  std::this_thread::sleep_for(std::chrono::milliseconds(30));
  EXPECT_FALSE(shown);
  clock.advance(milliseconds(1));
  shower.join();
  EXPECT_TRUE(shown);
}

TEST_F(Replay, AMissingFrameLeavesAGap) {
  play({{.kind = ReplayFault::Kind::missing, .camera = "left", .role = ShotRole::background, .index = 1}});
  arm(ShotRole::background, 3);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:10");
  EXPECT_EQ(next(*left), "2:12");
  EXPECT_EQ(next(*left), "timeout");
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:20") << "the fault is meant for another role";
}

TEST_F(Replay, AGapShowsInTheFrameIds) {
  play({{.kind = ReplayFault::Kind::missing, .index = 1}});
  arm(ShotRole::background, 3);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(trigger->fire());
  const auto first = left->wait_frame(clock.now());
  const auto second = left->wait_frame(clock.now());
  ASSERT_TRUE(first && second);
  EXPECT_EQ(second->frame_id, first->frame_id + 2);
}

TEST_F(Replay, ALateFrameArrivesLateAndHoldsUpTheNext) {
  play({{.kind = ReplayFault::Kind::late, .camera = "left", .index = 0, .delay_ms = 500}});
  arm(ShotRole::background, 2);
  ASSERT_TRUE(trigger->fire());
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*right), "0:138");
  EXPECT_EQ(next(*left, -1), "timeout");
  clock.advance(milliseconds(499));
  EXPECT_EQ(next(*left), "timeout");
  clock.advance(milliseconds(1));
  EXPECT_EQ(next(*left), "0:10");
  EXPECT_EQ(next(*left), "1:11");
}

TEST_F(Replay, ACorruptFrameIsDroppedAndTheCameraGoesOn) {
  play({{.kind = ReplayFault::Kind::corrupt, .index = 0}});
  arm(ShotRole::background, 2);
  ASSERT_TRUE(trigger->fire());
  ASSERT_TRUE(trigger->fire());
  const auto damaged = left->wait_frame(clock.now());
  ASSERT_FALSE(damaged);
  EXPECT_EQ(damaged.error().code, ErrorCode::invalid_file);
  EXPECT_THAT(damaged.error().message, HasSubstr("left: frame 0 arrived damaged"));
  EXPECT_EQ(next(*left), "1:11");
}

TEST_F(Replay, AFileThatVanishedIsADamagedFrame) {
  play();
  fs::remove(scratch_.path() / "played/frames/body/left.png");
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "invalid_file");
  EXPECT_EQ(next(*right), "0:148");
}

TEST_F(Replay, AFaultMayBeMeantForOneCapture) {
  play({{.kind = ReplayFault::Kind::missing, .camera = "left", .capture = 1}});
  for (const char* expected : {"0:20", "timeout", "0:20"}) {
    arm(ShotRole::body, 1);
    ASSERT_TRUE(trigger->fire());
    EXPECT_EQ(next(*left), expected);
  }
}

TEST_F(Replay, ALostCameraComesBackWhenItsTimeIsOver) {
  play({{.kind = ReplayFault::Kind::lost, .camera = "left", .capture = 0, .delay_ms = 3000}});
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "device_lost");
  EXPECT_EQ(next(*right), "0:148");
  EXPECT_EQ(source->discover()->size(), 1U);
  EXPECT_EQ(left->arm({.role = ShotRole::body}, 1).error().code, ErrorCode::device_lost);
  left.reset();
  EXPECT_EQ(source->open_camera("left").error().code, ErrorCode::device_lost);
  clock.advance(seconds(3));
  left = *source->open_camera("left");
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:20");
}

TEST_F(Replay, TriggerAndProjectorCanBeLost) {
  play();
  source->unplug("trigger");
  source->unplug("projector");
  EXPECT_EQ(trigger->fire().error().code, ErrorCode::device_lost);
  EXPECT_EQ(projector->show(0).error().code, ErrorCode::device_lost);
  trigger.reset(), projector.reset();
  EXPECT_EQ(source->open_trigger().error().code, ErrorCode::device_lost);
  source->plug_in("trigger");
  source->plug_in("projector");
  EXPECT_TRUE((*source->open_trigger())->fire());
  EXPECT_TRUE((*source->open_projector())->show(0));
}

TEST_F(Replay, DevicesOutliveTheirSource) {
  play();
  source.reset();
  arm(ShotRole::body, 1);
  ASSERT_TRUE(trigger->fire());
  EXPECT_EQ(next(*left), "0:20");
}

TEST_F(Replay, ARecordingThatIsReplayedAndRecordedKeepsItsPictures) {
  play();
  auto writer =
      RecordingWriter::begin(scratch_.path(), {.id = "again", .created = "2026-11-22T10:15:00Z"}, *source->rig());
  ASSERT_TRUE(writer);
  ASSERT_TRUE((*writer)->begin_shot({.name = "face", .role = ShotRole::gray_code, .pattern = pattern}));
  arm(ShotRole::gray_code, pattern_count(pattern));
  for (int i = 0; i < pattern_count(pattern); ++i) {
    ASSERT_TRUE(projector->show(i));
    ASSERT_TRUE(trigger->fire());
    ASSERT_TRUE((*writer)->add("face", *left->wait_frame(clock.now())));
    ASSERT_TRUE((*writer)->add("face", *right->wait_frame(clock.now())));
  }
  ASSERT_TRUE((*writer)->commit());
  for (const char* file : {"frames/face/left-000.png", "frames/face/right-007.png"})
    EXPECT_EQ(*read_file(scratch_.path() / "again" / file, 1 << 20),
              *read_file(scratch_.path() / "played" / file, 1 << 20));
}

TEST_F(Replay, RefusesWhatTheRecordingDoesNotHave) {
  EXPECT_EQ(ReplaySource::open({.recording = scratch_.path() / "absent"}, clock).error().code, ErrorCode::not_found);
  const auto unknown =
      ReplaySource::open({.recording = scratch_.path() / "played", .faults = {{.camera = "middle"}}}, clock);
  EXPECT_EQ(unknown.error().code, ErrorCode::invalid_argument);
  EXPECT_THAT(unknown.error().message, HasSubstr("middle"));

  const auto mini = ReplaySource::open({.recording = BOOTH_SOURCE_DIR "/replay/recordings/mini"}, clock);
  ASSERT_TRUE(mini) << mini.error().message;
  EXPECT_EQ((*mini)->open_projector().error().code, ErrorCode::unsupported);
  const auto camera = (*mini)->open_camera("body-00");
  EXPECT_EQ((*camera)->arm({.role = ShotRole::gray_code}, 1).error().code, ErrorCode::unsupported);
}

/// Everything at once, for the sanitizers.
TEST_F(Replay, ManyThreadsAtOnce) {
  MonotonicClock real;
  auto opened = ReplaySource::open({.recording = BOOTH_SOURCE_DIR "/replay/recordings/mini",
                                    .pace = ReplayOptions::Pace::real,
                                    .faults = {{.kind = ReplayFault::Kind::missing, .camera = "body-02"},
                                               {.kind = ReplayFault::Kind::corrupt, .camera = "body-04", .index = 1}},
                                    .cache_mib = 2},
                                   real);
  ASSERT_TRUE(opened);
  const auto trigger_of_mini = *(*opened)->open_trigger();
  const std::vector<CameraInfo> cameras = *(*opened)->discover();
  constexpr int count = 3;
  std::atomic<int> frames = 0, damaged = 0, armed = 0;
  {
    std::vector<std::jthread> threads;
    for (const CameraInfo& info : cameras)
      threads.emplace_back([&, id = info.id] {
        const auto camera = *(*opened)->open_camera(id);
        ASSERT_TRUE(camera->arm({.role = ShotRole::background}, count));
        ++armed;
        for (int i = 0; i < count; ++i) {
          const auto frame = camera->wait_frame(real.now() + milliseconds(id == "body-02" ? 200 : 30000));
          if (frame) ++frames;
          if (!frame && frame.error().code == ErrorCode::invalid_file) ++damaged;
        }
      });
    while (armed < 8) std::this_thread::yield();
    for (int i = 0; i < count; ++i) EXPECT_TRUE(trigger_of_mini->fire());
    (*opened)->unplug("body-07");
    (*opened)->plug_in("body-07");
  }
  EXPECT_GE(frames, 6 * count - 1);
  EXPECT_EQ(damaged, 1);
}

}  // namespace
}  // namespace booth
