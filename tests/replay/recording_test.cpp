#include "replay/recording.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>

#include "pipeline/thread_pool.h"
#include "replay/durable_folder.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using testing::StartsWith;

const fs::path mini = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";

std::string text_of(const fs::path& file) {
  const auto bytes = read_file(file, 1 << 20);
  return bytes ? std::string(bytes->begin(), bytes->end()) : std::string();
}

/// A copy of the mini recording whose files a test may change.
class ChangedRecording : public testing::Test {
 protected:
  ChangedRecording() : folder(scratch_.path() / "copy") {
    fs::copy(mini, folder, fs::copy_options::recursive);
    fs::remove_all(folder / "truth");
  }
  void write(const std::string& file, const std::string& text) const {
    fs::remove(folder / file);  // file systems flush a file that is cut to nothing, and not one that is new
    std::ofstream(folder / file, std::ios::binary) << text;
  }
  /// Replaces the first occurrence of `from`, which must be there.
  void replace(const std::string& file, const std::string& from, const std::string& to) const {
    std::string text = text_of(folder / file);
    const size_t at = text.find(from);
    ASSERT_NE(at, std::string::npos) << from;
    write(file, text.replace(at, from.size(), to));
  }
  std::string refusal() const {
    const auto recording = read_recording(folder);
    return recording ? "nothing" : recording.error().message;
  }

  ScratchFolder scratch_;
  const fs::path folder;
};

TEST(ReadRecording, KnowsWhatMiniHolds) {
  const auto recording = read_recording(mini);
  ASSERT_TRUE(recording) << recording.error().message;
  EXPECT_EQ(recording->id, "2026-11-22T09-55-00Z-cd7c");
  EXPECT_EQ(recording->created, "2026-11-22T09:55:00Z");
  EXPECT_EQ(recording->label, "");
  EXPECT_TRUE(check(recording->rig));
  EXPECT_EQ(recording->rig.name, "mini-booth");
  ASSERT_EQ(recording->rig.cameras.size(), 8U);
  EXPECT_FALSE(recording->rig.projector);
  EXPECT_EQ(recording->rig.volume.min(), Eigen::Vector3d(-0.9, 0.0, -0.6));
  EXPECT_EQ(recording->rig.volume.max(), Eigen::Vector3d(0.9, 2.2, 0.6));
  const RigCamera& camera = recording->rig.cameras[0];
  EXPECT_EQ(camera.id, "body-00");
  EXPECT_EQ(camera.role, CameraRole::body);
  EXPECT_EQ(camera.intrinsics.width, 480);
  EXPECT_EQ(camera.intrinsics.height, 640);
  EXPECT_EQ(camera.intrinsics.fx, 558.4853082115245);
  EXPECT_EQ(camera.intrinsics.fy, 558.9418093673274);
  EXPECT_EQ(camera.intrinsics.cx, 243.98408117213168);
  EXPECT_EQ(camera.intrinsics.cy, 321.18805711137867);
  EXPECT_EQ(camera.intrinsics.distortion[3], 8.115297620344337e-05);
  EXPECT_EQ(camera.camera_from_world.linear()(1, 0), 0.004232184372001501);
  EXPECT_EQ(camera.camera_from_world.translation().z(), 2.146005511713181);
  EXPECT_EQ(camera.rms_px, 0.261);

  ASSERT_EQ(recording->shots.size(), 2U);
  EXPECT_EQ(recording->find(ShotRole::background), &recording->shots[0]);
  EXPECT_EQ(recording->find(ShotRole::body), &recording->shots[1]);
  EXPECT_EQ(recording->find(ShotRole::gray_code), nullptr);
  ASSERT_EQ(recording->shots[1].frames.size(), 8U);
  const FrameRecord& frame = recording->shots[1].frames[0];
  EXPECT_EQ(frame.camera, "body-00");
  EXPECT_EQ(frame.index, 0);
  EXPECT_EQ(frame.file, "frames/body/body-00.jpg");
  EXPECT_EQ(frame.timestamp_ns, 9014532926);
  EXPECT_EQ(frame.frame_id, 59U);
  EXPECT_EQ(frame.exposure_us, 8000);
}

