// Whole reconstructions of recordings whose truth is known. The small recording of the repository always runs;
// larger ones are looked for in the folder that BOOTH_RECORDINGS names.

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <limits>
#include <nlohmann/json.hpp>

#include "pipeline/image/codec.h"
#include "pipeline/reconstruct.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

namespace fs = std::filesystem;

std::vector<uint8_t> bytes_of(const fs::path& file) {
  std::ifstream stream(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(stream), {}};
}
Image image_of(const fs::path& file) { return decode_image(bytes_of(file)).value(); }
nlohmann::json json_of(const fs::path& file) { return nlohmann::json::parse(bytes_of(file)); }

Result<Reconstruction> reconstruct_with_defaults(const Recording& recording) {
  ThreadPool pool;
  const Work work = pool.work();
  CaptureFrames capture;
  capture.rig = recording.rig;
  capture.background =
      learn_empty_booth(load_shot(recording, *recording.find(ShotRole::background), work).sets, work).views;
  capture.body = load_shot(recording, *recording.find(ShotRole::body), work).sets.at(0);
  return reconstruct(std::move(capture), {}, {}, work);
}

/// The limbs' joints by our name and by the truth's, without the side.
constexpr std::array<std::pair<const char*, const char*>, 6> limb_joints{{{"Arm", "upperarm01"},
                                                                          {"ForeArm", "lowerarm01"},
                                                                          {"Hand", "wrist"},
                                                                          {"UpLeg", "upperleg01"},
                                                                          {"Leg", "lowerleg01"},
                                                                          {"Foot", "foot"}}};

double mean_limb_error_m(const Skeleton& skeleton, const nlohmann::json& truth) {
  const auto world = world_from_joints(skeleton);
  double sum = 0;
  for (const auto& [side, suffix] : {std::pair{"Left", ".L"}, std::pair{"Right", ".R"}})
    for (const auto& [ours, theirs] : limb_joints) {
      const int joint = skeleton.find(std::string(side) + ours);
      if (joint < 0) return std::numeric_limits<double>::infinity();
      const auto& p = truth.at(std::string(theirs) + suffix);
      sum += (world[static_cast<size_t>(joint)].translation() - Eigen::Vector3d(p[0], p[1], p[2])).norm();
    }
  return sum / (2 * limb_joints.size());
}

class AvatarQuality : public testing::TestWithParam<const char*> {
 protected:
  static fs::path folder_of(const std::string& name) {
    if (name == "mini") return fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";
    const char* larger = std::getenv("BOOTH_RECORDINGS");
    return larger == nullptr || *larger == 0 ? fs::path() : fs::path(larger) / name;
  }
};

TEST_P(AvatarQuality, ReachesTheFloors) {
  const fs::path folder = folder_of(GetParam());
  if (folder.empty() || !fs::exists(folder / "truth")) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
  const auto recording = read_recording(folder);
  ASSERT_TRUE(recording.ok()) << recording.error().message;
  const auto made = reconstruct_with_defaults(*recording);
  ASSERT_TRUE(made.ok()) << made.error().message;
  const Avatar& avatar = made->avatar;
  const auto checked = check(avatar);
  ASSERT_TRUE(checked.ok()) << checked.error().message;

  const MeshTopology shape = topology(avatar.mesh);
  EXPECT_TRUE(shape.closed_manifold());
  EXPECT_EQ(shape.components, 1U);
  EXPECT_EQ(shape.unreferenced_vertices, 0U);
  EXPECT_GT(shape.signed_volume_m3, 0.02);
  EXPECT_LT(shape.signed_volume_m3, 0.25);
  EXPECT_LE(avatar.mesh.triangles.size(), DecimationOptions().triangles);

  const RayCaster caster(avatar.mesh);
  const auto true_rig = read_rig(folder / "truth/rig.json");
  ASSERT_TRUE(true_rig.ok()) << true_rig.error().message;
  double iou = 0;
  for (const RigCamera& camera : true_rig->cameras) {
    constexpr int every_second = 2;
    iou += silhouette_iou(caster, camera, image_of(folder / "truth/masks" / (camera.id + ".png")), every_second) /
           static_cast<double>(true_rig->cameras.size());
  }
  EXPECT_GE(iou, 0.96);
  RecordProperty("silhouette_iou", std::to_string(iou));

  const double limbs_m = mean_limb_error_m(avatar.skeleton, json_of(folder / "truth/joints.json"));
  EXPECT_LE(limbs_m, 0.020);
  RecordProperty("limbs_mean_m", std::to_string(limbs_m));

  for (const HeldOutView& view : read_held_out_views(folder)) {
    const double psnr_db = view_psnr_db(caster, avatar, view.camera, view.photograph, view.background);
    EXPECT_GE(psnr_db, 20) << view.id;
    RecordProperty("psnr_db_" + view.id, std::to_string(psnr_db));
  }
}

INSTANTIATE_TEST_SUITE_P(Recordings, AvatarQuality, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
