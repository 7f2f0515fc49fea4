// The real boothd on the kernel's devices: USB cameras that wait for their trigger line, the GPIO line that pulses it,
// and a projector on a display output, whose picture the face cameras see.

#include <gmock/gmock.h>

#include <iostream>

#include "drivers/display/pattern_image.h"
#include "pipeline/image/codec.h"
#include "tests/end_to_end/booth_process.h"
#include "tests/virtual_booth/guest/display_peer.h"
#include "tests/virtual_booth/guest/guest_booth.h"

namespace booth::test {
namespace {

using testing::ElementsAre;
using testing::IsEmpty;

constexpr int display_width = 1024, display_height = 768;
/// An emulated machine is slow, on a busy host very slow.
constexpr std::chrono::minutes patience{10};

std::vector<uint8_t> bytes_of(const fs::path& file) {
  const std::string text = text_of(file);
  return {text.begin(), text.end()};
}

/// Every pixel of the first row and of the first column, which tell all patterns apart.
std::vector<uint32_t> border_of(const std::vector<uint32_t>& pixels) {
  std::vector<uint32_t> border(pixels.begin(), pixels.begin() + display_width);
  for (int y = 0; y < display_height; ++y) border.push_back(pixels[static_cast<size_t>(y) * display_width]);
  return border;
}

/// What each camera sees: the pictures of a recording, those of the face as the display shows their pattern.
class RecordedPerson {
 public:
  explicit RecordedPerson(const Recording& recording) : recording_(recording) {
    std::vector<uint32_t> drawn(size_t{display_width} * display_height);
    const GrayCodePattern pattern{.width = display_width, .height = display_height};
    for (int i = 0; i < pattern_count(pattern); ++i) {
      draw_pattern(pattern, i, 0xFFFFFF, drawn, display_width);
      borders_.push_back(border_of(drawn));
    }
    for (const RigCamera& camera : recording.rig.cameras) {
      const CalibratedView& view = camera;
      cameras_[camera.id] = std::make_unique<WiredCamera>(
          camera.id, std::vector<UsbCameraPeer::Mode>{{"MJPG", view.intrinsics.width, view.intrinsics.height}});
      cameras_[camera.id]->peer.set_frames({frames(camera.id, ShotRole::body)});
    }
    GuestBooth::instance().at_trigger([this] { look(); });
  }
  ~RecordedPerson() { GuestBooth::instance().at_trigger({}); }
  RecordedPerson(const RecordedPerson&) = delete;
  RecordedPerson& operator=(const RecordedPerson&) = delete;

  UsbCameraPeer& camera(const std::string& id) { return cameras_.at(id)->peer; }
  void plug_in() {
    for (const auto& [id, camera] : cameras_) ASSERT_TRUE(camera->peer.plug_in()) << id;
  }
  void show(ShotRole role) {
    for (const auto& [id, camera] : cameras_) camera->peer.set_frames(frames(id, role));
    shown_ = -1;
  }
  /// At that pattern the camera is unplugged, instead of exposing.
  void unplug_at(int pattern, const std::string& camera) { unplug_ = {pattern, camera}; }

 private:
  std::vector<std::vector<uint8_t>> frames(const std::string& camera, ShotRole role) const {
    std::vector<std::vector<uint8_t>> found;
    if (const Shot* shot = recording_.find(role))
      for (const FrameRecord& record : shot->frames)
        if (record.camera == camera) found.push_back(bytes_of(recording_.folder / record.file));
    return found;
  }
  /// The trigger line is pulsed: the face cameras see what the projector shows.
  void look() {
    const auto screen = look_at(GuestBooth::card);
    // Black before the first pattern is a projector that is not in use.
    if (!screen || (shown_ < 0 && screen->is_black())) return;
    const auto found = std::find(borders_.begin(), borders_.end(), border_of(screen->pixels));
    if (found == borders_.end()) {
      ADD_FAILURE() << "the display shows no pattern";
      return;
    }
    shown_ = static_cast<int>(found - borders_.begin());
    for (const FrameRecord& record : recording_.find(ShotRole::gray_code)->frames)
      if (record.index == shown_)
        cameras_.at(record.camera)->peer.set_frames({bytes_of(recording_.folder / record.file)});
    if (unplug_ && unplug_->first == shown_) camera(std::exchange(unplug_, std::nullopt)->second).unplug();
  }