TEST(ReadRecording, LargeRecordingsOfTheEnvironment) {
  const char* folder = std::getenv("BOOTH_RECORDINGS");
  if (folder == nullptr) GTEST_SKIP() << "BOOTH_RECORDINGS is not set";
  for (const char* name : {"man-casual", "woman-casual"}) {
    const auto recording = read_recording(fs::path(folder) / name);
    ASSERT_TRUE(recording) << recording.error().message;
    EXPECT_TRUE(recording->rig.projector);
    const Shot* patterns = recording->find(ShotRole::gray_code);
    ASSERT_NE(patterns, nullptr);
    EXPECT_EQ(pattern_count(*patterns->pattern), 42);
    EXPECT_EQ(patterns->frames.size(), 84U);
  }
}

TEST(LoadShot, GivesEveryFrameOfMini) {
  const auto recording = read_recording(mini);
  ASSERT_TRUE(recording);
  for (const Shot& shot : recording->shots) {
    const LoadedShot loaded = load_shot(*recording, shot);
    EXPECT_TRUE(loaded.faults.empty());
    ASSERT_EQ(loaded.sets.size(), 1U);
    EXPECT_EQ(loaded.sets[0].index, 0);
    ASSERT_EQ(loaded.sets[0].frames.size(), 8U);
    for (size_t i = 0; i < 8; ++i) {
      const Frame& frame = loaded.sets[0].frames[i];
      EXPECT_EQ(frame.camera, shot.frames[i].camera);
      EXPECT_EQ(frame.timestamp_ns, shot.frames[i].timestamp_ns);
      EXPECT_EQ(frame.pixels->width, 480);
      EXPECT_EQ(frame.pixels->height, 640);
      EXPECT_EQ(frame.pixels->channels, 3);
    }
  }
}

TEST(LoadShot, IsTheSameWithManyThreads) {
  const auto recording = read_recording(mini);
  ASSERT_TRUE(recording);
  ThreadPool pool(4);
  const LoadedShot one = load_shot(*recording, recording->shots[1]);
  const LoadedShot many = load_shot(*recording, recording->shots[1], pool.work());
  ASSERT_EQ(one.sets.size(), many.sets.size());
  for (size_t i = 0; i < one.sets[0].frames.size(); ++i) {
    EXPECT_EQ(one.sets[0].frames[i].camera, many.sets[0].frames[i].camera);
    EXPECT_EQ(one.sets[0].frames[i].pixels->samples, many.sets[0].frames[i].pixels->samples);
  }
}

TEST(LoadShot, StopsWhenAsked) {
  const auto recording = read_recording(mini);
  ASSERT_TRUE(recording);
  std::stop_source stop;
  stop.request_stop();
  Work work;
  work.stop = stop.get_token();
  EXPECT_TRUE(load_shot(*recording, recording->shots[1], work).sets.empty());
}

TEST(ReadRecording, NoFolderAndNoRecordingAreNotFound) {
  const ScratchFolder scratch;
  EXPECT_EQ(read_recording(scratch.path() / "absent").error().code, ErrorCode::not_found);
  EXPECT_EQ(read_recording(scratch.path()).error().code, ErrorCode::not_found);
  EXPECT_THAT(read_recording(scratch.path()).error().message, HasSubstr("recording.json"));
}

TEST_F(ChangedRecording, UnknownKeysAndRolesAreIgnored) {
  replace("recording.json", "\"created\"", "\"weather\": {\"sun\": [1, null]}, \"created\"");
  replace("recording.json", "\"shots\": [", R"("shots": [{"role": "hologram", "anything": 7},)");
  replace("rig.json", "\"cameras\": [", R"("lights": 3, "cameras": [{"id": "thermal", "role": "infrared"},)");
  replace("recording.json", "\"frames\": [", R"("frames": [{"camera": "thermal", "file": "frames/x.tif"},)");
  const auto recording = read_recording(folder);
  ASSERT_TRUE(recording) << recording.error().message;
  EXPECT_EQ(recording->shots.size(), 2U);
  EXPECT_EQ(recording->rig.cameras.size(), 8U);
  EXPECT_EQ(recording->shots[0].frames.size(), 8U);
}

