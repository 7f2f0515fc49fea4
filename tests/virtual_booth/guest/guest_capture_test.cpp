// The real boothd on the kernel's devices: USB cameras that wait for their trigger line, the GPIO line that pulses it,
// and a projector on a display output, whose picture the face cameras see.

#include <gmock/gmock.h>

#include <iostream>

#include "drivers/display/pattern_image.h"
#include "pipeline/image/codec.h"
#include "tests/drivers/aravis_booth.h"
#include "tests/end_to_end/booth_process.h"
#include "tests/virtual_booth/guest/display_peer.h"
#include "tests/virtual_booth/guest/guest_booth.h"

namespace booth::test {
namespace {

using testing::ElementsAre;
using testing::IsEmpty;
using testing::UnorderedElementsAre;

[[maybe_unused]] const auto* const network = testing::AddGlobalTestEnvironment(new OwnNetwork);

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
    GuestBooth::instance().at_trigger([this](const GpioPeer::Edge&) { look(); });
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
  Json wait_end_of_task(const std::string& task) {
    return wait_event([&](const SeenEvent& event) {
      return event.topic == "task" && event.fields["task"] == task && event.fields["state"] != "running";
    });
  }
  using Show = std::function<void(ShotRole)>;
  void learn_background(const Show& show, std::ptrdiff_t frames) {
    show(ShotRole::background);
    const Json learned = wait_end_of_task(booth.call("background.learn", {{"frames", frames}})["task"]);
    ASSERT_EQ(learned["state"], "done") << learned;
    ASSERT_TRUE(wait_until([&] { return booth.not_ready().empty(); })) << booth.call("system.status");
  }
  void learn_background(RecordedPerson& person, const Recording& recording) {
    const auto& frames = recording.find(ShotRole::background)->frames;
    learn_background([&](ShotRole role) { person.show(role); },
                     std::count_if(frames.begin(), frames.end(),
                                   [&](const FrameRecord& record) { return record.camera == frames[0].camera; }));
  }
  Recording capture(RecordedPerson& person) {
    return capture([&](ShotRole role) { person.show(role); }, "active");
  }
  Recording capture(const Show& show, const std::string& face) {
    show(ShotRole::body);
    id = booth.call("capture.start", {{"face", face}})["capture"];
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

/// Three GigE cameras and three USB ones on one trigger line, and two that are played back.
class MixedBooth {
 public:
  explicit MixedBooth(const Recording& recording) : recording_(recording) {
    for (const RigCamera& camera : recording.rig.cameras) {
      const int width = camera.intrinsics.width, height = camera.intrinsics.height;
      const int number = static_cast<int>(usb.size() + gige.size());
      if (gige.size() < 3)
        gige[camera.id] = std::make_shared<GigeCamera>(
            GigeCameraOptions{.address = virtual_booth::camera_address(number),
                              .serial = camera.id,
                              .scenes = {std::make_shared<const Image>(width, height, 3, uint8_t{0})}});
      else if (usb.size() < 3)
        usb[camera.id] =
            std::make_unique<WiredCamera>(camera.id, std::vector<UsbCameraPeer::Mode>{{"MJPG", width, height}});
    }
    GuestBooth::instance().at_trigger([this](const GpioPeer::Edge&) {
      for (const auto& [id, camera] : gige) camera->pulse();
    });
  }
  ~MixedBooth() { GuestBooth::instance().at_trigger({}); }
  MixedBooth(const MixedBooth&) = delete;
  MixedBooth& operator=(const MixedBooth&) = delete;

  void show(ShotRole role) {
    std::map<std::string, std::vector<std::shared_ptr<const Image>>> scenes;
    std::map<std::string, std::vector<std::vector<uint8_t>>> files;
    for (const FrameRecord& record : recording_.find(role)->frames) {
      if (gige.contains(record.camera)) scenes[record.camera].push_back(load_frame(recording_, record)->pixels);
      if (usb.contains(record.camera)) files[record.camera].push_back(bytes_of(recording_.folder / record.file));
    }
    for (const auto& [id, camera] : gige) camera->see(scenes.at(id));
    for (const auto& [id, camera] : usb) camera->peer.set_frames(files.at(id));
  }
  /// The configuration of all cameras, and of the line that triggers them.
  std::string sections() const {
    std::stringstream text;
    text << "[capture]\nframe_timeout_ms = 60000\nmax_skew_ms = 60000\n[projector]\ndriver = \"none\"\n"
         << "[trigger]\ndriver = \"gpio\"\n[trigger.gpio]\nchip = \"" << GuestBooth::instance().gpio().chip()
         << "\"\nline = \"camera-trigger\"\n[replay]\nrecording = \"" << recording_.folder.string()
         << "\"\npace = \"fast\"\n";
    for (const RigCamera& camera : recording_.rig.cameras) {
      text << "[[cameras]]\nid = \"" << camera.id << "\"\n";
      if (gige.contains(camera.id))
        text << "driver = \"aravis\"\naddress = \"" << gige.at(camera.id)->address()
             << "\"\nexposure_us = 1000\npixel_format = \"RGB8\"\npacket_size = 1500\n"
             << "frame_retention_ms = 10000\nsocket_buffer_kib = 4096\n";
      else if (usb.contains(camera.id))
        text << "driver = \"v4l2\"\nserial = \"" << camera.id
             << "\"\nformat = \"mjpg\"\nwidth = " << camera.intrinsics.width
             << "\nheight = " << camera.intrinsics.height << "\ntrigger = \"line\"\nmax_offset_ms = 60000\n";
      else
        text << "driver = \"replay\"\n";
    }
    return text.str();
  }

  std::map<std::string, std::shared_ptr<GigeCamera>> gige;
  std::map<std::string, std::unique_ptr<WiredCamera>> usb;

 private:
  const Recording& recording_;
};

TEST_F(GuestCapture, OneFileMixesDriversOnOneTriggerLine) {
  if (!no_network_reason().empty()) GTEST_SKIP() << no_network_reason();
  const auto recording = read_recording(BOOTH_SOURCE_DIR "/replay/recordings/mini");
  ASSERT_TRUE(recording) << recording.error().message;
  MixedBooth mixed(*recording);
  for (const auto& [name, camera] : mixed.usb) ASSERT_TRUE(camera->peer.plug_in()) << name;
  fs::copy_file(recording->folder / "rig.json", booth.state() / "calibration" / "rig.json");
  booth.start(mixed.sections(), reconstruct.path());
  ASSERT_TRUE(wait_until([&] { return booth.all_online(); }, patience)) << text_of(booth.log());
  ASSERT_NO_FATAL_FAILURE(learn_background([&](ShotRole role) { mixed.show(role); }, 1));
  const auto take = [&] { return capture([&](ShotRole role) { mixed.show(role); }, "none"); };
  expect_same_pictures(*recording, take(), {ShotRole::background, ShotRole::body});
  ASSERT_EQ(booth.shots(id).size(), 1u);
  EXPECT_THAT(booth.shots(id)[0]["missing"], IsEmpty()) << text_of(booth.log());
  EXPECT_EQ(booth.shots(id)[0]["retries"], 0);

  // One of each bus fails; the others go on, and both come back.
  const auto& [gige_id, gige] = *mixed.gige.begin();
  const auto& [usb_id, usb] = *mixed.usb.begin();
  gige->power_off();
  usb->peer.unplug();
  take();
  EXPECT_THAT(booth.shots(id).at(0)["missing"].get<std::vector<std::string>>(), UnorderedElementsAre(gige_id, usb_id));
  gige->power_on();
  ASSERT_TRUE(usb->peer.plug_in());
  ASSERT_TRUE(wait_until([&] { return booth.all_online(); }, patience)) << text_of(booth.log());
  expect_same_pictures(*recording, take(), {ShotRole::background, ShotRole::body});
  EXPECT_EQ(booth.stop(), 0) << text_of(booth.log());
}

/// Notes when the display shows white, from its construction on.
class LightWatch {
 public:
  LightWatch() {
    thread_ = std::jthread([this](const std::stop_token& stop) {
      while (!stop.stop_requested()) {
        const bool lit = look_at_first_pixel(GuestBooth::card).value_or(0) != 0;
        {
          const std::lock_guard lock(mutex_);
          if (changes_.empty() || changes_.back().second != lit) changes_.emplace_back(clock_.now(), lit);
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
      }
    });
  }
  bool lit_at(Timestamp when) const {
    const std::lock_guard lock(mutex_);
    bool lit = false;
    for (const auto& [since, now_lit] : changes_)
      if (since <= when) lit = now_lit;
    return lit;
  }

 private:
  const MonotonicClock clock_;
  mutable std::mutex mutex_;
  std::vector<std::pair<Timestamp, bool>> changes_;  ///< guarded by mutex_
  std::jthread thread_;
};

/// A projector that takes its time, seen by a camera.
TEST_F(GuestCapture, TheProjectorsDelayIsMeasuredFromPicturesAndKept) {
  constexpr Timestamp latency = milliseconds(80);
  Recording recording = with_face_cameras();
  RecordedPerson person(recording);
  ASSERT_NO_FATAL_FAILURE(person.plug_in());
  ASSERT_NO_FATAL_FAILURE(start(recording));
  const CalibratedView& view = *recording.rig.find("face-left");
  const auto picture = [&](uint8_t level) {
    return encode_jpeg(Image(view.intrinsics.width, view.intrinsics.height, 1, level));
  };
  const std::vector<uint8_t> dim = picture(20), bright = picture(200);
  std::optional<LightWatch> watch(std::in_place);
  GuestBooth::instance().at_trigger([&](const GpioPeer::Edge& edge) {
    const bool lit = watch->lit_at(edge.when_us * 1000 - latency);
    person.camera("face-left").set_frames({lit ? bright : dim});
  });
  Json end = Json::object();
  // On a busy host pictures may be taken so much later than they say that no delay is found: then it is asked again.
  for (int tries = 0; tries < 3 && end.value("state", "") != "done"; ++tries) {
    end = wait_end_of_task(booth.call("projector.calibrate")["task"]);
    std::cout << end << "\n";
  }
  ASSERT_EQ(end["state"], "done") << end;
  const Json result = end["result"];
  EXPECT_EQ(result["camera"], "face-left");
  EXPECT_NEAR(result["contrast"].get<double>(), 180, 5);
  // The kernel says of a flip when its vertical blank will be, up to a refresh after the change is seen.
  EXPECT_GE(result["measured_us"], 50'000);
  EXPECT_LE(result["measured_us"], 250'000);
  EXPECT_GT(result["delay_us"], result["measured_us"]);
  const Json kept = Json::parse(text_of(booth.state() / "calibration" / "projector.json"));
  EXPECT_EQ(kept["projector"], "projector");
  EXPECT_EQ(kept["delay_us"], result["delay_us"]);
  GuestBooth::instance().at_trigger({});
  watch.reset();
  const auto screen = look_at(GuestBooth::card);
  EXPECT_TRUE(!screen || screen->is_black());
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
