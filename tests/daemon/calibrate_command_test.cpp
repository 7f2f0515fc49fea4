// `boothctl calibrate`: the guide, its steps for scripts, and calibration from recordings.

#include <gmock/gmock.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <random>

#include "tests/daemon/board_recordings.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::AnyOf;
using testing::HasSubstr;
using testing::IsSupersetOf;
using testing::Not;

std::string text_of(const fs::path& file) {
  std::ifstream stream(file);
  return {std::istreambuf_iterator<char>(stream), {}};
}

class CalibrateCommand : public TestBooth {
 protected:
  struct Outcome {
    int status;
    std::string output;
  };
  void SetUp() override {
    TestBooth::SetUp();
    options_.calibrate_command = BOOTH_CALIBRATE;
    options_.config.replay.recording = BoardRecordings::get().good();
  }
  /// Runs boothctl, with `input` typed to it.
  Outcome boothctl(const std::string& arguments, const std::string& input = "", double timeout_s = 60) {
    const fs::path typed = folder_.path() / "typed", said = folder_.path() / "said";
    std::ofstream(typed) << input;
    const std::string command = std::string(BOOTHCTL) + " --timeout " + std::to_string(timeout_s) + " --control " +
                                options_.config.api.control + " --events " + options_.config.api.events + " " +
                                arguments + " < " + typed.string() + " > " + said.string() + " 2>&1";
    const int status = std::system(command.c_str());
    return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, text_of(said)};
  }
  Json json(const std::string& arguments) {
    const Outcome outcome = boothctl("--json " + arguments);
    EXPECT_EQ(outcome.status, 0) << outcome.output;
    return Json::parse(outcome.output, nullptr, false);
  }
};

TEST_F(CalibrateCommand, LeadsFromTheFirstShotToTheRigInForce) {
  start();
  std::string shots;
  for (int i = 0; i < tilted; ++i) shots += "\n";
  // Somebody leaves in between, and has typed nonsense.
  const Outcome first = boothctl("calibrate", shots + "what\nq\n");
  EXPECT_EQ(first.status, 0);
  EXPECT_THAT(first.output, HasSubstr("Hold the printed board"));
  EXPECT_THAT(first.output, HasSubstr("shot 1\n"));
  EXPECT_THAT(first.output, HasSubstr("b0             "));
  EXPECT_THAT(first.output, HasSubstr("Next: b0 shares 1 shot"));
  EXPECT_THAT(first.output, HasSubstr("What is w?"));
  EXPECT_THAT(first.output, HasSubstr("goes on with them"));

  const Outcome second = boothctl("calibrate", "f\ns\nn\ns\ny\n");
  EXPECT_EQ(second.status, 0) << second.output;
  EXPECT_THAT(second.output, HasSubstr("A calibration is under way"));
  EXPECT_THAT(second.output, HasSubstr("shot 7\n"));
  EXPECT_THAT(second.output, HasSubstr("Report: "));
  EXPECT_THAT(second.output, HasSubstr("Nothing is changed."));
  EXPECT_THAT(second.output, HasSubstr("The booth is calibrated."));
  EXPECT_LT(call("system.status")["calibration"]["rms_px"], 0.25);
}

TEST_F(CalibrateCommand, HasEveryStepForScripts) {
  start();
  EXPECT_EQ(boothctl("calibrate apply").status, 1);
  EXPECT_THAT(boothctl("calibrate apply").output, HasSubstr("invalid_state"));
  EXPECT_EQ(boothctl("--json calibrate").status, 2) << "the guide asks people";
  EXPECT_THAT(boothctl("calibrate status").output, HasSubstr("No calibration is under way."));
  for (int i = 0; i < tilted; ++i) EXPECT_EQ(json("calibrate capture")["shots"], i + 1);
  EXPECT_EQ(json("calibrate capture --on-floor")["floor"], true);
  EXPECT_THAT(json("calibrate solve --drop-unseen")["verdict"].get<std::string>(), AnyOf("good", "usable"));
  EXPECT_EQ(json("calibrate status")["look"]["shots"], tilted + 1);
  json("calibrate apply");
  EXPECT_LT(call("system.status")["calibration"]["rms_px"], 0.25);
  json("calibrate restore");
  EXPECT_EQ(call("system.status")["calibration"]["rms_px"], 0.3);
  EXPECT_THAT(boothctl("calibrate status").output, HasSubstr("Earlier ones:\nrig-"));
  json("calibrate capture");
  json("calibrate discard");
  EXPECT_TRUE(json("calibrate status")["look"].is_null());
}

