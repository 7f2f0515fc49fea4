// Heads by the faces that cameras see, on the small recording.

#include "pipeline/face/face_place.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <fstream>
#include <sstream>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth {
namespace {

constexpr char cascade_file[] = "/usr/share/opencv4/haarcascades/haarcascade_frontalface_alt2.xml";

/// Sees what it is told to: a box in the middle of each picture, or nothing.
class FixedDetector : public FaceDetector {
 public:
  explicit FixedDetector(std::optional<double> side_px) : side_px_(side_px) {}
  std::vector<Eigen::AlignedBox2d> detect(const Image& grey, int, int) const override {
    if (!side_px_) return {};
    const Eigen::Vector2d middle((grey.width - 1) / 2.0, (grey.height - 1) / 2.0), half(*side_px_ / 2, *side_px_ / 2);
    return {Eigen::AlignedBox2d(middle - half, middle + half)};
  }

 private:
  std::optional<double> side_px_;
};

/// An arm held straight up, from the floor so that it is easy to make: rings of points, a strip of triangles each.
void add_post(Mesh* mesh, const Eigen::Vector3f& foot, float height, int rings) {
  constexpr uint32_t sides = 8;
  constexpr float radius_m = 0.04F;
  const auto first = static_cast<uint32_t>(mesh->positions.size());
  for (int r = 0; r < rings; ++r)
    for (uint32_t s = 0; s < sides; ++s) {
      const float angle = static_cast<float>(s) * 6.2832F / sides;
      mesh->positions.push_back(foot + Eigen::Vector3f(radius_m * std::cos(angle),
                                                       height * static_cast<float>(r) / static_cast<float>(rings - 1),
                                                       radius_m * std::sin(angle)));
    }
  for (uint32_t i = first; i + sides + 1 < mesh->positions.size(); ++i) {
    mesh->triangles.push_back({i, i + sides, i + 1});
    mesh->triangles.push_back({i + 1, i + sides, i + sides + 1});
  }
}

bool same(const HeadRegion& a, const HeadRegion& b) {
  return a.barycentre == b.barycentre && a.neck_y == b.neck_y && a.crown_y == b.crown_y;
}

class PlacedFace : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    made_ = new Scene;
    const Recording recording = read_recording(*quality::find_recording("mini")).value();
    made_->rig = recording.rig;
    made_->frames = load_shot(recording, *recording.find(ShotRole::body)).sets.at(0).frames;
    made_->empty_booth = load_shot(recording, *recording.find(ShotRole::background)).sets.at(0).frames;
    made_->surface = quality::read_ply(recording.folder / "truth/mesh.ply");
    made_->joints = quality::read_joints(recording.folder / "truth/joints.json");
    std::ifstream file(cascade_file, std::ios::binary);
    made_->cascade = read_face_cascade(file).value();
  }
  static void TearDownTestSuite() {
    delete made_;
    made_ = nullptr;
  }
  struct Scene {
    Rig rig;
    std::vector<Frame> frames, empty_booth;
    Mesh surface;
    std::map<std::string, Eigen::Vector3d> joints;
    std::unique_ptr<FaceDetector> cascade;
  };
  static const Scene& scene() { return *made_; }
  /// Around the whole upper body.
  static std::optional<FacePlace> place(std::span<const Frame> frames, const Work& work = {}) {
    return place_face(scene().rig, frames, scene().surface, {0, 1.3, 0}, 1.0, *scene().cascade, work);
  }
  static void expect_on_the_face(const FacePlace& face) {
    EXPECT_LT(quality::RayCaster(scene().surface).distance_m(face.middle), 0.015);
    const Eigen::Vector3d& head = scene().joints.at("head");
    EXPECT_NEAR(face.middle.x(), head.x(), 0.02);
    EXPECT_GT(face.middle.y(), head.y() - 0.05);
    EXPECT_LT(face.middle.y(), head.y() + 0.12);
    EXPECT_GT(face.middle.z(), head.z() + 0.05);
    EXPECT_GT(face.towards.z(), 0.95);
  }

 private:
  static inline Scene* made_ = nullptr;
};

TEST_F(PlacedFace, IsWhereCamerasSeeIt) {
  const auto face = place(scene().frames);
  ASSERT_TRUE(face);
  expect_on_the_face(*face);
  EXPECT_GE(face->views, 2);
  EXPECT_GT(face->width_m, 0.13);
  EXPECT_LT(face->width_m, 0.19);
}

TEST_F(PlacedFace, IsOnTheSurfaceWhereOneCameraSeesIt) {
  std::vector<Frame> frames = scene().frames;
  const auto frontal = [&](const Frame& frame) {
    const Eigen::Vector3d eye = scene().rig.find(frame.camera)->center();
    return eye.z() / std::hypot(eye.x(), eye.z());
  };
  std::sort(frames.begin(), frames.end(), [&](const Frame& a, const Frame& b) { return frontal(a) > frontal(b); });
  frames.resize(1);
  const auto face = place(frames);
  ASSERT_TRUE(face);
  EXPECT_EQ(face->views, 1);
  expect_on_the_face(*face);
}

