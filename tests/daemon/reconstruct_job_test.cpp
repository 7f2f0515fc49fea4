#include "daemon/reconstruct_job.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <functional>
#include <random>
#include <set>
#include <stop_token>
#include <thread>
#include <utility>

#include "daemon/face_model_loader.h"
#include "pipeline/export/metadata.h"
#include "pipeline/thread_pool.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

const fs::path mini = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";

/// Coarse, so that a hundred reconstructions take seconds.
ReconstructionOptions coarse() {
  ReconstructionOptions options;
  options.hull.voxel_m = 0.02;
  options.decimation.triangles = 1000;
  options.atlas.size = 256;
  return options;
}

std::string text_of(const fs::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}

class ReconstructJob : public testing::Test {
 protected:
  ReconstructJob() {
    fs::create_directories(folder_);
    fs::copy(mini, folder_ / "recording", fs::copy_options::recursive);
    fs::remove_all(folder_ / "recording/truth");
  }
  ~ReconstructJob() override { fs::remove_all(folder_); }

  Result<JobReport> run(const ReconstructionOptions& options = coarse(), const Work& extra = {},
                        const JobSources& sources = {}) {
    Work work = pool_.work();
    work.stop = extra.stop;
    RecordingSource recording(folder_ / "recording");
    return reconstruct_recording(
        recording, folder_ / "out/avatar", options, sources, {}, work,
        [this](std::string_view stage, double fraction) { news_.emplace_back(stage, fraction); });
  }
  /// A face scan of which every image is the empty booth's: nothing is projected.
  void add_unlit_face_scan() const {
    std::string frames;
    for (const char* camera : {"body-00", "body-01"})
      for (int index = 0; index < 14; ++index)
        frames += std::string(frames.empty() ? "" : ",") + R"({"camera":")" + camera + R"(","index":)" +
                  std::to_string(index) + R"(,"file":"frames/background/)" + camera +
                  R"(-000.jpg","timestamp_ns":1,"frame_id":1,"exposure_us":8000,"gain_db":0})";
    const fs::path file = folder_ / "recording/recording.json";
    std::string text = text_of(file);
    const std::string shots = "\"shots\": [";
    text.insert(text.find(shots) + shots.size(),
                R"({"name":"face","role":"gray_code","pattern":{"width":8,"height":8,"columns":true,"rows":true,)"
                R"("inverse":true},"frames":[)" +
                    frames + "]},");
    std::ofstream(file) << text;
  }
  bool nothing_is_left() const { return !fs::exists(folder_ / "out") || fs::is_empty(folder_ / "out"); }

  fs::path folder_ = fs::temp_directory_path() / ("reconstruct-job-" + std::to_string(getpid()));
  ThreadPool pool_;
  std::vector<std::pair<std::string, double>> news_;
};

TEST_F(ReconstructJob, PublishesACompleteAvatar) {
  const auto report = run();
  ASSERT_TRUE(report.ok()) << report.error().message;
  const fs::path avatar = folder_ / "out/avatar";
  for (const char* file : {"avatar.dae", "texture.png", "avatar.glb", "preview.png", "metadata.json"})
    EXPECT_TRUE(fs::is_regular_file(avatar / file)) << file;
  const auto metadata = read_metadata(text_of(avatar / "metadata.json"));
  ASSERT_TRUE(metadata.ok()) << metadata.error().message;
  EXPECT_EQ(metadata->id, "avatar");
  EXPECT_EQ(metadata->recording, "2026-11-22T09-55-00Z-cd7c");
  EXPECT_EQ(metadata->cameras.size(), 8U);
  EXPECT_EQ(metadata->joints, 23U);
  EXPECT_LE(metadata->triangles, 1000U);
  EXPECT_EQ(metadata->warnings, report->warnings);
  std::vector<std::string> stages;
  for (const auto& [stage, seconds] : report->stage_seconds) stages.push_back(stage);
  EXPECT_EQ(stages, job_stages());
}

