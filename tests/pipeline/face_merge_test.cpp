#include "pipeline/face/face_merge.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "pipeline/face/field_fusion.h"
#include "pipeline/face/subdivision.h"
#include "pipeline/geometry/solid_parts.h"
#include "pipeline/surface/decimation.h"
#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

/// A person whose hull is too fat in the face: the scan lies inside it.
struct Scene {
  synthetic::Person person = synthetic::person();
  Field hull;
  ScanMesh scan;
  Eigen::Vector3f eye;
  HeadRegion head;
  Eigen::Vector3d dent;  ///< centre of a ball that is missing

  Scene() {
    hull = synthetic::sample_field(person.body, 0.005);
    const Mesh mesh = extract_surface(hull);
    head = *find_head(mesh);
    eye = Eigen::Vector3f(0, head.barycentre.y() - 0.1F, 1.0F);
    dent = Eigen::Vector3d(0, head.barycentre.y(), 1);
    while (synthetic::signed_distance(person.body, dent) > 0.015) dent.z() -= 0.001;
    RangeScan range(160, 160);
    for (int y = 0; y < range.height; ++y)
      for (int x = 0; x < range.width; ++x) {
        const Eigen::Vector3d through(0.0015 * (x - 80), static_cast<double>(head.barycentre.y()) + 0.0015 * (80 - y),
                                      0);
        const Eigen::Vector3d way = (through - eye.cast<double>()).normalized();
        Eigen::Vector3d p = eye.cast<double>();
        for (int i = 0; i < 80; ++i) p += way * true_distance(p);
        if (std::abs(true_distance(p)) > 1e-5) continue;
        range.points[range.index(x, y)] = p.cast<float>();
        range.sigma_m[range.index(x, y)] = 1e-4F;
      }
    scan = *mesh_scan(range);
  }
  /// The person with a dent in the face that no silhouette shows.
  double true_distance(const Eigen::Vector3d& p) const {
    return std::max(synthetic::signed_distance(person.body, p), 0.03 - (p - dent).norm());
  }
};
const Scene& scene() {
  static const Scene made;
  return made;
}

Mesh fused(const Field& hull = scene().hull) {
  Field field = fuse_scan(hull, scene().head, scene().scan, scene().eye);
  keep_largest_part(field);
  return extract_surface(field);
}

/// Of the vertices that lie well inside the scan's reach, the largest distance from the true surface.
double worst_on_face(const Mesh& mesh) {
  double worst = 0;
  for (const Eigen::Vector3f& p : mesh.positions)
    if (std::abs(p.x()) < 0.03F && std::abs(p.y() - scene().head.barycentre.y()) < 0.03F && p.z() > 0.02F)
      worst = std::max(worst, std::abs(scene().true_distance(p.cast<double>())));
  return worst;
}

TEST(FindHead, IsBetweenNeckAndCrown) {
  const auto& joints = scene().person.joints;
  const auto joint = [&](const std::string& name) {
    return std::find_if(joints.begin(), joints.end(), [&](const auto& j) { return j.first == name; })->second;
  };
  EXPECT_NEAR(scene().head.crown_y, 1.75, 0.03);
  EXPECT_LT(scene().head.neck_y, joint("Head").y() + 0.05);
  EXPECT_GT(scene().head.neck_y, joint("Neck").y() - 0.06);
  EXPECT_FALSE(find_head({}).has_value());
}

TEST(FuseScan, CutsTheHullDownToTheScan) {
  EXPECT_GT(worst_on_face(extract_surface(scene().hull)), 0.008);
  const Mesh mesh = fused();
  EXPECT_LT(worst_on_face(mesh), 0.004);
  const MeshTopology found = topology(mesh);
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 1U);
}

