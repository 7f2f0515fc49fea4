#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <functional>
#include <limits>
#include <memory>
#include <numbers>
#include <set>
#include <string>
#include <vector>

#include "pipeline/types/avatar.h"
#include "pipeline/types/field.h"
#include "pipeline/types/image.h"
#include "pipeline/types/mesh.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"
#include "pipeline/types/work.h"
#include "tests/synthetic/avatar.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

using testing::HasSubstr;

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float nan = std::numeric_limits<float>::quiet_NaN();

Mesh tetrahedron() {
  return {{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}}};
}

/// Two tetrahedra, the second one's vertices renamed by `vertex` so that they share some.
Mesh two_tetrahedra(const std::array<uint32_t, 4>& vertex) {
  Mesh mesh = tetrahedron();
  mesh.positions.insert(mesh.positions.end(), {{3, 0, 0}, {4, 0, 0}, {3, 1, 0}, {3, 0, 1}});
  for (const auto& [a, b, c] : tetrahedron().triangles) mesh.triangles.push_back({vertex[a], vertex[b], vertex[c]});
  return mesh;
}

// ---- results --------------------------------------------------------------------------------------------------------

TEST(Result, HoldsAValueOrAnError) {
  const Result<int> good = 3, bad = Error{ErrorCode::timeout, "too late"};
  EXPECT_TRUE(good.ok());
  EXPECT_EQ(*good, 3);
  EXPECT_THROW(static_cast<void>(good.error()), std::logic_error);
  EXPECT_FALSE(bad.ok());
  EXPECT_EQ(bad.error().code, ErrorCode::timeout);
  EXPECT_THROW(static_cast<void>(*bad), std::logic_error);
}

TEST(Result, MovesItsValueOut) {
  Result<std::unique_ptr<int>> result = std::make_unique<int>(5);
  const std::unique_ptr<int> taken = *std::move(result);
  EXPECT_EQ(*taken, 5);
}

TEST(Result, EveryCodeHasANameOfItsOwn) {
  std::set<std::string_view> names;
  for (int code = 0; code <= static_cast<int>(ErrorCode::internal); ++code)
    EXPECT_TRUE(names.insert(to_string(static_cast<ErrorCode>(code))).second) << code;
}

// ---- work -----------------------------------------------------------------------------------------------------------

TEST(Work, WithoutThreadsCoversEveryIndexInPiecesOfTheGrain) {
  std::vector<std::pair<size_t, size_t>> pieces;
  Work{}.parallel_for(10, 4, [&](size_t begin, size_t end) { pieces.emplace_back(begin, end); });
  EXPECT_THAT(pieces, testing::ElementsAre(std::pair(0, 4), std::pair(4, 8), std::pair(8, 10)));
}

TEST(Work, NothingToDoCallsNobody) {
  Work{}.parallel_for(0, 4, [](size_t, size_t) { FAIL(); });
}

// ---- topology -------------------------------------------------------------------------------------------------------

TEST(Topology, OfATetrahedron) {
  const MeshTopology found = topology(tetrahedron());
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.unreferenced_vertices, 0U);
  EXPECT_EQ(found.components, 1U);
  EXPECT_EQ(found.euler_number, 2);
  EXPECT_NEAR(found.signed_volume_m3, 1.0 / 6, 1e-12);
}

TEST(Topology, TurnedInsideOutHasNegativeVolume) {
  Mesh mesh = tetrahedron();
  for (auto& triangle : mesh.triangles) std::swap(triangle[0], triangle[1]);
  const MeshTopology found = topology(mesh);
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_NEAR(found.signed_volume_m3, -1.0 / 6, 1e-12);
}

TEST(Topology, AMissingTriangleOpensThreeEdges) {
  Mesh mesh = tetrahedron();
  mesh.triangles.pop_back();
  const MeshTopology found = topology(mesh);
  EXPECT_EQ(found.boundary_edges, 3U);
  EXPECT_FALSE(found.closed_manifold());
  EXPECT_EQ(found.euler_number, 1);
}

TEST(Topology, AFlippedTriangleMakesThreeEdgesInconsistent) {
  Mesh mesh = tetrahedron();
  std::swap(mesh.triangles[0][0], mesh.triangles[0][1]);
  const MeshTopology found = topology(mesh);
  EXPECT_EQ(found.inconsistent_edges, 3U);
  EXPECT_EQ(found.boundary_edges, 0U);
}

TEST(Topology, ApartTheyAreTwoComponents) {
  const MeshTopology found = topology(two_tetrahedra({4, 5, 6, 7}));
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 2U);
  EXPECT_EQ(found.euler_number, 4);
}

