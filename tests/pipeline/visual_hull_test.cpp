#include "pipeline/hull/visual_hull.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>

#include "pipeline/geometry/camera_model.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

using testing::HasSubstr;

struct Scene {
  synthetic::Body body;
  Rig rig;
  std::vector<Silhouette> silhouettes;
};

Scene make_scene(const synthetic::Body& body, const synthetic::RigOptions& options = {}) {
  Scene scene{body, synthetic::ring_rig(options), {}};
  scene.silhouettes = synthetic::render_silhouettes(body, scene.rig);
  return scene;
}

/// A pixel of person_scene is 16 mm, of which coverage by nine rays leaves up to a third unsure.
constexpr double unsure_m = 0.006;

const Scene& person_scene() {
  static const Scene scene = make_scene(synthetic::person().body, {.width = 126, .height = 168});
  return scene;
}

Mesh hull_mesh(const Scene& scene, const VisualHullOptions& options = {.voxel_m = 0.01}) {
  const auto hull = carve_visual_hull(scene.rig, scene.silhouettes, options);
  EXPECT_TRUE(hull.ok()) << hull.error().message;
  return extract_surface(hull->field);
}

double volume_m3(const Mesh& mesh) { return topology(mesh).signed_volume_m3; }

/// How far the hull's surface lies inside the body at most; a hull has none of the body outside.
double deepest_cut_m(const Mesh& mesh, const synthetic::Body& body) {
  double deepest = 0;
  for (const Eigen::Vector3f& p : mesh.positions)
    deepest = std::max(deepest, -synthetic::signed_distance(body, p.cast<double>()));
  return deepest;
}

bool same_bytes(const Field& a, const Field& b) {
  const auto [nx, ny, nz] = a.bricks();
  if (a.bricks() != b.bricks() || a.blocks() != b.blocks()) return false;
  for (size_t i = 0; i < static_cast<size_t>(nx) * static_cast<size_t>(ny) * static_cast<size_t>(nz); ++i)
    if (a.brick(i) != b.brick(i)) return false;
  return a.blocks() == 0 || std::memcmp(a.block(0), b.block(0), a.blocks() * Field::samples_per_brick * 4) == 0;
}

/// Blanks what a camera sees, from one row of its image on.
void cut_off_below(Silhouette& silhouette, int row) {
  for (int y = row; y < silhouette.coverage.height; ++y)
    std::fill_n(silhouette.coverage.pixel(0, y), silhouette.coverage.width, uint8_t{0});
}

TEST(VisualHull, ContainsTheBodyAndIsOneClosedSolid) {
  const Scene& scene = person_scene();
  const Mesh mesh = hull_mesh(scene);
  const MeshTopology found = topology(mesh);
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 1U);
  EXPECT_LT(deepest_cut_m(mesh, scene.body), unsure_m);
  const double body_volume = volume_m3(extract_surface(synthetic::sample_field(scene.body, 0.01)));
  EXPECT_GT(found.signed_volume_m3, body_volume);
  EXPECT_LT(found.signed_volume_m3, 1.6 * body_volume);
}

TEST(VisualHull, ASphereIsExactToAFractionOfAVoxelAndAPixel) {
  const double radius_m = 0.35;
  synthetic::RigOptions options;
  options.cameras = 16;
  const Scene scene = make_scene(synthetic::sphere(radius_m), options);
  const double voxel_m = 0.012;
  const Mesh mesh = hull_mesh(scene, {.voxel_m = voxel_m});
  double sum = 0;
  for (const Eigen::Vector3f& p : mesh.positions) sum += synthetic::signed_distance(scene.body, p.cast<double>());
  // The cones of the cameras leave a small excess between their circles of contact.
  EXPECT_LT(sum / static_cast<double>(mesh.positions.size()), 0.5 * voxel_m);
  // A pixel is 8 mm, and coverage by nine rays tells an upright outline from its neighbours by a third of it.
  EXPECT_LT(deepest_cut_m(mesh, scene.body), 0.0025);
}

TEST(VisualHull, AnotherCameraNeverAddsVolume) {
  Scene scene = person_scene();
  const std::vector<Silhouette> all = scene.silhouettes;
  double before = std::numeric_limits<double>::infinity();
  for (size_t n = 3; n <= all.size(); ++n) {
    scene.silhouettes.assign(all.begin(), all.begin() + static_cast<std::ptrdiff_t>(n));
    const double volume = volume_m3(hull_mesh(scene));
    EXPECT_LE(volume, before + 1e-9) << n << " cameras";
    before = volume;
  }
}