TEST_F(ReconstructJob, MakesTheSameAvatarOfABackgroundThatWasLearnedBefore) {
  const fs::path avatar = folder_ / "out/avatar";
  ASSERT_TRUE(run());
  const std::string model = text_of(avatar / "avatar.glb");
  const EmptyViewStore store(folder_ / "cache");
  for (int time = 0; time < 2; ++time) {
    const auto report = run(coarse(), {}, {.kept = &store});
    ASSERT_TRUE(report.ok()) << report.error().message;
    EXPECT_EQ(text_of(avatar / "avatar.glb"), model);
  }
}

/// A recording that is still being written: its body is there, and the face comes later.
class GrowingRecording : public ReconstructJob {
 protected:
  GrowingRecording() {
    EXPECT_EQ(::pipe(news_pipe_.data()), 0);
    fs::copy(folder_ / "recording", part_, fs::copy_options::recursive);
  }
  ~GrowingRecording() override {
    hang_up();
    ::close(news_pipe_[0]);
  }
  void tell(const std::string& line) const {
    EXPECT_EQ(::write(news_pipe_[1], line.data(), line.size()), static_cast<ssize_t>(line.size()));
  }
  void show_part() const { tell(R"({"so_far": ")" + part_.string() + "\"}\n"); }
  void complete() const { tell("{\"complete\": true}\n"); }
  void hang_up() {
    if (news_pipe_[1] >= 0) ::close(std::exchange(news_pipe_[1], -1));
  }
  /// @param on_stage  called with each stage that is told
  Result<JobReport> follow(const std::function<void(std::string_view stage)>& on_stage = {},
                           const std::stop_token& stop = {}) {
    RecordingSource recording(folder_ / "recording", news_pipe_[0]);
    Work work = pool_.work();
    work.stop = stop;
    return reconstruct_recording(recording, folder_ / "out/avatar", coarse(), {}, {}, work,
                                 [&](std::string_view stage, double) {
                                   if (on_stage) on_stage(stage);
                                 });
  }

  const fs::path part_ = folder_ / "part";
  std::array<int, 2> news_pipe_{};
};

TEST_F(GrowingRecording, BecomesTheSameAvatarThoughItsBodyIsCarvedBeforeItIsComplete) {
  add_unlit_face_scan();
  const auto expected = run();
  ASSERT_TRUE(expected) << expected.error().message;
  const std::string model = text_of(folder_ / "out/avatar/avatar.glb");
  fs::remove_all(folder_ / "out");
  fs::rename(folder_ / "recording", folder_ / "later");

  show_part();
  bool carved = false;
  const auto report = follow([&](std::string_view stage) {
    if (stage != "face" || std::exchange(carved, true)) return;
    fs::rename(folder_ / "later", folder_ / "recording");
    complete();
  });
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_TRUE(carved);
  EXPECT_TRUE(text_of(folder_ / "out/avatar/avatar.glb") == model);
  EXPECT_EQ(report->warnings, expected->warnings);
}

TEST_F(GrowingRecording, IsReadAtItsPlaceWhenThePartMovedAway) {
  fs::remove_all(part_ / "frames");
  show_part();
  complete();
  const auto report = follow();
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_EQ(read_metadata(text_of(folder_ / "out/avatar/metadata.json"))->cameras.size(), 8U);
  EXPECT_EQ(report->warnings, run()->warnings);
}

TEST_F(GrowingRecording, WaitsWhileThePartHasNoBody) {
  tell("nonsense\n{\"so_far\": 7}\n{\"so_far\": \"/nowhere\"}\n");
  std::jthread later([this] {
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
    complete();
  });
  EXPECT_TRUE(follow());
}

TEST_F(GrowingRecording, ThatNeverBecomesCompleteLeavesNothing) {
  for (const bool with_body : {true, false}) {
    if (with_body) show_part();
    hang_up();
    const auto report = follow();
    ASSERT_FALSE(report);
    EXPECT_EQ(report.error().code, ErrorCode::invalid_state);
    EXPECT_NE(report.error().message.find("was not completed"), std::string::npos);
    EXPECT_TRUE(nothing_is_left());
  }
}