TEST(FuseScan, FillsWhereASilhouetteCutTooDeep) {
  // A groove of one finger's width through the cheek.
  Field grooved = scene().hull;
  synthetic::Body groove{{Eigen::Vector3d(-0.05, scene().head.barycentre.y() - 0.05F, 0.15),
                          Eigen::Vector3d(0.05, scene().head.barycentre.y() - 0.05F, 0.15), 0.05, 0.05}};
  size_t cut = 0;
  const Grid& grid = grooved.grid();
  for (int k = 0; k < grid.size[2]; ++k)
    for (int j = 0; j < grid.size[1]; ++j)
      for (int i = 0; i < grid.size[0]; ++i) {
        const size_t brick = grooved.brick_index(i / 8, j / 8, k / 8);
        if (grooved.brick(brick) < 0) continue;
        float& sample = grooved.block(grooved.brick(brick))[((k % 8) * 8 + j % 8) * 8 + i % 8];
        const float outside = -static_cast<float>(synthetic::signed_distance(groove, grid.point(i, j, k)));
        if (outside > sample && outside < 0.01F) {
          sample = outside;
          ++cut;
        }
      }
  ASSERT_GT(cut, 0U);
  const Mesh mesh = fused(grooved);
  EXPECT_LT(worst_on_face(mesh), 0.004);
}

TEST(MeshScan, DropsWhatIsNarrow) {
  // A square of points a millimetre apart, with a strip of two points' width at its side.
  constexpr int side = 40, reach = 20, strip = 2;
  RangeScan scan(side + reach, side);
  for (int y = 0; y < side; ++y)
    for (int x = 0; x < side + reach; ++x) {
      if (x >= side && (y < side / 2 || y >= side / 2 + strip)) continue;
      scan.points[scan.index(x, y)] = {0.001F * static_cast<float>(x), 0.001F * static_cast<float>(y), 0};
      scan.sigma_m[scan.index(x, y)] = 1e-4F;
    }
  const auto farthest = [](const ScanMesh& mesh) {
    float most = 0;
    for (const auto& t : mesh.mesh.triangles)
      for (const uint32_t v : t) most = std::max(most, mesh.mesh.positions[v].x());
    return most;
  };
  const auto dropped = mesh_scan(scan, {.smoothing_radius = 0}),
             kept = mesh_scan(scan, {.narrowest = 0, .smoothing_radius = 0});
  ASSERT_TRUE(dropped.ok() && kept.ok());
  EXPECT_NEAR(farthest(*dropped), 0.039, 0.0015);
  EXPECT_NEAR(farthest(*kept), 0.059, 0.0005);
}

TEST(MergeFace, FollowsTheScanAndStaysClosed) {
  const auto merged = merge_face(fused(), scene().head, scene().scan, scene().eye);
  ASSERT_TRUE(merged.ok()) << merged.error().message;
  EXPECT_LT(worst_on_face(merged->mesh), 0.0012);
  const MeshTopology found = topology(merged->mesh);
  EXPECT_TRUE(found.closed_manifold());
  EXPECT_EQ(found.components, 1U);
  EXPECT_EQ(found.euler_number, 2);
  EXPECT_GT(merged->moved_m2, 0.005);
  ASSERT_EQ(merged->face.size(), merged->mesh.positions.size());
}

TEST(MergeFace, FollowsTheScanRadially) {
  const auto merged = merge_face(extract_surface(scene().hull), scene().head, scene().scan, scene().eye,
                                 {.method = FaceMergeMethod::radial});
  ASSERT_TRUE(merged.ok()) << merged.error().message;
  EXPECT_LT(worst_on_face(merged->mesh), 0.002);
  EXPECT_TRUE(topology(merged->mesh).closed_manifold());
  EXPECT_EQ(topology(merged->mesh).components, 1U);
}

TEST(MergeFace, LeavesTheRestOfTheBodyInPlace) {
  const Mesh hull = fused();
  const auto merged = merge_face(hull, scene().head, scene().scan, scene().eye);
  ASSERT_TRUE(merged.ok());
  for (size_t v = 0; v < hull.positions.size(); ++v)
    if (merged->face[v] == 0) {
      ASSERT_EQ(merged->mesh.positions[v], hull.positions[v]);
    }
  for (size_t v = 0; v < merged->face.size(); ++v)
    if (merged->face[v] != 0) {
      ASSERT_GT(merged->mesh.positions[v].y(), scene().head.neck_y - 0.1F);
    }
}