TEST(VisualHull, CamerasInAnotherOrderGiveTheSameSurface) {
  Scene scene = person_scene();
  const Mesh mesh = hull_mesh(scene);
  std::reverse(scene.silhouettes.begin(), scene.silhouettes.end());
  std::rotate(scene.rig.cameras.begin(), scene.rig.cameras.begin() + 3, scene.rig.cameras.end());
  EXPECT_NEAR(volume_m3(hull_mesh(scene)), volume_m3(mesh), 1e-9);
}

TEST(VisualHull, MovesWithTheScene) {
  Scene scene = person_scene();
  const Mesh mesh = hull_mesh(scene);
  // A quarter turn and a shift keep the grid's axes, so that the volume is the same box.
  Eigen::Isometry3d moved_from_world = Eigen::Isometry3d::Identity();
  moved_from_world.linear() << 0, 0, 1, 0, 1, 0, -1, 0, 0;
  moved_from_world.translation() = Eigen::Vector3d(0.3, 1.1, -2.0);
  for (RigCamera& camera : scene.rig.cameras)
    camera.camera_from_world = camera.camera_from_world * moved_from_world.inverse();
  scene.rig.volume = scene.rig.volume.transformed(moved_from_world);
  const Mesh moved = hull_mesh(scene);
  EXPECT_NEAR(volume_m3(moved), volume_m3(mesh), 1e-3 * volume_m3(mesh));
  const Eigen::Isometry3d world_from_moved = moved_from_world.inverse();
  for (size_t v = 0; v < moved.positions.size(); v += 7) {
    const Eigen::Vector3d p = world_from_moved * moved.positions[v].cast<double>();
    EXPECT_GT(synthetic::signed_distance(scene.body, p), -unsure_m);
  }
}

TEST(VisualHull, ThreadsDoNotChangeAByte) {
  const Scene& scene = person_scene();
  ThreadPool pool(8);
  const auto serial = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.01});
  const auto parallel = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.01}, pool.work());
  ASSERT_TRUE(serial.ok() && parallel.ok());
  EXPECT_TRUE(same_bytes(serial->field, parallel->field));
}

TEST(VisualHull, TheFieldIsTheSameWhateverTheCoarseStepsSettled) {
  // Every sample of the field, stored or not, agrees with asking each camera about it alone.
  const Scene& scene = person_scene();
  const auto hull = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.02});
  ASSERT_TRUE(hull.ok());
  const Grid& grid = hull->field.grid();
  int inside = 0, wrong = 0;
  for (int k = 0; k < grid.size[2]; ++k)
    for (int j = 0; j < grid.size[1]; ++j)
      for (int i = 0; i < grid.size[0]; ++i) {
        const Eigen::Vector3d p = grid.point(i, j, k);
        bool outside = !scene.rig.volume.contains(p), unsure = false;
        for (size_t c = 0; c < scene.silhouettes.size(); ++c) {
          const auto pixel = project(scene.rig.cameras[c], p);
          const Image& coverage = scene.silhouettes[c].coverage;
          if (!pixel) continue;
          const int x = static_cast<int>(std::lround(pixel->x())), y = static_cast<int>(std::lround(pixel->y()));
          if (!coverage.contains(x, y)) continue;
          for (int dy = -1; dy <= 1; ++dy)
            for (int dx = -1; dx <= 1; ++dx)
              if (coverage.contains(x + dx, y + dy) && (coverage.at(x + dx, y + dy) < 128) != (coverage.at(x, y) < 128))
                unsure = true;
          if (coverage.at(x, y) < 128) outside = true;
        }
        if (!outside) ++inside;
        // Above the head a few points that no camera can refute are a part of their own, which does not stay.
        const bool ghost = !outside && p.y() > 2;
        if (!unsure && !ghost && (hull->field.at(i, j, k) >= 0) != outside) ++wrong;
      }
  EXPECT_GT(inside, 5000);
  EXPECT_EQ(wrong, 0);
}

TEST(VisualHull, ACameraThatSeesAPartOnlyAmputatesNothing) {
  Scene scene = person_scene();
  const Mesh whole = hull_mesh(scene);
  // Two cameras close to the head, whose images end at the chest.
  synthetic::RigOptions close;
  close.cameras = 2;
  close.seed = 9;
  for (RigCamera camera : synthetic::ring_rig(close).cameras) {
    camera.id = "face-" + camera.id;
    camera.role = CameraRole::face;
    const Eigen::Vector3d center(camera.id.back() == '0' ? 0.25 : -0.25, 1.6, 1.0);
    const Eigen::Vector3d forward = (Eigen::Vector3d(0, 1.55, 0) - center).normalized();
    const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
    Eigen::Matrix3d rotation;
    rotation << right.transpose(), forward.cross(right).transpose(), forward.transpose();
    camera.camera_from_world.linear() = rotation;
    camera.camera_from_world.translation() = -rotation * center;
    scene.rig.cameras.push_back(camera);
    scene.silhouettes.push_back(synthetic::render_silhouette(scene.body, camera));
    const Image& coverage = scene.silhouettes.back().coverage;
    ASSERT_GE(coverage.at(coverage.width / 2, coverage.height - 1), 128) << "the chest leaves the image";
  }
  const Mesh mesh = hull_mesh(scene);
  EXPECT_TRUE(topology(mesh).closed_manifold());
  EXPECT_LT(deepest_cut_m(mesh, scene.body), unsure_m);
  EXPECT_LE(volume_m3(mesh), volume_m3(whole) + 1e-9);
  EXPECT_GT(volume_m3(mesh), 0.9 * volume_m3(whole));
}