TEST_F(PlacedFace, IsTheSameWhateverTheThreadsAndTheOrderOfCameras) {
  std::vector<Frame> reversed = scene().frames;
  std::reverse(reversed.begin(), reversed.end());
  ThreadPool pool(3);
  const auto a = place(scene().frames), b = place(reversed, pool.work());
  ASSERT_TRUE(a && b);
  EXPECT_EQ(a->middle, b->middle);
  EXPECT_EQ(a->width_m, b->width_m);
}

TEST_F(PlacedFace, IsNoneInPicturesWithoutAFace) {
  EXPECT_FALSE(place(scene().empty_booth));
  EXPECT_FALSE(place({}));
}

TEST_F(PlacedFace, IsNoHeadsWhereMoreOfTheBodyIsAboveThanAHead) {
  auto face = place(scene().frames);
  ASSERT_TRUE(face);
  const auto head = head_about(*face, scene().surface);
  ASSERT_TRUE(head);
  EXPECT_TRUE(head->box().contains(scene().joints.at("head")));
  face->middle.y() -= 0.25;  // printed on the shirt
  EXPECT_FALSE(head_about(*face, scene().surface));
}

TEST_F(PlacedFace, OverrulesAShapeWhoseTopIsNoHead) {
  Mesh surface = scene().surface;
  add_post(&surface, {0.45F, 0, 0.1F}, 2.1F, 200);
  const auto by_shape = find_head(surface);
  ASSERT_TRUE(by_shape);
  ASSERT_FALSE(by_shape->box().contains(scene().joints.at("head")));
  const auto head = find_head(surface, scene().rig, scene().frames, *scene().cascade);
  ASSERT_TRUE(head);
  float crown = 0;
  for (const Eigen::Vector3f& p : scene().surface.positions) crown = std::max(crown, p.y());
  EXPECT_NEAR(head->crown_y, crown, 0.01);
  EXPECT_NEAR(head->barycentre.x(), scene().joints.at("head").x(), 0.03);
  EXPECT_GT(head->neck_y, scene().joints.at("neck01").y() - 0.05);
  EXPECT_LT(head->neck_y, scene().joints.at("head").y() + 0.03);

  // A single camera may be wrong.
  const auto front = std::find_if(scene().frames.begin(), scene().frames.end(), [](const Frame& frame) {
    return place({&frame, 1}).has_value();
  });
  ASSERT_NE(front, scene().frames.end());
  const auto by_one = find_head(surface, scene().rig, {&*front, 1}, *scene().cascade);
  ASSERT_TRUE(by_one);
  EXPECT_TRUE(same(*by_one, *by_shape));

  // Without a face in the pictures there is nothing that speaks against the shape.
  const auto unseen = find_head(surface, scene().rig, scene().empty_booth, *scene().cascade);
  ASSERT_TRUE(unseen);
  EXPECT_TRUE(same(*unseen, *by_shape));
}

TEST_F(PlacedFace, IsTheHeadsWhereTheShapeHasNone) {
  Mesh surface = scene().surface;
  add_post(&surface, {0.45F, 0, 0.1F}, 2.1F, 2);
  ASSERT_FALSE(find_head(surface));
  const auto head = find_head(surface, scene().rig, scene().frames, *scene().cascade);
  ASSERT_TRUE(head);
  EXPECT_TRUE(head->box().contains(scene().joints.at("head")));
  EXPECT_FALSE(find_head(surface, scene().rig, scene().empty_booth, *scene().cascade));
}

TEST_F(PlacedFace, ChangesNothingWhereItLiesInTheHead) {
  const auto by_shape = find_head(scene().surface);
  ASSERT_TRUE(by_shape);
  // Half the head's height wide, in the middle of what is searched around it, which is thrice as wide.
  constexpr double px_per_m = 320;
  const FixedDetector agrees(px_per_m * 0.5 * static_cast<double>(by_shape->height()));
  const auto head = find_head(scene().surface, scene().rig, scene().frames, agrees);
  ASSERT_TRUE(head);
  EXPECT_TRUE(same(*head, *by_shape));
}

TEST_F(PlacedFace, NeitherShapeNorSightIsNoHead) {
  EXPECT_FALSE(find_head({}, scene().rig, scene().frames, *scene().cascade));
}

TEST(FaceCascade, IsRefusedWhereItIsNone) {
  for (const char* text : {"", "no XML", "<?xml version=\"1.0\"?><opencv_storage><a>1</a></opencv_storage>",
                           "<?xml version=\"1.0\"?><opencv_storage><cascade><stageType>BOOST"}) {
    std::istringstream file(text);
    const auto detector = read_face_cascade(file);
    ASSERT_FALSE(detector) << text;
    EXPECT_EQ(detector.error().code, ErrorCode::invalid_file);
  }
}

}  // namespace
}  // namespace booth
