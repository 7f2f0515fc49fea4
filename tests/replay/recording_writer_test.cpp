#include "replay/recording_writer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <random>
#include <set>
#include <thread>

#include "pipeline/image/codec.h"
#include "pipeline/image/develop.h"
#include "replay/durable_folder.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

const fs::path mini = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";

Rig small_rig() {
  Rig rig;
  rig.name = "two";
  rig.volume = {Eigen::Vector3d(-1, 0, -1), Eigen::Vector3d(1, 2, 1)};
  for (const char* id : {"left", "right"}) {
    RigCamera camera;
    camera.id = id;
    camera.intrinsics = {.width = 32, .height = 24, .fx = 30, .fy = 30, .cx = 15.5, .cy = 11.5};
    rig.cameras.push_back(camera);
  }
  return rig;
}

Frame noise_frame(const std::string& camera, int index, int channels = 3) {
  std::mt19937 random(static_cast<unsigned>(index) + 100 * static_cast<unsigned>(camera.size()));
  Image image(32, 24, channels);
  for (uint8_t& sample : image.samples) sample = static_cast<uint8_t>(random());
  return {.camera = camera,
          .index = index,
          .timestamp_ns = 1'000'000'007 + index,
          .frame_id = 70'000U + static_cast<unsigned>(index),
          .exposure_us = 8000.5,
          .gain_db = -1.25,
          .pixels = std::make_shared<const Image>(std::move(image))};
}

const RecordingHeader header{.id = "2026-11-22T10-15-00Z-7f3a",
                             .created = "2026-11-22T10:15:00Z",
                             .label = "Zoë \"the\" guest",
                             .face = "passive"};

TEST(RecordingWriter, WritesWhatTheReaderReads) {
  const ScratchFolder scratch;
  auto writer = RecordingWriter::begin(scratch.path(), header, small_rig());
  ASSERT_TRUE(writer) << writer.error().message;
  const GrayCodePattern pattern{.width = 4, .height = 2, .columns = true, .rows = false, .inverse = false};
  const CalibrationBoard board{.squares_x = 8, .squares_y = 11, .square_m = 0.06, .marker_m = 0.045, .dictionary = "D"};
  ASSERT_TRUE((*writer)->begin_shot({.name = "background", .role = ShotRole::background}));
  ASSERT_TRUE((*writer)->begin_shot({.name = "body", .role = ShotRole::body}));
  ASSERT_TRUE((*writer)->begin_shot({.name = "face", .role = ShotRole::gray_code, .pattern = pattern}));
  ASSERT_TRUE((*writer)->begin_shot({.name = "board", .role = ShotRole::calibration_board, .board = board}));
  std::vector<Frame> body, background, face;
  for (const char* camera : {"right", "left"}) {
    body.push_back(noise_frame(camera, 0));
    for (int i = 2; i >= 0; --i) background.push_back(noise_frame(camera, i, 1));
    for (int i = 0; i < 4; ++i) face.push_back(noise_frame(camera, i, 1));
  }
  for (const Frame& frame : body) ASSERT_TRUE((*writer)->add("body", frame));
  for (const Frame& frame : background) ASSERT_TRUE((*writer)->add("background", frame));
  for (const Frame& frame : face) ASSERT_TRUE((*writer)->add("face", frame));
  EXPECT_FALSE(fs::exists((*writer)->final_path()));
  const auto committed = (*writer)->commit();
  ASSERT_TRUE(committed) << committed.error().message;

  const auto recording = read_recording(scratch.path() / header.id);
  ASSERT_TRUE(recording) << recording.error().message;
  EXPECT_EQ(recording->id, header.id);
  EXPECT_EQ(recording->created, header.created);
  EXPECT_EQ(recording->label, header.label);
  EXPECT_EQ(recording->face, header.face);
  EXPECT_EQ(recording->rig.cameras.size(), 2U);
  ASSERT_EQ(recording->shots.size(), 4U);
  EXPECT_EQ(recording->shots[2].pattern->width, 4);
  EXPECT_FALSE(recording->shots[2].pattern->rows);
  EXPECT_EQ(recording->shots[3].board->squares_y, 11);
  EXPECT_EQ(recording->shots[3].board->marker_m, 0.045);
  EXPECT_TRUE(fs::exists(recording->folder / "frames/body/left.png"));
  EXPECT_TRUE(fs::exists(recording->folder / "frames/face/left-003.png"));

  const auto expect_holds = [&](const Shot& shot, const std::vector<Frame>& frames) {
    EXPECT_EQ(shot.frames.size(), frames.size());
    const LoadedShot loaded = load_shot(*recording, shot);
    EXPECT_TRUE(loaded.faults.empty());
    for (const Frame& frame : frames) {
      const FrameSet& set = loaded.sets.at(static_cast<size_t>(frame.index));
      const auto read =
          std::find_if(set.frames.begin(), set.frames.end(), [&](const Frame& f) { return f.camera == frame.camera; });
      ASSERT_NE(read, set.frames.end());
      EXPECT_EQ(read->timestamp_ns, frame.timestamp_ns);
      EXPECT_EQ(read->frame_id, frame.frame_id);
      EXPECT_EQ(read->exposure_us, frame.exposure_us);
      EXPECT_EQ(read->gain_db, frame.gain_db);
      EXPECT_EQ(read->pixels->samples, frame.pixels->samples);
    }
  };
  expect_holds(recording->shots[0], background);
  expect_holds(recording->shots[1], body);
  expect_holds(recording->shots[2], face);
}

