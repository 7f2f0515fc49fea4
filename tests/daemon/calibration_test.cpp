// A calibration through the booth's interface, from shots of a rendered board whose rig is known.

#include <gmock/gmock.h>

#include <algorithm>
#include <numbers>

#include "pipeline/calibration/world_frame.h"
#include "pipeline/image/codec.h"
#include "replay/durable_folder.h"
#include "tests/daemon/board_recordings.h"
#include "tests/daemon/test_booth.h"

namespace booth::test {
namespace {

using testing::Contains;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;
using testing::SizeIs;

class CalibrationMethods : public TestBooth {
 protected:
  void SetUp() override {
    TestBooth::SetUp();
    options_.calibrate_command = BOOTH_CALIBRATE;
  }
  void play(const fs::path& recording) {
    options_.config.replay.recording = recording;
    start();
    listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
  }
  void restart() {
    stop();
    start();
    listener_ = std::make_unique<Listener>(options_.config.api.events, booth_.get());
  }
  Json end_of(const std::string& task) {
    const auto end = listener_->find([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["task"] == task && event.fields["state"] != "running";
    });
    return end ? end->fields : Json();
  }
  Json take(const Json& params = Json::object()) { return end_of(call("calibration.capture", params)["task"]); }
  void take_shots(int count) {
    for (int i = 0; i < count; ++i) ASSERT_EQ(take()["state"], "done");
  }
  Json solve(const Json& params = Json::object()) { return end_of(call("calibration.solve", params)["task"]); }
  Json calibration() { return call("system.status")["calibration"]; }
  fs::path folder() const { return options_.config.booth.rig().parent_path(); }
  std::vector<std::string> kept() {
    std::vector<std::string> names;
    for (const std::string& name : entries(folder()))
      if (name.starts_with("rig-")) names.push_back(name);
    return names;
  }