TEST_F(GrowingRecording, CanBeGivenUpWhileItIsWaitedFor) {
  show_part();
  std::stop_source stop;
  const auto report = follow(
      [&](std::string_view stage) {
        if (stage == "face") stop.request_stop();
      },
      stop.get_token());
  ASSERT_FALSE(report);
  EXPECT_EQ(report.error().code, ErrorCode::cancelled);
  EXPECT_TRUE(nothing_is_left());
}

TEST_F(ReconstructJob, MakesTheAvatarWithoutAFaceScanThatIsTooPoor) {
  add_unlit_face_scan();
  const auto report = run();
  ASSERT_TRUE(report.ok()) << report.error().message;
  EXPECT_TRUE(fs::is_regular_file(folder_ / "out/avatar/avatar.glb"));
  EXPECT_TRUE(std::any_of(report->warnings.begin(), report->warnings.end(), [](const std::string& warning) {
    return warning.find("hardly any pixel is lit") != std::string::npos;
  }));
}

TEST_F(ReconstructJob, NamesTheCascadeThatIsMissingOnceAndOnlyForAScan) {
  const fs::path missing = folder_ / "cascade.xml", none = folder_ / "recording/recording.json";
  size_t asked = 0;
  const auto warnings_about = [&](const fs::path& cascade) {
    const auto report = run(coarse(), {}, {{}, [&] {
                                             ++asked;
                                             return load_face_detector(cascade);
                                           }});
    EXPECT_TRUE(report.ok()) << report.error().message;
    return std::count_if(report->warnings.begin(), report->warnings.end(), [&](const std::string& warning) {
      return warning.find(cascade.string()) != std::string::npos;
    });
  };
  EXPECT_EQ(warnings_about(missing), 0);
  EXPECT_EQ(asked, 0U);
  add_unlit_face_scan();
  EXPECT_EQ(warnings_about(missing), 1);
  EXPECT_EQ(asked, 1U);
  EXPECT_NE(load_face_detector(none).error().message.find(none.string()), std::string::npos);
}

TEST_F(ReconstructJob, MakesTheAvatarWithoutAFaceFileThatIsUnusable) {
  const auto warned = [&](const std::string& of) {
    const auto report = run();
    EXPECT_TRUE(report.ok()) << report.error().message;
    return report && std::any_of(report->warnings.begin(), report->warnings.end(),
                                 [&](const std::string& warning) { return warning.find(of) != std::string::npos; });
  };
  std::ofstream(folder_ / "recording/face.ply") << "nonsense";
  EXPECT_TRUE(warned("face.ply: the first line"));
  std::ofstream(folder_ / "recording/face.ply") << "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n"
                                                   "property float y\nproperty float z\nend_header\n0 0 0\n";
  EXPECT_TRUE(warned("it has only 1 points"));
}

TEST_F(ReconstructJob, TellsProgressThatNeverFallsAndEndsAtOne) {
  ASSERT_TRUE(run().ok());
  ASSERT_FALSE(news_.empty());
  for (size_t i = 1; i < news_.size(); ++i) EXPECT_GE(news_[i].second, news_[i - 1].second) << news_[i].first;
  EXPECT_DOUBLE_EQ(news_.back().second, 1);
  std::set<std::string> stages;
  for (const auto& [stage, fraction] : news_) stages.insert(stage);
  EXPECT_EQ(stages, std::set<std::string>(job_stages().begin(), job_stages().end()));
}

TEST_F(ReconstructJob, GivesTheSameFilesAgain) {
  ASSERT_TRUE(run().ok());
  const std::string first = text_of(folder_ / "out/avatar/avatar.glb");
  fs::remove_all(folder_ / "out");
  ASSERT_TRUE(run().ok());
  EXPECT_TRUE(first == text_of(folder_ / "out/avatar/avatar.glb"));
}

TEST_F(ReconstructJob, CancelledLeavesNothing) {
  std::stop_source stop;
  stop.request_stop();
  const auto report = run(coarse(), {.stop = stop.get_token(), .progress = {}, .parallel = {}});
  ASSERT_FALSE(report.ok());
  EXPECT_EQ(report.error().code, ErrorCode::cancelled);
  EXPECT_TRUE(nothing_is_left());
}