TEST(Topology, ASharedVertexHasTwoFans) {
  const MeshTopology found = topology(two_tetrahedra({3, 5, 6, 7}));
  EXPECT_EQ(found.nonmanifold_vertices, 1U);
  EXPECT_EQ(found.nonmanifold_edges, 0U);
  EXPECT_EQ(found.unreferenced_vertices, 1U);
  EXPECT_FALSE(found.closed_manifold());
}

TEST(Topology, ASharedEdgeHasFourTriangles) {
  const MeshTopology found = topology(two_tetrahedra({3, 2, 6, 7}));
  EXPECT_EQ(found.nonmanifold_edges, 1U);
  EXPECT_EQ(found.components, 1U);
  EXPECT_FALSE(found.closed_manifold());
}

TEST(Topology, OfNothing) {
  const MeshTopology found = topology({});
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 0U);
  EXPECT_EQ(found.euler_number, 0);
}

// ---- mesh -----------------------------------------------------------------------------------------------------------

TEST(CheckMesh, AcceptsATetrahedronAndNothing) {
  EXPECT_TRUE(check(tetrahedron()));
  EXPECT_TRUE(check(Mesh{}));
}

TEST(CheckMesh, NamesWhatIsWrong) {
  Mesh mesh = tetrahedron();
  mesh.positions[2].y() = nan;
  EXPECT_THAT(check(mesh).error().message, HasSubstr("vertex 2"));
  mesh = tetrahedron();
  mesh.triangles[1][2] = 4;
  EXPECT_THAT(check(mesh).error().message, HasSubstr("triangle 1"));
  mesh = tetrahedron();
  mesh.triangles[3] = {1, 2, 1};
  EXPECT_THAT(check(mesh).error().message, HasSubstr("triangle 3"));
}

TEST(VertexNormals, PointOutwardsWithUnitLength) {
  Mesh mesh = tetrahedron();
  mesh.positions.emplace_back(9, 9, 9);  // without triangles
  const auto normals = vertex_normals(mesh);
  const Eigen::Vector3f center(0.25F, 0.25F, 0.25F);
  for (size_t v = 0; v < 4; ++v) {
    EXPECT_NEAR(normals[v].norm(), 1, 1e-6);
    EXPECT_GT(normals[v].dot(mesh.positions[v] - center), 0);
  }
  EXPECT_EQ(normals[4], Eigen::Vector3f::Zero());
}

// ---- field ----------------------------------------------------------------------------------------------------------

TEST(Field, StartsOutsideAndKeepsWhatIsStored) {
  Field field({.origin = {1, 2, 3}, .voxel_m = 0.5, .size = {17, 8, 9}});
  EXPECT_THAT(field.bricks(), testing::ElementsAre(3, 1, 2));
  EXPECT_EQ(field.at(16, 7, 8), 1.0F);
  field.allocate_blocks(2);
  field.set_brick(field.brick_index(2, 0, 1), 1);
  field.set_brick(field.brick_index(0, 0, 0), Field::all_inside);
  field.block(1)[0] = -0.25F;
  EXPECT_EQ(field.at(16, 0, 8), -0.25F);
  EXPECT_EQ(field.at(16, 1, 8), 1.0F) << "stored samples start outside";
  EXPECT_EQ(field.at(7, 7, 7), -1.0F);
  EXPECT_EQ(field.at(8, 0, 0), 1.0F);
  EXPECT_EQ(field.blocks(), 2U);
  EXPECT_EQ(field.grid().point(2, 0, 4), Eigen::Vector3d(2, 2, 5));
}

TEST(Field, AgreesWithTheDistanceItWasSampledFrom) {
  const synthetic::Body body = synthetic::sphere(0.2);
  const Field field = synthetic::sample_field(body, 0.05);
  const auto [nx, ny, nz] = field.grid().size;
  for (int k = 0; k < nz; ++k)
    for (int j = 0; j < ny; ++j)
      for (int i = 0; i < nx; ++i)
        ASSERT_NEAR(field.at(i, j, k), synthetic::signed_distance(body, field.grid().point(i, j, k)), 1e-6);
}

// ---- rig and shots --------------------------------------------------------------------------------------------------

TEST(CheckRig, AcceptsARing) { EXPECT_TRUE(check(synthetic::ring_rig())); }

struct RigFault {
  const char* named;
  std::function<void(Rig&)> make;
};

class CheckRigFaults : public testing::TestWithParam<RigFault> {};

TEST_P(CheckRigFaults, AreNamed) {
  Rig rig = synthetic::ring_rig();
  GetParam().make(rig);
  const auto checked = check(rig);
  ASSERT_FALSE(checked);
  EXPECT_EQ(checked.error().code, ErrorCode::invalid_argument);
  EXPECT_THAT(checked.error().message, HasSubstr(GetParam().named));
}

