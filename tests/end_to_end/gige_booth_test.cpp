// The real boothd with cameras that speak GigE Vision: they see what a recording shows.

#include <gmock/gmock.h>

#include "tests/drivers/aravis_booth.h"
#include "tests/end_to_end/booth_process.h"

namespace booth::test {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::SizeIs;
using virtual_booth::camera_address;

[[maybe_unused]] const auto* const network = testing::AddGlobalTestEnvironment(new OwnNetwork);

class GigeBooth : public testing::Test {
 protected:
  void SetUp() override {
    if (!no_network_reason().empty()) GTEST_SKIP() << no_network_reason();
    const auto read = read_recording(BOOTH_SOURCE_DIR "/replay/recordings/mini");
    ASSERT_TRUE(read) << read.error().message;
    recorded = *read;
    fs::copy_file(recorded.folder / "rig.json", booth.state() / "calibration" / "rig.json");
  }

  /// Each camera from now on sees what the recording's camera saw in that shot.
  void show(ShotRole role) {
    const LoadedShot shot = load_shot(recorded, *recorded.find(role));
    for (const auto& [id, peer] : peers) {
      std::vector<std::shared_ptr<const Image>> scenes;
      for (const FrameSet& set : shot.sets)
        for (const Frame& frame : set.frames)
          if (frame.camera == id) scenes.push_back(frame.pixels);
      peer->see(scenes);
    }
  }

  /// The configuration of all cameras, the last `replayed` of which are played from the recording.
  std::string sections(const std::string& trigger, size_t replayed) {
    std::stringstream text;
    // A machine that runs many tests at once may be slow.
    text << "[capture]\nframe_timeout_ms = 20000\nmax_skew_ms = 5000\nmin_cameras = 7\n[projector]\ndriver = \"none\"\n"
         << "[trigger]\ndriver = \"aravis\"\n[replay]\nrecording = \"" << recorded.folder.string()
         << "\"\npace = \"fast\"\n";
    const auto& cameras = recorded.rig.cameras;
    for (size_t i = 0; i < cameras.size(); ++i) {
      text << "[[cameras]]\nid = \"" << cameras[i].id << "\"\nmount_rotation = \"" << cameras[i].mount_rotation_deg
           << "\"\n";
      if (i + replayed >= cameras.size()) {
        text << "driver = \"replay\"\n";
        continue;
      }
      const int number = static_cast<int>(i);
      const auto black =
          std::make_shared<const Image>(cameras[i].intrinsics.width, cameras[i].intrinsics.height, 3, uint8_t{0});
      peers[cameras[i].id] = std::make_shared<GigeCamera>(
          GigeCameraOptions{.address = camera_address(number), .serial = std::to_string(number), .scenes = {black}});
      text << "driver = \"aravis\"\naddress = \"" << camera_address(number)
           << "\"\nexposure_us = 8000\npixel_format = \"RGB8\"\ntrigger = \"" << trigger
           << "\"\npacket_size = 1500\nframe_retention_ms = 5000\nsocket_buffer_kib = 4096\n";
    }
    return text.str();
  }

  void learn_background() {
    ASSERT_TRUE(wait_until([&] { return booth.all_online(); })) << booth.call("system.status") << text_of(booth.log());
    ASSERT_THAT(booth.not_ready(), ElementsAre("no_background"));
    show(ShotRole::background);
    const Json learned = booth.end_of_task(booth.call("background.learn", {{"frames", 1}})["task"]);
    ASSERT_EQ(learned["state"], "done") << learned;
    ASSERT_TRUE(wait_until([&] { return booth.not_ready().empty(); }));
    show(ShotRole::body);
  }
  std::string capture() {
    const std::string id = booth.call("capture.start")["capture"];
    const SeenEvent end = booth.end_of_capture(id);
    EXPECT_EQ(end.topic, "capture.done") << end.fields << text_of(booth.log());
    return id;
  }
  Recording captured(const std::string& id) {
    const auto read = read_recording(booth.state() / "recordings" / id);
    EXPECT_TRUE(read) << read.error().message;
    return read ? *read : Recording{};
  }

  const ScratchFolder folder;
  BoothProcess booth{folder.path()};
  Recording recorded;
  std::map<std::string, std::shared_ptr<GigeCamera>> peers;
};

TEST_F(GigeBooth, WhatLiveCamerasSeeBecomesTheAvatarThatTheRecordingBecomes) {
  booth.start(sections("action", 0), BOOTH_RECONSTRUCT);
  learn_background();
  const std::string id = capture();
  const auto published =
      booth.listener().find([&](const SeenEvent& event) { return event.topic == "avatar.published"; });
  ASSERT_TRUE(published) << text_of(booth.log());
  const Json shot = booth.shots(id).at(0);
  EXPECT_THAT(shot["missing"], IsEmpty());
  EXPECT_EQ(shot["retries"], 0);
  EXPECT_EQ(shot["cameras"], peers.size());
  for (const auto& [camera, peer] : peers) EXPECT_EQ(peer->feature("ExposureTime"), 8000) << camera;
  expect_same_pictures(recorded, captured(id), {ShotRole::background, ShotRole::body});

  const fs::path direct = folder.path() / "direct";
  ASSERT_EQ(wait_exit(spawn({BOOTH_RECONSTRUCT, recorded.folder, direct}, folder.path() / "said")), 0)
      << text_of(folder.path() / "said");
  expect_same_avatar(direct, booth.state() / "avatars" / published->fields["avatar"].get<std::string>());
  EXPECT_EQ(booth.stop(), 0) << text_of(booth.log());
}

TEST_F(GigeBooth, OneFileMixesDriversAndALostCameraComesBack) {
  const FakeReconstruct reconstruct(folder.path());
  constexpr size_t replayed = 2;
  booth.start(sections("software", replayed), reconstruct.path());
  learn_background();
  ASSERT_THAT(peers, SizeIs(6));
  expect_same_pictures(recorded, captured(capture()), {ShotRole::background, ShotRole::body});

  GigeCamera& victim = *peers.at("body-02");
  victim.power_off();
  const std::string without = capture();
  EXPECT_EQ(booth.shots(without).at(0)["missing"], Json({"body-02"}));
  EXPECT_THAT(captured(without).find(ShotRole::body)->frames, SizeIs(7));
  ASSERT_TRUE(wait_until([&] { return booth.camera("body-02")["state"] == "offline"; }));
  EXPECT_EQ(booth.camera("body-02")["fault"], "temporary");
  EXPECT_THAT(booth.camera("body-02")["message"].get<std::string>(), HasSubstr(victim.address()));

  victim.power_on();
  ASSERT_TRUE(wait_until([&] { return booth.camera("body-02")["state"] == "online"; })) << text_of(booth.log());
  EXPECT_EQ(victim.feature("ExposureTime"), 8000) << "its settings are back";
  show(ShotRole::body);
  expect_same_pictures(recorded, captured(capture()), {ShotRole::background, ShotRole::body});
  EXPECT_EQ(booth.stop(), 0) << text_of(booth.log());
}

}  // namespace
}  // namespace booth::test