TEST_F(CalibrateCommand, SaysWhenThereIsNoBooth) {
  EXPECT_EQ(boothctl("calibrate capture", "", 0.2).status, 3);
  EXPECT_EQ(boothctl("calibrate", "", 0.2).status, 3);
}

TEST_F(CalibrateCommand, SolvesRecordings) {
  const std::string recording = BoardRecordings::get().good().string(), out = (folder_.path() / "solved").string();
  const Outcome solved =
      boothctl("calibrate --recording " + recording + " --floor " + std::to_string(tilted) + " --out " + out);
  ASSERT_EQ(solved.status, 0) << solved.output;
  EXPECT_THAT(solved.output, HasSubstr("b3           0."));
  EXPECT_THAT(solved.output, AnyOf(HasSubstr("good: "), HasSubstr("usable: ")));
  EXPECT_THAT(text_of(fs::path(out) / "report.html"), HasSubstr("b3"));
  EXPECT_EQ(Json::parse(text_of(fs::path(out) / "calibration.json"))["devices"].size(), 4U);
  const auto rig = read_rig(fs::path(out) / "rig.json");
  ASSERT_TRUE(rig) << rig.error().message;
  for (const RigCamera& truth : synthetic::arc_rig().cameras)
    EXPECT_LT((rig->find(truth.id)->center() - truth.center()).norm(), 0.01) << truth.id;

  EXPECT_EQ(boothctl("calibrate --recording " + recording + " --out " + out).status, 1) << "something is there";
  EXPECT_EQ(boothctl("calibrate --recording /nowhere --out " + out + "2").status, 1);
  EXPECT_EQ(boothctl("calibrate --recording " + recording).status, 2);
  EXPECT_EQ(boothctl("calibrate --out " + out).status, 2);
  const Outcome coplanar =
      boothctl("calibrate --recording " + BoardRecordings::get().coplanar().string() + " --out " + out + "3");
  EXPECT_EQ(coplanar.status, 1);
  EXPECT_THAT(coplanar.output, HasSubstr("same plane"));
  EXPECT_FALSE(fs::exists(out + "3"));
}

TEST_F(CalibrateCommand, ARigIsWholeWheneverTheBoothIsKilled) {
  const fs::path folder = options_.config.booth.rig().parent_path();
  fs::create_directories(folder);
  Rig rig = synthetic::arc_rig();
  const std::string one = write_rig_json(rig);
  for (RigCamera& camera : rig.cameras) camera.rms_px = 0.1;
  const std::string other = write_rig_json(rig);
  std::ofstream(folder / "rig.json") << one;
  std::ofstream(folder / "rig-2026-11-22T10-15-00.000Z-0000.json") << other;
  const fs::path config = folder_.path() / "boothd.toml";
  std::ofstream(config) << write_config(options_.config);
  std::mt19937 random(5);
  constexpr int rounds = 8;
  for (int round = 0; round < rounds; ++round) {
    const pid_t boothd = ::fork();
    if (boothd == 0) {
      if (::freopen("/dev/null", "w", stdout) != nullptr && ::freopen("/dev/null", "w", stderr) != nullptr)
        ::execl(BOOTHD, BOOTHD, "--config", config.c_str(), "--reconstruct", reconstruct_.path().c_str(), nullptr);
      ::_exit(127);
    }
    client_ = std::make_unique<RawClient>(options_.config.api.control);
    EXPECT_EQ(call("system.status")["calibration"]["loaded"], true);
    client().send({Json{{"jsonrpc", "2.0"}, {"id", 1}, {"method", "calibration.restore"}}.dump()});
    std::this_thread::sleep_for(std::chrono::microseconds(random() % 20'000));
    ::kill(boothd, SIGKILL);
    ::waitpid(boothd, nullptr, 0);
    EXPECT_THAT(text_of(folder / "rig.json"), AnyOf(one, other)) << "after round " << round;
    std::vector<std::string> kept;
    for (const std::string& name : entries(folder))
      if (name.ends_with(".json")) kept.push_back(text_of(folder / name));
    EXPECT_THAT(kept, IsSupersetOf({one, other})) << "after round " << round;
  }
}

}  // namespace
}  // namespace booth::test