TEST_F(ChangedRecording, WhatMayBeAbsentHasItsDefault) {
  write("recording.json", R"({"format": "booth-recording", "version": 1, "id": "a", "rig": "rig.json",
      "created": "2026-11-22T10:15:00Z", "label": "Grüße", "face": "active", "shots": [
      {"name": "body", "role": "body", "frames": [{"camera": "body-03", "file": "frames/body/body-03.jpg"}]},
      {"name": "face", "role": "gray_code", "pattern": {"width": 1024, "height": 768}, "frames": []}]})");
  const auto recording = read_recording(folder);
  ASSERT_TRUE(recording) << recording.error().message;
  EXPECT_EQ(recording->label, "Grüße");
  EXPECT_EQ(recording->face, "active");
  const FrameRecord& frame = recording->shots[0].frames[0];
  EXPECT_EQ(frame.index, 0);
  EXPECT_EQ(frame.frame_id, 0U);
  EXPECT_TRUE(recording->shots[1].pattern->columns && recording->shots[1].pattern->inverse);
}

TEST_F(ChangedRecording, SaysWhichFieldIsWrong) {
  struct Case {
    const char* file;
    const char* from;
    const char* to;
    const char* message;
  };
  const Case cases[] = {
      {"recording.json", "\"version\": 1", "\"version\": 2", "recording.json: version: 2, expected version 1"},
      {"recording.json", "booth-recording", "booth-rig", R"(recording.json: format: "booth-rig", expected)"},
      {"recording.json", "\"rig.json\"", "\"../rig.json\"", R"(recording.json: rig: "../rig.json", expected a path)"},
      {"recording.json", "\"rig.json\"", "\"/etc/passwd\"", R"(recording.json: rig: "/etc/passwd", expected a path)"},
      {"recording.json", "\"rig.json\"", "\"other.json\"", "recording.json: rig: other.json: is not there"},
      {"recording.json", "\"id\": \"2026", "\"id\": \"../2026", "recording.json: id: "},
      {"recording.json", "2026-11-22T09:55:00Z", "yesterday", "recording.json: created: \"yesterday\", expected"},
      {"recording.json", "\"created\"", "\"was created\"", "recording.json: created: is missing"},
      {"recording.json", "\"file\": \"frames/background/body-00-000.jpg\"", "\"file\": \"frames/../../secret\"",
       "recording.json: shots[0].frames[0].file: \"frames/../../secret\", expected a path inside the recording"},
      {"recording.json", "\"camera\": \"body-01\"", "\"camera\": \"body-77\"",
       "recording.json: shots[0].frames[1].camera: \"body-77\", expected a camera of the rig"},
      {"recording.json", "\"camera\": \"body-01\"", "\"camera\": \"body-00\"",
       "recording.json: shots[0].frames[1]: is the second frame of body-00 with index 0"},
      {"recording.json", "\"index\": 0", "\"index\": -1", "recording.json: shots[0].frames[0].index: -1, expected"},
      {"recording.json", "\"index\": 0", "\"index\": 0, \"mosaic\": {\"pattern\": \"rgb\"}",
       "recording.json: shots[0].frames[0].mosaic.pattern: \"rgb\", expected \"rggb\", \"grbg\""},
      {"recording.json", "\"index\": 0", "\"index\": 0.5", "recording.json: shots[0].frames[0].index: 0.5, expected"},
      {"recording.json", "7679821475", "1e300", "recording.json: shots[0].frames[0].timestamp_ns: 1e+300, expected"},
      {"recording.json", "\"name\": \"body\"", "\"name\": \"background\"", "recording.json: shots[1].name: "},
      {"recording.json", "\"shots\": [", "\"shots\": {}, \"x\": [", "recording.json: shots: an object, expected"},
      {"recording.json", "\"role\": \"body\"", "\"role\": \"gray_code\"", "recording.json: shots[1].pattern: is miss"},
      {"rig.json", "\"version\": 1", "\"version\": \"1\"", "rig.json: version: \"1\", expected"},
      {"rig.json", "\"K\": [", "\"K\": [[],", "rig.json: cameras[0].K: expected 3 rows of 3 numbers"},
      {"rig.json", "\"K\"", "\"k\"", "rig.json: cameras[0].K: is missing"},
      {"rig.json", "558.4853082115245", "-558.4", "rig.json: cameras[0].K: expected positive focal lengths"},
      {"rig.json", "558.4853082115245", "1e400", "rig.json: line "},
      {"rig.json", "558.4853082115245", "NaN", "rig.json: line "},
      {"rig.json", "\"width\": 480", "\"width\": -480", "rig.json: cameras[0].width: -480, expected an integer"},
      {"rig.json", "\"width\": 480", "\"width\": 100000", "rig.json: cameras[0].width: 100000, expected"},
      {"rig.json", "\"mount_rotation_deg\": 0", "\"mount_rotation_deg\": 45",
       "rig.json: cameras[0].mount_rotation_deg"},
      {"rig.json", "\"mount_rotation_deg\": 0", "\"colour_gain\": [1, 20, 1], \"mount_rotation_deg\": 0",
       "rig.json: cameras[0].colour_gain[1]: 20, expected a number from 0.1 to 10"},
      {"rig.json", "\"mount_rotation_deg\": 0", "\"colour_gain\": [-1, 1, 1], \"mount_rotation_deg\": 0",
       "rig.json: cameras[0].colour_gain[0]: -1, expected a number from 0.1 to 10"},
      {"rig.json", "\"mount_rotation_deg\": 0", "\"colour_gain\": 1.1, \"mount_rotation_deg\": 0",
       "rig.json: cameras[0].colour_gain: "},
      {"rig.json", "0.9999495612021441", "0.5", "rig.json: cameras[0].R: is not a rotation"},
      {"rig.json", "-0.04944543151981713", "null", "rig.json: cameras[0].distortion[0]: null, expected a number"},
      {"rig.json", "\"distortion\": [", "\"distortion\": [0,", "rig.json: cameras[0].distortion: expected the 5 numb"},
      {"rig.json", "\"id\": \"body-01\"", "\"id\": \"body-00\"", "rig.json: cameras[1].id: \"body-00\", expected"},
      {"rig.json", "2.2", "-2.2", "rig.json: volume: expected min below max"},
      {"rig.json", "2.2", "900", "rig.json: volume: expected sides of at most 10 m"},
  };
  const std::string recording_text = text_of(folder / "recording.json");
  const std::string rig_text = text_of(folder / "rig.json");
  for (const Case& c : cases) {
    write("recording.json", recording_text);
    write("rig.json", rig_text);
    replace(c.file, c.from, c.to);
    EXPECT_THAT(refusal(), StartsWith(c.message)) << c.from << " → " << c.to;
  }
}

