#include "daemon/offline_correction.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <nlohmann/json.hpp>
#include <numbers>

#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/truth.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;

/// The small recording, copied, and one by a rig of which a camera was turned since.
class OfflineCorrection : public testing::Test {
 protected:
  void SetUp() override {
    const auto small = quality::find_recording("mini");
    ASSERT_TRUE(small);
    for (const fs::path& copy : {as_it_was_, moved_}) {
      fs::create_directories(copy);
      for (const char* part : {"recording.json", "rig.json", "frames"})
        fs::copy(*small / part, copy / part, fs::copy_options::recursive);
    }
    Rig rig = read_recording(moved_).value().rig;
    RigCamera& camera = rig.cameras.at(5);
    ASSERT_EQ(camera.id, "body-05");
    camera.camera_from_world =
        Eigen::AngleAxisd(0.4 * std::numbers::pi / 180, Eigen::Vector3d::UnitY()) * camera.camera_from_world;
    fs::permissions(moved_ / "rig.json", fs::perms::owner_write, fs::perm_options::add);
    std::ofstream(moved_ / "rig.json") << write_rig_json(rig);
  }

  Result<RigCorrection> correct(const std::vector<fs::path>& recordings, const fs::path& out) {
    return correct_from_recordings({.recordings = recordings, .out = out}, pool_.work());
  }
  static std::string text_of(const fs::path& file) {
    std::ifstream in(file);
    return {std::istreambuf_iterator<char>(in), {}};
  }

  ScratchFolder folder_;
  const fs::path as_it_was_ = folder_.path() / "as-it-was", moved_ = folder_.path() / "moved";
  ThreadPool pool_;
};

TEST_F(OfflineCorrection, ProposesARigForACameraThatMovedAndNothingForAGoodOne) {
  const fs::path none = folder_.path() / "none", proposal = folder_.path() / "proposal";
  const auto good = correct({as_it_was_}, none);
  ASSERT_TRUE(good) << good.error().message;
  EXPECT_FALSE(good->needed);
  EXPECT_FALSE(fs::exists(none / "rig.json"));
  EXPECT_THAT(text_of(none / "report.html"), HasSubstr("no correction needed"));

  const std::string rig_before = text_of(moved_ / "rig.json");
  const auto found = correct({moved_}, proposal);
  ASSERT_TRUE(found) << found.error().message;
  EXPECT_TRUE(found->needed);
  const auto proposed = read_rig(proposal / "rig.json");
  ASSERT_TRUE(proposed) << proposed.error().message;
  const Rig truth = read_recording(as_it_was_).value().rig, wrong = read_recording(moved_).value().rig;
  for (const RigCamera& camera : truth.cameras) {
    const Eigen::Matrix4d was = wrong.find(camera.id)->camera_from_world.matrix();
    const Eigen::Matrix4d now = proposed->find(camera.id)->camera_from_world.matrix();
    EXPECT_EQ((now - was).norm() > 1e-4, camera.id == "body-05") << camera.id;
  }
  const auto figures = nlohmann::json::parse(text_of(proposal / "correction.json"));
  EXPECT_EQ(figures["captures"], 1);
  EXPECT_EQ(figures["cameras"].size(), truth.cameras.size());
  EXPECT_LT(figures["cameras"][5]["after_px"].get<double>(), 0.5 * figures["cameras"][5]["before_px"].get<double>());
  EXPECT_THAT(text_of(proposal / "report.html"), HasSubstr("body-05: carried by"));
  EXPECT_EQ(text_of(moved_ / "rig.json"), rig_before) << "a proposal changes nothing";

  // What is there is never overwritten.
  const auto again = correct({moved_}, proposal);
  ASSERT_FALSE(again);
  EXPECT_EQ(again.error().code, ErrorCode::invalid_state);
}

TEST_F(OfflineCorrection, RefusesRecordingsThatDoNotBelongTogether) {
  const fs::path out = folder_.path() / "out";
  const auto mixed = correct({as_it_was_, moved_}, out);
  ASSERT_FALSE(mixed);
  EXPECT_EQ(mixed.error().code, ErrorCode::invalid_argument);
  EXPECT_THAT(mixed.error().message, HasSubstr((moved_ / "").parent_path().string()));
  EXPECT_FALSE(correct({}, out));
  EXPECT_FALSE(correct({folder_.path() / "nowhere"}, out));
  EXPECT_FALSE(fs::exists(out));
}

}  // namespace
}  // namespace booth