INSTANTIATE_TEST_SUITE_P(
    Rig, CheckRigFaults,
    testing::Values(
        RigFault{"cameras", [](Rig& rig) { rig.cameras.clear(); }},
        RigFault{"volume", [](Rig& rig) { rig.volume = Eigen::AlignedBox3d(); }},
        RigFault{"volume", [](Rig& rig) { rig.volume.max().y() = std::numeric_limits<double>::infinity(); }},
        RigFault{"twice", [](Rig& rig) { rig.cameras[3].id = rig.cameras[2].id; }},
        RigFault{"cameras[1]", [](Rig& rig) { rig.cameras[1].id = "../../etc"; }},
        RigFault{"width", [](Rig& rig) { rig.cameras[0].intrinsics.width = 0; }},
        RigFault{"width", [](Rig& rig) { rig.cameras[0].intrinsics.height = 40000; }},
        RigFault{"focal", [](Rig& rig) { rig.cameras[0].intrinsics.fy = -1000; }},
        RigFault{"K ", [](Rig& rig) { rig.cameras[0].intrinsics.cx = static_cast<double>(nan); }},
        RigFault{"distortion", [](Rig& rig) { rig.cameras[0].intrinsics.distortion[4] = static_cast<double>(nan); }},
        RigFault{"rotation", [](Rig& rig) { rig.cameras[0].camera_from_world.linear() *= 1.01; }},
        RigFault{"rotation", [](Rig& rig) { rig.cameras[0].camera_from_world.linear().row(0) *= -1; }},
        RigFault{"R or t",
                 [](Rig& rig) { rig.cameras[0].camera_from_world.translation().z() = static_cast<double>(infinity); }},
        RigFault{"mount_rotation_deg", [](Rig& rig) { rig.cameras[0].mount_rotation_deg = 45; }},
        RigFault{"projector", [](Rig& rig) { rig.projector = CalibratedView{}; }}));

TEST(Rig, FindsCamerasById) {
  const Rig rig = synthetic::ring_rig();
  EXPECT_EQ(rig.find("body-03"), &rig.cameras[3]);
  EXPECT_EQ(rig.find("body-99"), nullptr);
}

TEST(CalibratedView, CenterIsTheWorldPointAtTheCamerasOrigin) {
  for (const RigCamera& camera : synthetic::ring_rig().cameras)
    EXPECT_LT((camera.camera_from_world * camera.center()).norm(), 1e-12);
}

TEST(SafeId, IsAFileNameAndNothingElse) {
  for (const char* id : {"body-00", "a", "A.b_c-9", "2026-11-22T10-15-00Z-7f3a"}) EXPECT_TRUE(is_safe_id(id)) << id;
  for (const std::string& id : {std::string(), std::string(".."), std::string(".hidden"), std::string("a/b"),
                                std::string("a b"), std::string("ä"), std::string("a\0b", 3), std::string(65, 'a')})
    EXPECT_FALSE(is_safe_id(id)) << id;
}

TEST(ShotRole, NamesComeBack) {
  for (const ShotRole role : {ShotRole::background, ShotRole::body, ShotRole::gray_code, ShotRole::calibration_board})
    EXPECT_EQ(shot_role_from(to_string(role)), role);
  EXPECT_EQ(shot_role_from("Body"), std::nullopt);
}

TEST(GrayCode, CountsItsImages) {
  EXPECT_EQ(pattern_count({.width = 1024, .height = 768}), 42);
  EXPECT_EQ(pattern_count({.width = 1024, .height = 768, .inverse = false}), 22);
  EXPECT_EQ(pattern_count({.width = 1024, .height = 768, .rows = false}), 22);
  EXPECT_EQ(pattern_count({.width = 1025, .height = 768, .rows = false}), 24);
  EXPECT_EQ(pattern_count({.width = 1, .height = 1}), 2);
}

// ---- avatar ---------------------------------------------------------------------------------------------------------

TEST(Skeleton, JointsFollowTheirParents) {
  Skeleton skeleton;
  const Eigen::Isometry3d quarter(Eigen::AngleAxisd(std::numbers::pi / 2, Eigen::Vector3d::UnitZ()));
  skeleton.joints = {{"Hips", -1, Eigen::Translation3d(0, 1, 0) * quarter},
                     {"Spine", 0, Eigen::Isometry3d(Eigen::Translation3d(0.5, 0, 0))},
                     {"Head", 1, Eigen::Isometry3d(Eigen::Translation3d(0.25, 0, 0))}};
  ASSERT_TRUE(check(skeleton));
  const auto world = world_from_joints(skeleton);
  EXPECT_TRUE(world[2].translation().isApprox(Eigen::Vector3d(0, 1.75, 0), 1e-12));
  EXPECT_TRUE((world[2] * Eigen::Vector3d::UnitX()).isApprox(Eigen::Vector3d(0, 2.75, 0), 1e-12));
  EXPECT_EQ(skeleton.find("Head"), 2);
  EXPECT_EQ(skeleton.find("Tail"), -1);
}