TEST(RecordingWriter, TheSameFramesInAnyOrderGiveTheSameFile) {
  const ScratchFolder scratch;
  std::vector<std::vector<uint8_t>> texts;
  for (const bool reversed : {false, true}) {
    const fs::path parent = scratch.path() / (reversed ? "b" : "a");
    auto writer = RecordingWriter::begin(parent, header, small_rig());
    ASSERT_TRUE(writer);
    ASSERT_TRUE((*writer)->begin_shot({.name = "background", .role = ShotRole::background}));
    std::vector<Frame> frames;
    for (const char* camera : {"right", "left"})
      for (int i = 0; i < 3; ++i) frames.push_back(noise_frame(camera, i));
    if (reversed) std::reverse(frames.begin(), frames.end());
    for (const Frame& frame : frames) ASSERT_TRUE((*writer)->add("background", frame));
    ASSERT_TRUE((*writer)->commit());
    texts.push_back(*read_file(parent / header.id / "recording.json", 1 << 20));
  }
  EXPECT_EQ(texts[0], texts[1]);
}

TEST(RecordingWriter, KeepsTheBytesOfTheCamera) {
  const ScratchFolder scratch;
  Frame frame = noise_frame("left", 0);
  frame.encoded = std::make_shared<const std::vector<uint8_t>>(encode_jpeg(*frame.pixels, 60));
  frame.pixels = std::make_shared<const Image>(*decode_image(*frame.encoded));
  for (const bool keep : {true, false}) {
    const fs::path parent = scratch.path() / (keep ? "kept" : "encoded");
    auto writer = RecordingWriter::begin(parent, header, small_rig(), {.keep_encoded = keep});
    ASSERT_TRUE(writer);
    ASSERT_TRUE((*writer)->begin_shot({.name = "body", .role = ShotRole::body}));
    ASSERT_TRUE((*writer)->add("body", frame));
    ASSERT_TRUE((*writer)->commit());
    const auto recording = read_recording(parent / header.id);
    ASSERT_TRUE(recording);
    const FrameRecord& record = recording->shots[0].frames[0];
    EXPECT_EQ(record.file, keep ? "frames/body/left.jpg" : "frames/body/left.png");
    const auto stored = read_file(recording->folder / record.file, 1 << 20);
    EXPECT_EQ(*stored == *frame.encoded, keep);
    EXPECT_EQ(decode_image(*stored)->samples, frame.pixels->samples);
  }
}

TEST(RecordingWriter, RawFramesComeBackRawAndDevelopTheSame) {
  for (const auto format : {SpoolOptions::Format::png, SpoolOptions::Format::jpeg}) {
    const ScratchFolder scratch;
    auto writer = RecordingWriter::begin(scratch.path(), header, small_rig(), {.format = format});
    ASSERT_TRUE(writer) << writer.error().message;
    ASSERT_TRUE((*writer)->begin_shot({.name = "body", .role = ShotRole::body}));
    Frame left = noise_frame("left", 0, 1), right = noise_frame("right", 0, 1);
    left.mosaic = Mosaic{BayerPattern::gbrg, false};
    right.mosaic = Mosaic{BayerPattern::bggr, true};
    for (const Frame& frame : {left, right}) ASSERT_TRUE((*writer)->add("body", frame));
    Frame colour = noise_frame("left", 1, 3);
    colour.mosaic = Mosaic{};
    EXPECT_EQ((*writer)->add("body", colour).error().code, ErrorCode::invalid_argument);
    ASSERT_TRUE((*writer)->commit());

    const auto recording = read_recording(scratch.path() / header.id);
    ASSERT_TRUE(recording) << recording.error().message;
    const LoadedShot loaded = load_shot(*recording, recording->shots[0]);
    ASSERT_EQ(loaded.sets.size(), 1u);
    ASSERT_EQ(loaded.sets[0].frames.size(), 2u);
    for (const Frame& frame : loaded.sets[0].frames) {
      const Frame& given = frame.camera == "left" ? left : right;
      EXPECT_EQ(frame.mosaic, given.mosaic);
      EXPECT_EQ(frame.pixels->samples, given.pixels->samples);
      EXPECT_EQ(develop(frame)->pixels->samples, develop(given)->pixels->samples);
    }
  }
}