TEST(VisualHull, TheSolidEndsAtTheFloor) {
  Scene scene = person_scene();
  const Mesh mesh = hull_mesh(scene);
  float lowest = 1;
  for (const Eigen::Vector3f& p : mesh.positions) lowest = std::min(lowest, p.y());
  EXPECT_NEAR(lowest, 0.0F, 1e-4F);
}

TEST(VisualHull, PointsThatTooFewCamerasSeeAreOutside) {
  // Four cameras look at the upper half only: with five views asked for, nothing of the lower half can stay.
  Scene scene = person_scene();
  for (size_t c = 0; c < 4; ++c) {
    RigCamera& camera = scene.rig.cameras[c];
    camera.intrinsics.height /= 2;
    scene.silhouettes[c] = synthetic::render_silhouette(scene.body, camera);
  }
  const auto height = [&](int min_views) {
    const Mesh mesh = hull_mesh(scene, {.voxel_m = 0.01, .min_views = min_views});
    EXPECT_TRUE(topology(mesh).closed_manifold());
    Eigen::AlignedBox3f box;
    for (const Eigen::Vector3f& p : mesh.positions) box.extend(p);
    return box.sizes().y();
  };
  EXPECT_GT(height(4), 1.7F);
  EXPECT_LT(height(5), 1.2F);
}

TEST(VisualHull, OnlyTheLargestPartStays) {
  // A ball that floats beside the person, smaller than it: discs in the silhouettes, a little larger than the ball.
  Scene scene = person_scene();
  const Eigen::Vector3d center(0.7, 1.6, 0.1);
  for (size_t c = 0; c < scene.silhouettes.size(); ++c) {
    const RigCamera& camera = scene.rig.cameras[c];
    const Eigen::Vector2d middle = project(camera, center).value();
    const double radius_px = 0.08 * camera.intrinsics.fx / (camera.camera_from_world * center).z();
    for (int y = 0; y < camera.intrinsics.height; ++y)
      for (int x = 0; x < camera.intrinsics.width; ++x)
        if ((Eigen::Vector2d(x, y) - middle).norm() < radius_px) scene.silhouettes[c].coverage.at(x, y) = 255;
  }
  const Mesh mesh = hull_mesh(scene);
  EXPECT_EQ(topology(mesh).components, 1U);
  for (const Eigen::Vector3f& p : mesh.positions) EXPECT_GT((p.cast<double>() - center).norm(), 0.12);
}

TEST(VisualHull, ACameraThatSeesNobodyIsNamedAndLeftOut) {
  Scene scene = person_scene();
  cut_off_below(scene.silhouettes[2], 0);
  const auto hull = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.02});
  ASSERT_TRUE(hull.ok());
  ASSERT_EQ(hull->warnings.size(), 1U);
  EXPECT_THAT(hull->warnings[0], HasSubstr(scene.silhouettes[2].camera));
  EXPECT_EQ(hull->cameras.size(), scene.silhouettes.size() - 1);
  EXPECT_LT(deepest_cut_m(extract_surface(hull->field), scene.body), unsure_m);
}

/// Blanks a square of a silhouette around a point of the world.
void blank_around(const Rig& rig, Silhouette& silhouette, const Eigen::Vector3d& p_world, int reach_px) {
  const Eigen::Vector2d middle = project(*rig.find(silhouette.camera), p_world).value();
  const int x = static_cast<int>(std::lround(middle.x())), y = static_cast<int>(std::lround(middle.y()));
  for (int dy = -reach_px; dy <= reach_px; ++dy)
    for (int dx = -reach_px; dx <= reach_px; ++dx)
      if (silhouette.coverage.contains(x + dx, y + dy)) silhouette.coverage.at(x + dx, y + dy) = 0;
}