TEST(CheckSkeleton, RefusesWhatIsNoTree) {
  const Skeleton good = synthetic::make_avatar(synthetic::person()).skeleton;
  ASSERT_TRUE(check(good));
  const auto refused = [&](const std::function<void(Skeleton&)>& spoil) {
    Skeleton skeleton = good;
    spoil(skeleton);
    return !check(skeleton).ok();
  };
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[0].parent = 0; }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].parent = -1; })) << "a second root";
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].parent = 2; }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].parent = 5; }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].name = s.joints[1].name; }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].name.clear(); }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].parent_from_joint.linear() *= 2; }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].parent_from_joint.linear().col(0) *= -1; }));
  EXPECT_TRUE(refused([](Skeleton& s) { s.joints[2].parent_from_joint.translation().x() = std::nan(""); }));
}

TEST(CheckSkin, RefusesWeightsThatAreNone) {
  const auto checked = [](const JointInfluences& influences) { return check(Skin{{influences}}, 1, 3).ok(); };
  EXPECT_TRUE(checked({{1, 0, 0, 0}, {1, 0, 0, 0}}));
  EXPECT_TRUE(checked({{1, 2, 0, 0}, {0.5F, 0.3F, 0.2F, 0}}));
  EXPECT_FALSE(checked({{1, 0, 0, 0}, {0.9F, 0, 0, 0}})) << "sum";
  EXPECT_FALSE(checked({{1, 2, 0, 0}, {1.5F, -0.5F, 0, 0}})) << "range";
  EXPECT_FALSE(checked({{1, 2, 0, 0}, {0.3F, 0.7F, 0, 0}})) << "order";
  EXPECT_FALSE(checked({{3, 0, 0, 0}, {1, 0, 0, 0}})) << "joint that is not there";
  EXPECT_FALSE(checked({{1, 1, 0, 0}, {0.5F, 0.5F, 0, 0}})) << "repeated joint";
  EXPECT_FALSE(checked({{1, 0, 0, 0}, {nan, 0, 0, 0}}));
  EXPECT_FALSE(check(Skin{}, 1, 3).ok()) << "too few";
}

TEST(CheckAvatar, AcceptsRiggedAndUnrigged) {
  EXPECT_TRUE(check(synthetic::make_avatar(synthetic::person())));
  EXPECT_TRUE(check(synthetic::make_avatar(synthetic::person(), {.rigged = false})));
}

TEST(CheckAvatar, RefusesPartsThatDoNotFit) {
  const Avatar good = synthetic::make_avatar(synthetic::person());
  const auto message = [&](const std::function<void(Avatar&)>& spoil) {
    Avatar avatar = good;
    spoil(avatar);
    const auto checked = check(avatar);
    return checked ? std::string() : checked.error().message;
  };
  EXPECT_THAT(message([](Avatar& a) { a.mesh.triangles[7][0] = 1'000'000; }), HasSubstr("triangle 7"));
  EXPECT_THAT(message([](Avatar& a) { a.atlas.uv.pop_back(); }), HasSubstr("atlas"));
  EXPECT_THAT(message([](Avatar& a) { a.atlas.uv[5][1].x() = 1.01F; }), HasSubstr("triangle 5"));
  EXPECT_THAT(message([](Avatar& a) { a.atlas.uv[5][1].y() = nan; }), HasSubstr("triangle 5"));
  EXPECT_THAT(message([](Avatar& a) { a.atlas.image = Image(4, 4, 1); }), HasSubstr("atlas"));
  EXPECT_THAT(message([](Avatar& a) { a.skin.influences.pop_back(); }), HasSubstr("skin"));
  EXPECT_THAT(message([](Avatar& a) { a.skeleton.joints.clear(); }), HasSubstr("skin"));
}

TEST(SyntheticAvatar, IsClosedAndFacesOutwards) {
  const MeshTopology found = topology(synthetic::make_avatar(synthetic::person()).mesh);
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.unreferenced_vertices, 0U);
  EXPECT_EQ(found.euler_number, 2 * static_cast<long>(found.components));
  EXPECT_GT(found.signed_volume_m3, 0.05);
}

}  // namespace
}  // namespace booth