TEST(RecordingWriter, RefusesWhatDoesNotFit) {
  const ScratchFolder scratch;
  auto writer = RecordingWriter::begin(scratch.path(), header, small_rig());
  ASSERT_TRUE(writer);
  EXPECT_EQ((*writer)->begin_shot({.name = "../x"}).error().code, ErrorCode::invalid_argument);
  EXPECT_EQ((*writer)->begin_shot({.name = "f", .role = ShotRole::gray_code}).error().code,
            ErrorCode::invalid_argument);
  ASSERT_TRUE((*writer)->begin_shot({.name = "body"}));
  EXPECT_EQ((*writer)->begin_shot({.name = "body"}).error().code, ErrorCode::invalid_argument);
  ASSERT_TRUE((*writer)->add("body", noise_frame("left", 0)));

  Frame large = noise_frame("right", 0);
  large.pixels = std::make_shared<const Image>(33, 24, 3);
  Frame empty = noise_frame("right", 0);
  empty.pixels = nullptr;
  const std::pair<const char*, Frame> refused[] = {{"body", noise_frame("left", 0)},   // again
                                                   {"body", noise_frame("right", 1)},  // a body shot is one trigger
                                                   {"body", noise_frame("right", -1)},
                                                   {"body", noise_frame("middle", 0)},
                                                   {"face", noise_frame("right", 0)},
                                                   {"body", large},
                                                   {"body", empty}};
  for (const auto& [shot, frame] : refused) {
    const auto added = (*writer)->add(shot, frame);
    ASSERT_FALSE(added) << frame.camera << frame.index;
    EXPECT_EQ(added.error().code, ErrorCode::invalid_argument);
    EXPECT_THAT(added.error().message, testing::AnyOf(HasSubstr(frame.camera), HasSubstr(shot)));
  }
  const RecordingHeader wrong[] = {{.id = "../x", .created = header.created},
                                   {.id = "x", .created = "today"},
                                   {.id = "x", .created = header.created, .label = std::string(1001, 'x')},
                                   {.id = "x", .created = header.created, .face = "a b"}};
  for (const RecordingHeader& bad : wrong)
    EXPECT_EQ(RecordingWriter::begin(scratch.path(), bad, small_rig()).error().code, ErrorCode::invalid_argument);
  EXPECT_EQ(RecordingWriter::begin(scratch.path(), header, Rig{}).error().code, ErrorCode::invalid_argument);
}

TEST(RecordingWriter, LeavesNothingWithoutCommit) {
  const ScratchFolder scratch;
  {
    auto writer = RecordingWriter::begin(scratch.path(), header, small_rig());
    ASSERT_TRUE(writer);
    ASSERT_TRUE((*writer)->begin_shot({.name = "body"}));
    ASSERT_TRUE((*writer)->add("body", noise_frame("left", 0)));
  }
  EXPECT_TRUE(fs::is_empty(scratch.path()));
}

TEST(RecordingWriter, ShowsWhatThereIsBeforeItIsComplete) {
  const ScratchFolder scratch;
  {
    auto writer = RecordingWriter::begin(scratch.path(), header, small_rig());
    ASSERT_TRUE(writer);
    ASSERT_TRUE((*writer)->begin_shot({.name = "body"}));
    ASSERT_TRUE((*writer)->add("body", noise_frame("left", 0)));
    const auto folder = (*writer)->show_so_far();
    ASSERT_TRUE(folder) << folder.error().message;
    const auto part = read_recording(*folder);
    ASSERT_TRUE(part) << part.error().message;
    ASSERT_EQ(part->shots.size(), 1U);
    const LoadedShot loaded = load_shot(*part, part->shots[0]);
    ASSERT_EQ(loaded.sets.size(), 1U);
    EXPECT_EQ(loaded.sets[0].frames[0].pixels->samples, noise_frame("left", 0).pixels->samples);
    EXPECT_FALSE(fs::exists((*writer)->final_path()));

    ASSERT_TRUE((*writer)->add("body", noise_frame("right", 0)));
    ASSERT_TRUE((*writer)->show_so_far());
    EXPECT_EQ(read_recording(*folder)->shots[0].frames.size(), 2U);
    ASSERT_TRUE((*writer)->commit());
    EXPECT_FALSE(fs::exists(*folder));
  }
  const auto whole = read_recording(scratch.path() / header.id);
  ASSERT_TRUE(whole) << whole.error().message;
  EXPECT_EQ(whole->shots[0].frames.size(), 2U);
  std::set<std::string> files;
  for (const auto& entry : fs::directory_iterator(whole->folder)) files.insert(entry.path().filename().string());
  EXPECT_EQ(files, (std::set<std::string>{"frames", "recording.json", "rig.json"}));
}