  std::unique_ptr<Listener> listener_;
};

double degrees(double radians) { return radians * 180 / std::numbers::pi; }

TEST_F(CalibrationMethods, FromShotsToARigInForce) {
  play(BoardRecordings::get().good());
  EXPECT_TRUE(calibration()["session"].is_null());
  const std::string task = call("calibration.capture")["task"];
  const auto entered = listener_->find(
      [](const SeenEvent& event) { return event.topic == "state" && event.fields["state"] == "calibrating"; });
  ASSERT_TRUE(entered);
  const Json first = end_of(task);
  ASSERT_EQ(first["state"], "done") << first;
  EXPECT_EQ(first["kind"], "calibration_capture");
  const Json& shot = first["result"];
  ASSERT_THAT(shot["cameras"], SizeIs(4));
  for (const Json& camera : shot["cameras"]) {
    EXPECT_GE(camera["corners"], 12) << camera;
    EXPECT_FALSE(camera["blurred"]);
    EXPECT_EQ(camera["views"], 1);
    EXPECT_THAT(camera["wants"].get<std::string>(), HasSubstr("shares 1 shot"));
    const auto picture = read_file(camera["picture"].get<std::string>(), 1 << 20);
    ASSERT_TRUE(picture) << picture.error().message;
    EXPECT_TRUE(decode_image(*picture));
  }
  EXPECT_EQ(shot["enough"], false);
  EXPECT_FALSE(shot["wants"].is_null());
  EXPECT_THAT(shot["missing"], IsEmpty());
  EXPECT_EQ(shot["shots"], 1);
  take_shots(tilted - 1);
  const Json last = take({{"floor", true}});
  ASSERT_EQ(last["state"], "done") << last;
  EXPECT_EQ(last["result"]["floor"], true);
  EXPECT_EQ(calibration()["session"]["shots"], tilted + 1);
  ASSERT_TRUE(wait_until([&] { return call("system.status")["state"] == "idle"; }));

  EXPECT_EQ(refusal("calibration.apply"), "invalid_state");
  const Json solved = solve();
  ASSERT_EQ(solved["state"], "done") << solved;
  EXPECT_EQ(solved["kind"], "calibration_solve");
  const Json& result = solved["result"];
  EXPECT_THAT(result["verdict"].get<std::string>(), testing::AnyOf("good", "usable")) << result;
  EXPECT_FALSE(result["reason"].get<std::string>().empty());
  ASSERT_THAT(result["cameras"], SizeIs(4));
  for (const Json& camera : result["cameras"]) {
    EXPECT_EQ(camera["solved"], true);
    EXPECT_GT(camera["rms_px"], 0);
    EXPECT_LT(camera["rms_px"], 0.25);
    EXPECT_GT(camera["center_sigma_m"], 0);
    EXPECT_GT(camera["covered"], 0);
  }
  EXPECT_TRUE(fs::exists(result["report"].get<std::string>()));
  EXPECT_EQ(calibration()["rms_px"], 0.3) << "nothing is applied yet";
  EXPECT_FALSE(fs::exists(folder() / "rig.json"));

  EXPECT_EQ(call("calibration.apply", {{"key", "once"}}), Json::object());
  EXPECT_EQ(call("calibration.apply", {{"key", "once"}}), Json::object()) << "the same request again";
  EXPECT_EQ(refusal("calibration.apply"), "invalid_state");
  EXPECT_TRUE(calibration()["loaded"]);
  EXPECT_LT(calibration()["rms_px"], 0.25);
  EXPECT_TRUE(calibration()["session"].is_null());
  EXPECT_THAT(kept(), SizeIs(1)) << "the one before";

  // The board on the floor says where the world is.
  const auto rig = read_rig(folder() / "rig.json");
  ASSERT_TRUE(rig) << rig.error().message;
  for (const RigCamera& truth : synthetic::arc_rig().cameras) {
    const RigCamera* camera = rig->find(truth.id);
    ASSERT_NE(camera, nullptr) << truth.id;
    EXPECT_LT((camera->center() - truth.center()).norm(), 0.01) << truth.id;
    const Eigen::AngleAxisd turn(camera->camera_from_world.linear() * truth.camera_from_world.linear().transpose());
    EXPECT_LT(degrees(turn.angle()), 0.3) << truth.id;
    EXPECT_NEAR(camera->intrinsics.fx / truth.intrinsics.fx, 1, 0.005) << truth.id;
  }
  // Captures take it, and so does the next start.
  const std::string id = capture({{"face", "none"}});
  ASSERT_TRUE(wait_job(id, "done"));
  const auto recorded = read_recording(options_.config.booth.recordings() / id);
  ASSERT_TRUE(recorded);
  EXPECT_EQ(write_rig_json(recorded->rig), write_rig_json(*rig));
  const Json before = calibration();
  restart();
  EXPECT_EQ(calibration()["rms_px"], before["rms_px"]);
  EXPECT_EQ(calibration()["created"], before["created"]);
}

TEST_F(CalibrationMethods, AnEarlierRigComesBackAndNoneIsLost) {
  play(BoardRecordings::get().good());
  EXPECT_EQ(refusal("calibration.restore"), "not_found");
  take_shots(tilted);
  ASSERT_EQ(solve()["state"], "done");
  call("calibration.apply");
  const double solved = calibration()["rms_px"];
  EXPECT_EQ(refusal("calibration.restore", {{"name", "rig-none.json"}}), "not_found");
  EXPECT_EQ(refusal("calibration.restore", {{"name", "../rig.json"}}), "not_found");
  call("calibration.restore");
  EXPECT_EQ(calibration()["rms_px"], 0.3);
  EXPECT_EQ(calibration()["created"], "2026-11-22T10:15:00Z") << "when it came into force";
  restart();
  EXPECT_EQ(calibration()["rms_px"], 0.3);
  const Json replaced = call("calibration.status")["replaced"];
  ASSERT_THAT(replaced, SizeIs(1));
  call("calibration.restore", {{"name", replaced[0]["name"]}});
  EXPECT_EQ(calibration()["rms_px"], solved);
  EXPECT_THAT(kept(), SizeIs(1));
}

TEST_F(CalibrationMethods, GoOnAfterARestart) {
  play(BoardRecordings::get().good());
  take_shots(tilted);
  restart();
  EXPECT_EQ(calibration()["session"]["shots"], tilted);
  const Json status = call("calibration.status");
  EXPECT_THAT(status["look"]["cameras"], SizeIs(4));
  EXPECT_TRUE(status["solution"].is_null());
  const Json solved = solve();
  ASSERT_EQ(solved["state"], "done") << solved;
  restart();
  EXPECT_EQ(calibration()["session"]["verdict"], solved["result"]["verdict"]);
  EXPECT_EQ(call("calibration.status")["solution"], solved["result"]);
  call("calibration.apply");
  EXPECT_LT(calibration()["rms_px"], 0.25);
}

TEST_F(CalibrationMethods, AreRefusedAtTheWrongMoment) {
  play(BoardRecordings::get().good());
  EXPECT_EQ(refusal("calibration.solve"), "invalid_state") << "no shots";
  EXPECT_EQ(refusal("calibration.apply"), "invalid_state");
  EXPECT_EQ(call("calibration.discard"), Json::object()) << "there is nothing to discard";
  EXPECT_EQ(refusal("calibration.capture", {{"floor", "yes"}}), "invalid_params");
  EXPECT_EQ(refusal("calibration.capture", {{"color", true}}), "invalid_params");
  EXPECT_EQ(refusal("calibration.apply", {{"force", 1}}), "invalid_params");
  EXPECT_EQ(refusal("calibration.capture", {{"patterns", true}}), "unsupported") << "there is no projector";
  const std::string task = call("calibration.capture", {{"key", "shot"}})["task"];
  EXPECT_EQ(refusal("calibration.capture"), "busy");
  EXPECT_EQ(refusal("capture.start"), "busy");
  EXPECT_EQ(call("calibration.capture", {{"key", "shot"}})["task"], task);
  ASSERT_EQ(end_of(task)["state"], "done");
  take_shots(2);
  const std::string solving = call("calibration.solve")["task"];
  EXPECT_EQ(refusal("calibration.capture"), "busy");
  EXPECT_EQ(refusal("calibration.solve"), "busy");
  EXPECT_EQ(refusal("calibration.apply"), "busy");
  // What is being solved is discarded with its shots.
  call("calibration.discard");
  const Json end = end_of(solving);
  EXPECT_THAT(end["state"], testing::AnyOf("failed", "done"));
  EXPECT_TRUE(calibration()["session"].is_null());
  EXPECT_EQ(refusal("calibration.apply"), "invalid_state");
  EXPECT_EQ(calibration()["rms_px"], 0.3);
  EXPECT_THAT(entries(folder()), Not(Contains("session")));
}

TEST_F(CalibrationMethods, DiscardMayKeepTheShots) {
  play(BoardRecordings::get().good());
  take_shots(tilted);
  ASSERT_EQ(solve()["state"], "done");
  call("calibration.discard", {{"shots", false}});
  EXPECT_EQ(refusal("calibration.apply"), "invalid_state");
  EXPECT_EQ(calibration()["session"]["shots"], tilted);
}

TEST_F(CalibrationMethods, OfOnePlaceSaySo) {
  play(BoardRecordings::get().good());
  take_shots(1);
  const Json end = solve();
  EXPECT_EQ(end["state"], "failed");
  EXPECT_EQ(end["error"]["kind"], "too_few_views");
  EXPECT_THAT(end["error"]["message"].get<std::string>(), HasSubstr("one place only"));
}

TEST_F(CalibrationMethods, OfBoardsInOnePlaneSaySo) {
  play(BoardRecordings::get().coplanar());
  take_shots(4);
  const Json end = solve();
  EXPECT_EQ(end["state"], "failed");
  EXPECT_THAT(end["error"]["message"].get<std::string>(), HasSubstr("same plane"));
}

TEST_F(CalibrationMethods, NameACameraThatNeverSawTheBoard) {
  play(BoardRecordings::get().blind());
  take_shots(tilted);
  const Json kept_camera = solve();
  ASSERT_EQ(kept_camera["state"], "done") << kept_camera;
  EXPECT_EQ(kept_camera["result"]["verdict"], "usable");
  EXPECT_THAT(kept_camera["result"]["reason"].get<std::string>(), HasSubstr("keep their previous calibration: b3"));
  const Json strict = solve({{"keep_unseen", false}});
  ASSERT_EQ(strict["state"], "done") << strict;
  EXPECT_EQ(strict["result"]["verdict"], "bad");
  EXPECT_THAT(strict["result"]["reason"].get<std::string>(), HasSubstr("b3: never saw the board"));
  EXPECT_EQ(refusal("calibration.apply"), "invalid_state") << "a bad one";
  EXPECT_FALSE(fs::exists(folder() / "rig.json"));
  call("calibration.apply", {{"force", true}});
  EXPECT_EQ(read_rig(folder() / "rig.json")->cameras.size(), 3U);
  const Json status = call("system.status");
  EXPECT_EQ(status["ready"], false);
  EXPECT_THAT(status["not_ready"][0]["message"].get<std::string>(), HasSubstr("does not know b3"));
}

TEST_F(CalibrationMethods, CompareTheSquaresWithTheRigBefore) {
  play(BoardRecordings::get().enlarged());
  take_shots(tilted);
  const Json end = solve();
  ASSERT_EQ(end["state"], "done") << end;
  EXPECT_EQ(end["result"]["verdict"], "bad");
  EXPECT_THAT(end["result"]["reason"].get<std::string>(), HasSubstr("measure the board's squares"));
}

TEST_F(CalibrationMethods, SayThatTheBoardWasBlurred) {
  play(BoardRecordings::get().blurred());
  const Json shot = take()["result"];
  EXPECT_TRUE(std::any_of(shot["cameras"].begin(), shot["cameras"].end(), [](const Json& camera) {
    return camera["blurred"] == true;
  })) << shot;
  take_shots(2);
  const Json end = solve();
  EXPECT_EQ(end["state"], "failed");
  EXPECT_THAT(end["error"]["message"].get<std::string>(), HasSubstr("blur"));
}

TEST_F(CalibrationMethods, SurviveTheDeathOfTheirProcess) {
  const fs::path dies = folder_.path() / "dies";
  std::ofstream(dies) << "#!/bin/sh\nkill -SEGV $$\n";
  fs::permissions(dies, fs::perms::owner_all);
  options_.calibrate_command = dies;
  play(BoardRecordings::get().good());
  const Json shot = take();
  EXPECT_EQ(shot["state"], "failed");
  EXPECT_EQ(shot["error"]["kind"], "internal");
  EXPECT_THAT(shot["error"]["message"].get<std::string>(), HasSubstr("signal 11"));
  EXPECT_TRUE(calibration()["session"].is_null()) << "the shot is not kept";
  EXPECT_EQ(call("system.status")["ready"], true);
}

}  // namespace
}  // namespace booth::test
