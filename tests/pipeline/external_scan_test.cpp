#include "pipeline/face/external_scan.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "pipeline/surface/marching_cubes.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/body.h"

namespace booth {
namespace {

using ::testing::HasSubstr;

/// A head with a nose, a chin and ears of different size, so that it fits itself in one way only.
struct Scene {
  synthetic::Body body;
  Mesh hull;
  HeadRegion head;
  Mesh face;  ///< what lies ahead of the head's middle, in its place

  Scene() {
    const Eigen::Vector3d middle(0, 1.62, 0);
    const auto ball = [&](double x, double y, double z, double r) {
      const Eigen::Vector3d at = middle + Eigen::Vector3d(x, y, z);
      body.push_back({at, at, r, r});
    };
    ball(0, 0.02, 0, 0.09);
    ball(0, -0.02, 0.02, 0.08);
    body.push_back({middle + Eigen::Vector3d(0, 0.03, 0.09), middle + Eigen::Vector3d(0, -0.02, 0.115), 0.008, 0.014});
    ball(0, -0.085, 0.07, 0.025);
    ball(0.09, 0, -0.01, 0.03);
    ball(-0.09, 0.01, -0.01, 0.024);
    ball(0.035, 0.04, 0.075, 0.018);
    ball(-0.035, 0.04, 0.075, 0.014);
    body.push_back({middle - Eigen::Vector3d(0, 0.25, 0), middle, 0.055, 0.055});
    body.push_back({{0, 0, 0}, middle - Eigen::Vector3d(0, 0.3, 0), 0.15, 0.15});
    hull = extract_surface(synthetic::sample_field(body, 0.005));
    head = *find_head(hull);
    const Mesh fine = extract_surface(synthetic::sample_field(body, 0.003));
    face.positions = fine.positions;
    for (const auto& t : fine.triangles) {
      const Eigen::Vector3f& p = fine.positions[t[0]];
      if (p.z() > 0.02F && p.y() > 1.52F) face.triangles.push_back(t);
    }
    // Only the vertices that are used.
    std::vector<uint32_t> renamed(fine.positions.size(), 0);
    Mesh used;
    for (auto& t : face.triangles)
      for (uint32_t& v : t) {
        if (renamed[v] == 0) {
          used.positions.push_back(fine.positions[v]);
          renamed[v] = static_cast<uint32_t>(used.positions.size());
        }
        v = renamed[v] - 1;
      }
    face.positions = used.positions;
  }
};
const Scene& scene() {
  static const Scene made;
  return made;
}

Mesh moved(const Mesh& mesh, const Eigen::Isometry3f& by, float scale = 1) {
  Mesh out = mesh;
  for (Eigen::Vector3f& p : out.positions) p = scale * (by * p);
  return out;
}

double worst(const RangeScan& scan) {
  std::vector<double> off;
  for (size_t i = 0; i < scan.points.size(); ++i)
    if (scan.measured(i))
      off.push_back(std::abs(synthetic::signed_distance(scene().body, scan.points[i].cast<double>())));
  std::sort(off.begin(), off.end());
  return off.size() < 1000 ? 1 : off[off.size() * 98 / 100];
}

TEST(PlaceExternalScan, LeavesWhatIsInPlace) {
  const auto placed = place_external_scan(scene().face, scene().hull, scene().head);
  ASSERT_TRUE(placed.ok()) << placed.error().message;
  EXPECT_TRUE(placed->in_place);
  EXPECT_TRUE(placed->world_from_scan.isApprox(Eigen::Isometry3d::Identity()));
  EXPECT_GT(placed->eye.z(), 0.5F);
  EXPECT_LT(worst(placed->scan), 0.0015);
}

TEST(PlaceExternalScan, BringsItBackFromAnywhere) {
  ThreadPool pool;
  Eigen::Isometry3f away = Eigen::Isometry3f::Identity();
  for (const Eigen::Vector3f& axis : {Eigen::Vector3f(0.2F, 1, 0.1F), Eigen::Vector3f(1, -0.3F, 0.5F)}) {
    away = Eigen::AngleAxisf(2.1F, axis.normalized()) * away;
    away.pretranslate(Eigen::Vector3f(3, -1, 0.4F));
    const auto placed = place_external_scan(moved(scene().face, away, 1000), scene().hull, scene().head, pool.work());
    ASSERT_TRUE(placed.ok()) << placed.error().message;
    EXPECT_FALSE(placed->in_place);
    EXPECT_EQ(placed->metres_per_unit, 0.001);
    const Eigen::Isometry3d round = placed->world_from_scan * away.cast<double>();
    const Eigen::Vector3d nose(0, 1.6, 0.12);
    EXPECT_LT((round * nose - nose).norm(), 0.003);
    EXPECT_LT(worst(placed->scan), 0.003);
  }
}

TEST(PlaceExternalScan, TakesACloud) {
  Mesh cloud = scene().face;
  cloud.triangles.clear();
  const auto placed = place_external_scan(cloud, scene().hull, scene().head);
  ASSERT_TRUE(placed.ok()) << placed.error().message;
  EXPECT_LT(worst(placed->scan), 0.0015);
}

TEST(PlaceExternalScan, RefusesWhatIsNoFaceOfTheSubject) {
  const auto reason = [](const Mesh& scan) {
    const auto placed = place_external_scan(scan, scene().hull, scene().head);
    return placed.ok() ? std::string() : placed.error().message;
  };
  EXPECT_THAT(reason({}), HasSubstr("points"));
  EXPECT_THAT(reason(moved(scene().face, Eigen::Isometry3f::Identity(), 10)), HasSubstr("neither in metres"));
  // A flat board of a face's size.
  Mesh board;
  for (int y = 0; y < 50; ++y)
    for (int x = 0; x < 50; ++x)
      board.positions.emplace_back(5 + 0.008F * static_cast<float>(x), 0.008F * static_cast<float>(y), 0);
  EXPECT_THAT(reason(board), HasSubstr("fit"));
}

}  // namespace
}  // namespace booth