TEST(RecordingWriter, WhatItShowedEndsWithIt) {
  const ScratchFolder scratch;
  {
    auto writer = RecordingWriter::begin(scratch.path(), header, small_rig());
    ASSERT_TRUE(writer && (*writer)->show_so_far());
  }
  EXPECT_TRUE(fs::is_empty(scratch.path()));
}

TEST(RecordingWriter, AnyLabelCanBeReadAgain) {
  const ScratchFolder scratch;
  for (const char* label : {"two\nlines\t\"", "\xff\xfe not UTF-8", "名前", "\x01"}) {
    auto writer =
        RecordingWriter::begin(scratch.path(), {.id = "a", .created = header.created, .label = label}, small_rig());
    ASSERT_TRUE(writer);
    ASSERT_TRUE((*writer)->commit());
    const auto recording = read_recording(scratch.path() / "a");
    ASSERT_TRUE(recording) << recording.error().message;
    EXPECT_FALSE(recording->label.empty());
    ASSERT_TRUE(remove_folder(scratch.path(), "a"));
  }
}

TEST(RecordingWriter, SeveralThreadsMayAdd) {
  const ScratchFolder scratch;
  auto writer = RecordingWriter::begin(scratch.path(), header, small_rig());
  ASSERT_TRUE(writer);
  ASSERT_TRUE((*writer)->begin_shot({.name = "background", .role = ShotRole::background}));
  {
    std::vector<std::jthread> threads;
    for (const std::string camera : {"left", "right"})
      threads.emplace_back([&, camera] {
        for (int i = 0; i < 10; ++i) EXPECT_TRUE((*writer)->add("background", noise_frame(camera, i)));
      });
  }
  ASSERT_TRUE((*writer)->commit());
  EXPECT_EQ(read_recording(scratch.path() / header.id)->shots[0].frames.size(), 20U);
}

TEST(RecordingWriter, TakesOverAShotWithoutCopyingPictures) {
  const auto source = read_recording(mini);
  ASSERT_TRUE(source);
  const ScratchFolder scratch;
  for (const bool second : {false, true}) {
    // The first takes over from the read-only original, the second from the first.
    const auto from = second ? read_recording(scratch.path() / "first") : source;
    ASSERT_TRUE(from) << from.error().message;
    RecordingHeader own = header;
    own.id = second ? "second" : "first";
    auto writer = RecordingWriter::begin(scratch.path(), own, from->rig);
    ASSERT_TRUE(writer);
    const auto taken = (*writer)->add_shot(*from, *from->find(ShotRole::background));
    ASSERT_TRUE(taken) << taken.error().message;
    ASSERT_TRUE((*writer)->commit());
    const auto copy = read_recording(scratch.path() / own.id);
    ASSERT_TRUE(copy) << copy.error().message;
    const LoadedShot loaded = load_shot(*copy, copy->shots[0]);
    EXPECT_TRUE(loaded.faults.empty());
    EXPECT_EQ(loaded.sets.at(0).frames.size(), 8U);
    EXPECT_EQ(copy->shots[0].frames[3].timestamp_ns, from->shots[0].frames[3].timestamp_ns);
  }
  EXPECT_TRUE(fs::equivalent(scratch.path() / "first/frames/background/body-00-000.jpg",
                             scratch.path() / "second/frames/background/body-00-000.jpg"));
}

TEST(RecordingWriter, ATakenOverPictureMustBeThere) {
  auto source = read_recording(mini);
  ASSERT_TRUE(source);
  source->shots[0].frames[2].file = "frames/absent.jpg";
  const ScratchFolder scratch;
  auto writer = RecordingWriter::begin(scratch.path(), header, source->rig);
  const auto taken = (*writer)->add_shot(*source, source->shots[0]);
  ASSERT_FALSE(taken);
  EXPECT_EQ(taken.error().code, ErrorCode::invalid_file);
  EXPECT_THAT(taken.error().message, HasSubstr("frames/absent.jpg"));
}

}  // namespace
}  // namespace booth