TEST_F(ReconstructJob, RefusesAFolderThatHoldsSomethingElse) {
  fs::create_directories(folder_ / "out/avatar");
  std::ofstream(folder_ / "out/avatar/diary.txt") << "dear diary";
  const auto report = run();
  ASSERT_FALSE(report.ok());
  EXPECT_EQ(report.error().code, ErrorCode::invalid_state);
  EXPECT_EQ(text_of(folder_ / "out/avatar/diary.txt"), "dear diary");
}

TEST_F(ReconstructJob, ReplacesAnEarlierAvatar) {
  ASSERT_TRUE(run().ok());
  fs::remove(folder_ / "out/avatar/preview.png");
  const auto again = run();
  ASSERT_TRUE(again.ok()) << again.error().message;
  EXPECT_TRUE(fs::exists(folder_ / "out/avatar/preview.png"));
}

TEST_F(ReconstructJob, SaysWhichShotIsMissing) {
  for (const auto& [role, code] :
       {std::pair{"\"body\",", ErrorCode::no_subject}, std::pair{"\"background\",", ErrorCode::no_background}}) {
    std::string text = text_of(mini / "recording.json");
    const std::string key = std::string("\"role\": ") + role;
    const size_t at = text.find(key);
    ASSERT_NE(at, std::string::npos);
    text.replace(at, key.size(), "\"role\": \"portrait\",");
    std::ofstream(folder_ / "recording/recording.json") << text;
    const auto report = run();
    ASSERT_FALSE(report.ok());
    EXPECT_EQ(report.error().code, code) << report.error().message;
    EXPECT_TRUE(nothing_is_left());
  }
}

/// What befalls a file.
struct Damage {
  const char* name;
  void (*inflict)(const fs::path& file);
};

void rewrite(const fs::path& file, const std::string& bytes) { std::ofstream(file, std::ios::binary) << bytes; }

void erase(const fs::path& file) { fs::remove(file); }

void truncate(const fs::path& file) { rewrite(file, text_of(file).substr(0, fs::file_size(file) / 2)); }

void scramble(const fs::path& file) {
  std::string bytes = text_of(file);
  std::mt19937 random(5);
  for (size_t i = 0; i < bytes.size(); i += 1 + random() % 64) bytes[i] = static_cast<char>(random());
  rewrite(file, bytes);
}

class DamagedRecording : public ReconstructJob, public testing::WithParamInterface<Damage> {};

TEST_P(DamagedRecording, GivesOneClearErrorOrAnAvatarWithAWarningWhicheverFileItIs) {
  std::vector<fs::path> files;
  for (const auto& entry : fs::recursive_directory_iterator(folder_ / "recording"))
    if (entry.is_regular_file()) files.push_back(entry.path());
  ASSERT_EQ(files.size(), 18U);
  std::sort(files.begin(), files.end());

  for (const fs::path& file : files) {
    SCOPED_TRACE(file);
    const std::string original = text_of(file);
    GetParam().inflict(file);
    const auto report = run();
    const auto names_the_file = [&](const std::string& sentence) {
      return sentence.find(file.filename().string()) != std::string::npos;
    };
    if (report) {
      EXPECT_TRUE(std::any_of(report->warnings.begin(), report->warnings.end(), names_the_file));
      EXPECT_TRUE(fs::exists(folder_ / "out/avatar/avatar.dae"));
    } else {
      EXPECT_TRUE(names_the_file(report.error().message)) << report.error().message;
      EXPECT_EQ(report.error().message.find('\n'), std::string::npos) << report.error().message;
      EXPECT_TRUE(nothing_is_left());
    }
    fs::remove_all(folder_ / "out");
    rewrite(file, original);
  }
}

INSTANTIATE_TEST_SUITE_P(EveryFile, DamagedRecording,
                         testing::Values(Damage{"deleted", erase}, Damage{"truncated", truncate},
                                         Damage{"scrambled", scramble}),
                         [](const auto& damage) { return damage.param.name; });

}  // namespace
}  // namespace booth