TEST_F(ChangedRecording, AnIndexBehindThePatternsIsRefused) {
  replace("recording.json", "\"role\": \"background\"",
          R"("role": "gray_code", "pattern": {"width": 2, "height": 2, "inverse": false})");
  ASSERT_TRUE(read_recording(folder));
  replace("recording.json", "\"index\": 0", "\"index\": 4");
  EXPECT_THAT(refusal(), StartsWith("recording.json: shots[0].frames[0].index: 4, expected an integer from 0 to 3"));
}

TEST_F(ChangedRecording, DeepNestingIsRefused) {
  for (const char* bracket : {"[", "{\"a\":"}) {
    std::string text;
    for (int i = 0; i < 100000; ++i) text += bracket;
    write("recording.json", text);
    EXPECT_EQ(refusal(), "recording.json: nests too deeply");
  }
}

TEST_F(ChangedRecording, LinksThatLeadOutAreNotFollowed) {
  std::ofstream(scratch_.path() / "secret.jpg") << text_of(folder / "frames/body/body-00.jpg");
  fs::remove(folder / "frames/body/body-00.jpg");
  fs::create_symlink(scratch_.path() / "secret.jpg", folder / "frames/body/body-00.jpg");
  fs::remove(folder / "frames/body/body-01.jpg");
  fs::create_symlink("body-02.jpg", folder / "frames/body/body-01.jpg");  // inside: fine
  const auto recording = read_recording(folder);
  ASSERT_TRUE(recording);
  const LoadedShot body = load_shot(*recording, *recording->find(ShotRole::body));
  EXPECT_THAT(body.faults, testing::ElementsAre("frames/body/body-00.jpg: leads out of the recording"));
  EXPECT_EQ(body.sets[0].frames.size(), 7U);

  fs::rename(folder / "rig.json", scratch_.path() / "rig.json");
  fs::create_symlink(scratch_.path() / "rig.json", folder / "rig.json");
  EXPECT_EQ(refusal(), "recording.json: rig: rig.json: leads out of the recording");
}