  const Recording& recording_;
  std::vector<std::vector<uint32_t>> borders_;  ///< of each pattern
  std::map<std::string, std::unique_ptr<WiredCamera>> cameras_;
  std::atomic<int> shown_ = -1;  ///< the pattern at the last pulse; −1: none yet
  std::optional<std::pair<int, std::string>> unplug_;
};

class GuestCapture : public testing::Test {
 protected:
  /// The recording of the repository, with two face cameras that look straight at what the projector shows.
  Recording with_face_cameras() {
    const auto mini = read_recording(BOOTH_SOURCE_DIR "/replay/recordings/mini");
    EXPECT_TRUE(mini) << mini.error().message;
    constexpr int step = 8;  // display pixels in one of a camera's
    constexpr int width = display_width / step, height = display_height / step;
    Rig rig = mini->rig;
    rig.projector = mini->rig.cameras.front();
    rig.projector->id = "projector";
    rig.projector->intrinsics = {
        .width = display_width, .height = display_height, .fx = 1600, .fy = 1600, .cx = 512, .cy = 384};
    for (const char* face : {"face-left", "face-right"}) {
      RigCamera camera = mini->rig.cameras.front();
      camera.id = face;
      camera.role = CameraRole::face;
      camera.intrinsics = {.width = width, .height = height, .fx = 200, .fy = 200, .cx = 64, .cy = 48};
      rig.cameras.push_back(camera);
    }
    auto writer = RecordingWriter::begin(
        folder.path(), {.id = "composed", .created = mini->created, .label = {}, .face = "auto"}, rig);
    EXPECT_TRUE(writer) << writer.error().message;
    const auto add = [&](const std::string& shot, const std::string& camera, int index, const Image& image) {
      const Frame frame{.camera = camera,
                        .index = index,
                        .pixels = std::make_shared<const Image>(image),
                        .encoded = std::make_shared<const std::vector<uint8_t>>(encode_jpeg(image))};
      const auto added = (*writer)->add(shot, frame);
      EXPECT_TRUE(added) << added.error().message;
    };
    for (const ShotRole role : {ShotRole::background, ShotRole::body}) {
      const Shot& shot = *mini->find(role);
      EXPECT_TRUE((*writer)->begin_shot({.name = shot.name, .role = role}));
      for (const FrameRecord& record : shot.frames) {
        auto frame = load_frame(*mini, record);
        EXPECT_TRUE(frame) << frame.error().message;
        frame->encoded = std::make_shared<const std::vector<uint8_t>>(bytes_of(mini->folder / record.file));
        EXPECT_TRUE((*writer)->add(shot.name, *frame));
      }
      for (const char* face : {"face-left", "face-right"})
        add(shot.name, face, 0, Image(width, height, 1, uint8_t{40}));
    }
    const GrayCodePattern pattern{.width = display_width, .height = display_height};
    EXPECT_TRUE((*writer)->begin_shot({.name = "face", .role = ShotRole::gray_code, .pattern = pattern}));
    std::vector<uint32_t> drawn(size_t{display_width} * display_height);
    for (int i = 0; i < pattern_count(pattern); ++i) {
      draw_pattern(pattern, i, 0xFFFFFF, drawn, display_width);
      Image seen(width, height, 1);
      for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x)
          seen.at(x, y) = static_cast<uint8_t>(drawn[static_cast<size_t>(y * step * display_width + x * step)]);
      for (const char* face : {"face-left", "face-right"}) add("face", face, i, seen);
    }
    EXPECT_TRUE((*writer)->commit());
    const auto composed = read_recording((*writer)->final_path());
    EXPECT_TRUE(composed) << composed.error().message;
    return *composed;
  }