TEST(VisualHull, OneSilhouetteWithoutAForearmIsOverruledAndNamed) {
  const auto joints = synthetic::person().joints;
  const auto hand = std::find_if(joints.begin(), joints.end(), [](const auto& j) { return j.first == "LeftHand"; });
  ASSERT_NE(hand, joints.end());
  Scene scene = person_scene();
  const double whole = volume_m3(hull_mesh(scene));
  blank_around(scene.rig, scene.silhouettes[0], hand->second, 7);
  const auto hull = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.01});
  ASSERT_TRUE(hull.ok());
  ASSERT_EQ(hull->warnings.size(), 1U);
  EXPECT_THAT(hull->warnings[0], HasSubstr(scene.silhouettes[0].camera));
  const Mesh mesh = extract_surface(hull->field);
  EXPECT_LT(deepest_cut_m(mesh, scene.body), unsure_m);
  EXPECT_LT(volume_m3(mesh), 1.03 * whole);
}

TEST(VisualHull, AHoleInOneSilhouetteMakesNoTunnel) {
  Scene scene = person_scene();
  for (const int reach_px : {0, 1}) {
    SCOPED_TRACE(reach_px);
    scene.silhouettes = person_scene().silhouettes;
    blank_around(scene.rig, scene.silhouettes[3], {0, 1.15, 0}, reach_px);
    const auto hull = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.01});
    ASSERT_TRUE(hull.ok());
    EXPECT_LT(deepest_cut_m(extract_surface(hull->field), scene.body), unsure_m);
  }
}

TEST(VisualHull, TrueSilhouettesGiveNoWarning) {
  Scene scene = person_scene();
  for (size_t cameras = 8; cameras >= 3; --cameras) {
    scene.silhouettes.resize(cameras);
    const auto hull = carve_visual_hull(scene.rig, scene.silhouettes, {.voxel_m = 0.02});
    ASSERT_TRUE(hull.ok());
    EXPECT_TRUE(hull->warnings.empty()) << cameras << " cameras: " << hull->warnings[0];
  }
}

TEST(VisualHull, RefusesWhatCannotWork) {
  const Scene& scene = person_scene();
  const auto code = [&](const std::vector<Silhouette>& silhouettes, const VisualHullOptions& options) {
    const auto hull = carve_visual_hull(scene.rig, silhouettes, options);
    return hull.ok() ? ErrorCode::internal : hull.error().code;
  };
  EXPECT_EQ(code({}, {}), ErrorCode::too_few_views);
  EXPECT_EQ(code({scene.silhouettes[0], scene.silhouettes[1]}, {}), ErrorCode::too_few_views);
  std::vector<Silhouette> strangers = scene.silhouettes;
  for (Silhouette& silhouette : strangers) silhouette.camera = "not-" + silhouette.camera;
  EXPECT_EQ(code(strangers, {}), ErrorCode::too_few_views);
  std::vector<Silhouette> empty = scene.silhouettes;
  for (Silhouette& silhouette : empty) cut_off_below(silhouette, 0);
  EXPECT_EQ(code(empty, {}), ErrorCode::no_subject);
  std::vector<Silhouette> disjoint = scene.silhouettes;
  for (size_t c = 0; c < disjoint.size(); ++c)
    for (int y = 0; y < disjoint[c].coverage.height; ++y)
      for (int x = 0; x < disjoint[c].coverage.width; ++x)
        disjoint[c].coverage.at(x, y) = (c == 0 ? y < 15 : y > 150) ? 255 : 0;
  EXPECT_EQ(code(disjoint, {.voxel_m = 0.02}), ErrorCode::no_subject);
  std::vector<Silhouette> twice = scene.silhouettes;
  twice.push_back(twice[0]);
  EXPECT_EQ(code(twice, {}), ErrorCode::invalid_argument);
  std::vector<Silhouette> small = scene.silhouettes;
  small[1].coverage = Image(10, 10, 1);
  EXPECT_EQ(code(small, {}), ErrorCode::invalid_argument);
  EXPECT_EQ(code(scene.silhouettes, {.voxel_m = 0}), ErrorCode::invalid_argument);
  EXPECT_EQ(code(scene.silhouettes, {.voxel_m = std::nan("")}), ErrorCode::invalid_argument);
  EXPECT_EQ(code(scene.silhouettes, {.voxel_m = 0.01, .min_views = 0}), ErrorCode::invalid_argument);
  Rig boundless = scene.rig;
  boundless.volume.max().setConstant(1e9);
  EXPECT_EQ(carve_visual_hull(boundless, scene.silhouettes, {}).error().code, ErrorCode::invalid_argument);
  Work stopped;
  std::stop_source source;
  source.request_stop();
  stopped.stop = source.get_token();
  EXPECT_EQ(carve_visual_hull(scene.rig, scene.silhouettes, {}, stopped).error().code, ErrorCode::cancelled);
}

}  // namespace
}  // namespace booth