TEST(MergeFace, BendsWithoutACrease) {
  // Normals of neighbouring triangles around the scan's rim turn no more than on the body itself and a little.
  const auto merged = merge_face(fused(), scene().head, scene().scan, scene().eye);
  ASSERT_TRUE(merged.ok());
  const std::vector<Eigen::Vector3f> normals = vertex_normals(merged->mesh);
  std::vector<double> turns;
  for (const auto& t : merged->mesh.triangles) {
    if (merged->face[t[0]] == 0 || merged->mesh.positions[t[0]].z() < 0) continue;
    const double cosine = static_cast<double>(normals[t[0]].dot(normals[t[1]]));
    turns.push_back(std::acos(std::clamp(cosine, -1.0, 1.0)) * 180 / 3.14159265358979);
  }
  std::sort(turns.begin(), turns.end());
  EXPECT_LT(turns[turns.size() * 95 / 100], 12);
}

TEST(MergeFace, RefusesAScanThatIsElsewhere) {
  ScanMesh away = scene().scan;
  for (Eigen::Vector3f& p : away.mesh.positions) p.x() += 1;
  EXPECT_EQ(merge_face(fused(), scene().head, away, scene().eye).error().code, ErrorCode::no_subject);
  EXPECT_FALSE(merge_face(fused(), scene().head, {}, scene().eye).ok());
}

TEST(MergeFace, DoesNotDependOnThreads) {
  ThreadPool pool(4);
  const auto a = merge_face(fused(), scene().head, scene().scan, scene().eye);
  const auto b = merge_face(fused(), scene().head, scene().scan, scene().eye, {}, pool.work());
  ASSERT_TRUE(a.ok() && b.ok());
  EXPECT_EQ(a->mesh.positions, b->mesh.positions);
  EXPECT_EQ(a->mesh.triangles, b->mesh.triangles);
}

TEST(Subdivide, KeepsAMeshClosedAndOldVerticesInPlace) {
  const Mesh mesh = extract_surface(synthetic::sample_field(synthetic::sphere(0.1), 0.02));
  std::vector<uint8_t> marked(mesh.triangles.size(), 0);
  for (size_t t = 0; t < marked.size(); t += 3) marked[t] = 1;
  for (const SubdivisionRule rule : {SubdivisionRule::midpoint, SubdivisionRule::butterfly}) {
    const Subdivision fine = subdivide(mesh, marked, rule);
    EXPECT_TRUE(topology(fine.mesh).closed_manifold());
    EXPECT_EQ(topology(fine.mesh).euler_number, 2);
    EXPECT_EQ(fine.refined.size(), fine.mesh.triangles.size());
    for (size_t v = 0; v < mesh.positions.size(); ++v) ASSERT_EQ(fine.mesh.positions[v], mesh.positions[v]);
  }
}

TEST(Subdivide, ButterflyComesCloserToASphereThanMiddles) {
  const Mesh mesh = extract_surface(synthetic::sample_field(synthetic::sphere(0.1), 0.02));
  const std::vector<uint8_t> all(mesh.triangles.size(), 1);
  const auto error = [&](SubdivisionRule rule) {
    double sum = 0;
    const Mesh fine = subdivide(mesh, all, rule).mesh;
    for (const Eigen::Vector3f& p : fine.positions)
      sum += std::abs(synthetic::signed_distance(synthetic::sphere(0.1), p.cast<double>()));
    return sum / static_cast<double>(fine.positions.size());
  };
  EXPECT_LT(error(SubdivisionRule::butterfly), 0.6 * error(SubdivisionRule::midpoint));
}

TEST(Decimate, GivesTheDetailItsShare) {
  const auto merged = merge_face(fused(), scene().head, scene().scan, scene().eye);
  ASSERT_TRUE(merged.ok());
  const Mesh plain = decimate(merged->mesh, {.triangles = 6000});
  const Mesh shared = decimate(merged->mesh, merged->face, 0.4, {.triangles = 6000});
  EXPECT_LE(shared.triangles.size(), 6000U);
  EXPECT_GE(shared.triangles.size() + 2, 6000U);
  EXPECT_TRUE(topology(shared).closed_manifold());
  const auto on_face = [&](const Mesh& mesh) {
    return std::count_if(mesh.triangles.begin(), mesh.triangles.end(), [&](const auto& t) {
      const Eigen::Vector3f& p = mesh.positions[t[0]];
      return p.z() > 0 && (p - scene().head.barycentre).norm() < 0.2F;
    });
  };
  EXPECT_GT(on_face(shared), 1500);
  EXPECT_GT(on_face(shared), on_face(plain));
}

}  // namespace
}  // namespace booth