  void start(const Recording& recording) {
    fs::copy_file(recording.folder / "rig.json", booth.state() / "calibration" / "rig.json");
    std::stringstream text;
    text << "[capture]\nframe_timeout_ms = 60000\nmax_skew_ms = 60000\n[trigger]\ndriver = \"gpio\"\n"
         << "[trigger.gpio]\nchip = \"" << GuestBooth::instance().gpio().chip()
         << "\"\nline = \"camera-trigger\"\n[projector]\ndriver = \"display\"\n[projector.display]\nid = \""
         << recording.rig.projector->id << "\"\ncard = \"" << GuestBooth::card << "\"\nwidth = " << display_width
         << "\nheight = " << display_height << "\ndelay_us = 20000\n";
    for (const RigCamera& camera : recording.rig.cameras)
      text << "[[cameras]]\nid = \"" << camera.id << "\"\nrole = \""
           << (camera.role == CameraRole::face ? "face" : "body") << "\"\ndriver = \"v4l2\"\nserial = \"" << camera.id
           << "\"\nformat = \"mjpg\"\nwidth = " << camera.intrinsics.width << "\nheight = " << camera.intrinsics.height
           << "\ntrigger = \"line\"\nmax_offset_ms = 60000\n";
    booth.start(text.str(), reconstruct.path());
    ASSERT_TRUE(wait_until([&] { return booth.all_online(); }, patience))
        << booth.call("system.status") << text_of(booth.log());
    ASSERT_THAT(booth.not_ready(), ElementsAre("no_background")) << text_of(booth.log());
  }
  /// An event that may take long to come.
  Json wait_event(const std::function<bool(const SeenEvent&)>& wanted) {
    const auto deadline = std::chrono::steady_clock::now() + patience;
    while (std::chrono::steady_clock::now() < deadline)
      if (const auto event = booth.listener().find(wanted)) return event->fields;
    ADD_FAILURE() << "it never came:\n" << text_of(booth.log());
    return {};
  }
  void learn_background(RecordedPerson& person, const Recording& recording) {
    person.show(ShotRole::background);
    const auto& frames = recording.find(ShotRole::background)->frames;
    const auto count = std::count_if(frames.begin(), frames.end(),
                                     [&](const FrameRecord& record) { return record.camera == frames[0].camera; });
    const std::string task = booth.call("background.learn", {{"frames", count}})["task"];
    const Json learned = wait_event([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["task"] == task && event.fields["state"] != "running";
    });
    ASSERT_EQ(learned["state"], "done") << learned;
    ASSERT_TRUE(wait_until([&] { return booth.not_ready().empty(); })) << booth.call("system.status");
  }
  Recording capture(RecordedPerson& person) {
    person.show(ShotRole::body);
    id = booth.call("capture.start", {{"face", "active"}})["capture"];
    const Json end = wait_event(
        [&](const SeenEvent& event) { return event.topic.starts_with("capture.") && event.fields["capture"] == id; });
    EXPECT_FALSE(end.contains("kind")) << end << text_of(booth.log());
    const auto read = read_recording(booth.state() / "recordings" / id);
    EXPECT_TRUE(read) << read.error().message << text_of(booth.log());
    return read ? *read : Recording{};
  }
  /// The cameras' own bytes are in the recording.
  static void expect_same_files(const Recording& expected, const Recording& actual) {
    for (const ShotRole role : {ShotRole::background, ShotRole::body, ShotRole::gray_code}) {
      const Shot *from = expected.find(role), *to = actual.find(role);
      ASSERT_TRUE(from != nullptr && to != nullptr) << to_string(role);
      ASSERT_EQ(from->frames.size(), to->frames.size()) << to_string(role);
      for (const FrameRecord& record : from->frames) {
        const auto match = std::find_if(to->frames.begin(), to->frames.end(), [&](const FrameRecord& other) {
          return other.camera == record.camera && other.index == record.index;
        });
        ASSERT_NE(match, to->frames.end()) << record.camera << " " << record.index;
        EXPECT_TRUE(bytes_of(expected.folder / record.file) == bytes_of(actual.folder / match->file))
            << to_string(role) << ": " << record.camera << " " << record.index;
      }
    }
  }
  /// Where this machine's host finds it afterwards, to make avatars of both: that takes too long here.
  static void hand_over(const std::string& name, const Recording& expected, const Recording& actual) {
    const char* out = std::getenv("BOOTH_GUEST_OUT");
    if (out == nullptr) return;
    fs::create_directories(fs::path(out) / name);
    for (const auto& [part, recording] : {std::pair{"expected", &expected}, std::pair{"captured", &actual}})
      fs::copy(recording->folder, fs::path(out) / name / part, fs::copy_options::recursive);
  }