TEST_F(ChangedRecording, AnImageOfAnotherSizeIsAFault) {
  replace("rig.json", "\"width\": 480", "\"width\": 481");
  const auto recording = read_recording(folder);
  ASSERT_TRUE(recording);
  const LoadedShot body = load_shot(*recording, *recording->find(ShotRole::body));
  EXPECT_THAT(body.faults,
              testing::ElementsAre("frames/body/body-00.jpg: has 480 × 640 pixels, the rig says 481 × 640"));
  EXPECT_EQ(body.sets[0].frames.size(), 7U);
}

TEST(WriteRigJson, GivesEveryNumberBack) {
  const auto rig = read_rig(mini / "rig.json");
  ASSERT_TRUE(rig);
  Rig written = *rig;
  written.projector = CalibratedView{written.cameras[3]};
  written.projector->id = "beamer";
  written.cameras[1].role = CameraRole::face;
  written.cameras[1].mount_rotation_deg = 270;
  written.cameras[2].rms_px.reset();
  written.cameras[1].uncertainty = PoseUncertainty{.center_m = 0.0004, .rotation_rad = 0.00017};
  written.cameras[2].intrinsics.skew = 1.0 / 3.0;
  written.cameras[2].colour_gain = {0.1F, 1.0F / 3, 10.0F};
  const ScratchFolder scratch;
  ASSERT_TRUE(write_file_atomically(scratch.path() / "rig.json", write_rig_json(written)));
  const auto read = read_rig(scratch.path() / "rig.json");
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->name, written.name);
  EXPECT_EQ(read->volume.min(), written.volume.min());
  EXPECT_EQ(read->volume.max(), written.volume.max());
  ASSERT_EQ(read->cameras.size(), written.cameras.size());
  const auto expect_same = [](const CalibratedView& a, const CalibratedView& b) {
    EXPECT_EQ(a.id, b.id);
    EXPECT_EQ(a.intrinsics.width, b.intrinsics.width);
    EXPECT_EQ(a.intrinsics.fx, b.intrinsics.fx);
    EXPECT_EQ(a.intrinsics.skew, b.intrinsics.skew);
    EXPECT_EQ(a.intrinsics.cy, b.intrinsics.cy);
    EXPECT_EQ(a.intrinsics.distortion, b.intrinsics.distortion);
    EXPECT_EQ(a.camera_from_world.matrix(), b.camera_from_world.matrix());
  };
  for (size_t i = 0; i < written.cameras.size(); ++i) {
    expect_same(read->cameras[i], written.cameras[i]);
    EXPECT_EQ(read->cameras[i].role, written.cameras[i].role);
    EXPECT_EQ(read->cameras[i].mount_rotation_deg, written.cameras[i].mount_rotation_deg);
    EXPECT_EQ(read->cameras[i].rms_px, written.cameras[i].rms_px);
    EXPECT_TRUE((read->cameras[i].colour_gain == written.cameras[i].colour_gain).all());
    ASSERT_EQ(read->cameras[i].uncertainty.has_value(), written.cameras[i].uncertainty.has_value());
    if (!written.cameras[i].uncertainty) continue;
    EXPECT_EQ(read->cameras[i].uncertainty->center_m, written.cameras[i].uncertainty->center_m);
    EXPECT_EQ(read->cameras[i].uncertainty->rotation_rad, written.cameras[i].uncertainty->rotation_rad);
  }
  ASSERT_TRUE(read->projector);
  expect_same(*read->projector, *written.projector);
}

}  // namespace
}  // namespace booth