  const ScratchFolder folder;
  const FakeReconstruct reconstruct{folder.path()};
  BoothProcess booth{folder.path()};
  std::string id;
};

TEST_F(GuestCapture, BodyAndFaceAreCapturedAndALostFaceCameraComesBack) {
  const Recording recording = with_face_cameras();
  RecordedPerson person(recording);
  ASSERT_NO_FATAL_FAILURE(person.plug_in());
  ASSERT_NO_FATAL_FAILURE(start(recording));
  ASSERT_NO_FATAL_FAILURE(learn_background(person, recording));
  const Recording whole = capture(person);
  expect_same_files(recording, whole);
  const auto shots = booth.shots(id);
  ASSERT_EQ(shots.size(), 1u + 42u);
  for (const Json& shot : shots) {
    EXPECT_THAT(shot["missing"], IsEmpty()) << shot;
    EXPECT_EQ(shot["retries"], 0) << shot;
  }
  hand_over("composed", recording, whole);

  constexpr int killed_at = 20;
  person.unplug_at(killed_at, "face-right");
  const Recording without = capture(person);
  size_t left = 0, right = 0;
  for (const FrameRecord& record : without.find(ShotRole::gray_code)->frames)
    ++(record.camera == "face-left" ? left : right);
  EXPECT_EQ(left, 42u);
  EXPECT_EQ(right, static_cast<size_t>(killed_at));
  ASSERT_TRUE(wait_until([&] { return booth.camera("face-right")["state"] == "offline"; }));
  EXPECT_EQ(booth.camera("face-right")["fault"], "temporary");
  const auto screen = look_at(GuestBooth::card);
  EXPECT_TRUE(!screen || screen->is_black()) << "the projector is dark";

  ASSERT_TRUE(person.camera("face-right").plug_in());
  ASSERT_TRUE(wait_until([&] { return booth.camera("face-right")["state"] == "online"; }, patience))
      << text_of(booth.log());
  expect_same_files(recording, capture(person));
  EXPECT_EQ(booth.stop(), 0) << text_of(booth.log());
}

TEST_F(GuestCapture, AManIsCapturedAsHeWasRecorded) {
  const char* recordings = std::getenv("BOOTH_RECORDINGS");
  if (recordings == nullptr || !fs::exists(fs::path(recordings) / "man-casual"))
    GTEST_SKIP() << "BOOTH_RECORDINGS does not name a folder with man-casual";
  const auto recording = read_recording(fs::path(recordings) / "man-casual");
  ASSERT_TRUE(recording) << recording.error().message;
  RecordedPerson person(*recording);
  ASSERT_NO_FATAL_FAILURE(person.plug_in());
  ASSERT_NO_FATAL_FAILURE(start(*recording));
  ASSERT_NO_FATAL_FAILURE(learn_background(person, *recording));
  const Recording captured = capture(person);
  expect_same_files(*recording, captured);
  hand_over("man-casual", *recording, captured);
  EXPECT_EQ(booth.stop(), 0) << text_of(booth.log());
}

}  // namespace
}  // namespace booth::test
