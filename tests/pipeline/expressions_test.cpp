#include "pipeline/face/expressions.h"

#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <algorithm>

namespace booth {
namespace {

class Expressions : public testing::Test {
 protected:
  static void SetUpTestSuite() { neutral_ = new NeutralHead(*parse_neutral_head(built_in_neutral_head())); }
  static void TearDownTestSuite() { delete neutral_; }

  /// The neutral head turned and scaled along its axes.
  static FittedHead head(const Eigen::Matrix3f& linear) {
    FittedHead head;
    head.mesh = neutral_->mesh;
    for (Eigen::Vector3f& p : head.mesh.positions) p = linear * p + Eigen::Vector3f(0.1F, 1.5F, 0.2F);
    head.face = neutral_->face_front;
    head.bare.assign(head.face.begin(), head.face.end());
    head.rotation = Eigen::Matrix3d::Identity();
    return head;
  }
  static const Expression& expression(const std::string& name) {
    return *std::find_if(neutral_->expressions.begin(), neutral_->expressions.end(),
                         [&](const Expression& e) { return e.name == name; });
  }
  static const MorphTarget& morph(const std::vector<MorphTarget>& morphs, const std::string& name) {
    return *std::find_if(morphs.begin(), morphs.end(), [&](const MorphTarget& m) { return m.name == name; });
  }

  static NeutralHead* neutral_;
};
NeutralHead* Expressions::neutral_ = nullptr;

TEST_F(Expressions, ComeBackOnTheHeadItself) {
  const FittedHead same = head(Eigen::Matrix3f::Identity());
  const auto morphs = carry_expressions(*neutral_, same, face_patch(same), same.mesh);
  ASSERT_EQ(morphs.size(), neutral_->expressions.size());
  ASSERT_TRUE(check(morphs, same.mesh.positions.size()).ok());
  for (const char* name : {"mouthFrownLeft", "mouthSmileRight", "browInnerUp"}) {
    const Expression& given = expression(name);
    const MorphTarget& carried = morph(morphs, name);
    for (size_t i = 0; i < given.vertices.size(); ++i) {
      if (given.offsets[i].norm() < 1e-4F) continue;
      const auto at = std::lower_bound(carried.vertices.begin(), carried.vertices.end(), given.vertices[i]);
      if (neutral_->mesh.positions[given.vertices[i]].z() < 0.06F) continue;  // towards the rim it fades
      ASSERT_TRUE(at != carried.vertices.end() && *at == given.vertices[i]) << name;
      const Eigen::Vector3f& offset = carried.offsets[static_cast<size_t>(at - carried.vertices.begin())];
      EXPECT_LT((offset - given.offsets[i]).norm(), 1e-4F) << name << " " << given.vertices[i];
    }
  }
}

TEST_F(Expressions, NarrowWhatIsBetweenClosingLids) {
  const FittedHead same = head(Eigen::Matrix3f::Identity());
  const auto morphs = carry_expressions(*neutral_, same, face_patch(same), same.mesh);
  float middle = 0, eyes = 0;
  for (size_t v = 0; v < neutral_->eyeball.size(); ++v)
    if (neutral_->eyeball[v] != 0 && neutral_->mesh.positions[v].x() > 0) {
      middle += neutral_->mesh.positions[v].x();
      ++eyes;
    }
  middle /= eyes;
  const auto eye_height = [&](const std::vector<Eigen::Vector3f>& positions) {
    float low = 1e9F, high = -1e9F;
    for (size_t v = 0; v < positions.size(); ++v)
      if (neutral_->eyeball[v] != 0 && std::abs(neutral_->mesh.positions[v].x() - middle) < 0.003F) {
        low = std::min(low, positions[v].y());
        high = std::max(high, positions[v].y());
      }
    return high - low;
  };
  const MorphTarget& blink = morph(morphs, "eyeBlinkLeft");
  std::vector<Eigen::Vector3f> closed = same.mesh.positions;
  float most = 0, given_most = 0;
  for (size_t i = 0; i < blink.vertices.size(); ++i) {
    closed[blink.vertices[i]] += blink.offsets[i];
    most = std::max(most, blink.offsets[i].norm());
  }
  for (const Eigen::Vector3f& offset : expression("eyeBlinkLeft").offsets)
    given_most = std::max(given_most, offset.norm());
  EXPECT_NEAR(most, given_most, 1e-4F);
  EXPECT_LT(eye_height(closed), 0.75F * eye_height(same.mesh.positions));
}

TEST_F(Expressions, TurnAndStretchWithTheFace) {
  // A face twice as tall: lids have twice as far to go.
  const Eigen::Matrix3f linear =
      Eigen::AngleAxisf(0.5F, Eigen::Vector3f::UnitY()) * Eigen::Vector3f(1, 2, 1).asDiagonal().toDenseMatrix();
  const FittedHead tall = head(linear);
  const auto morphs = carry_expressions(*neutral_, tall, face_patch(tall), tall.mesh);
  const Expression& given = expression("eyeBlinkLeft");
  const MorphTarget& carried = morph(morphs, "eyeBlinkLeft");
  double along = 0, all = 0;
  for (size_t i = 0; i < given.vertices.size(); ++i) {
    const auto at = std::lower_bound(carried.vertices.begin(), carried.vertices.end(), given.vertices[i]);
    if (at == carried.vertices.end() || *at != given.vertices[i]) continue;
    const Eigen::Vector3f expected = linear * given.offsets[i];
    along += static_cast<double>(carried.offsets[static_cast<size_t>(at - carried.vertices.begin())].dot(expected));
    all += static_cast<double>(expected.squaredNorm());
  }
  EXPECT_NEAR(along / all, 1, 0.1);
}

TEST_F(Expressions, ReachAMeshWithOtherVertices) {
  const FittedHead same = head(Eigen::Matrix3f::Identity());
  // The middles of the triangles of the neutral head, a millimetre outside it.
  Mesh other;
  const std::vector<Eigen::Vector3f> normals = vertex_normals(same.mesh);
  for (const auto& [a, b, c] : same.mesh.triangles) {
    const Eigen::Vector3f middle = (same.mesh.positions[a] + same.mesh.positions[b] + same.mesh.positions[c]) / 3;
    const Eigen::Vector3f out = (normals[a] + normals[b] + normals[c]).normalized();
    const auto first = static_cast<uint32_t>(other.positions.size());
    for (const uint32_t v : {a, b, c}) other.positions.push_back((same.mesh.positions[v] + middle) / 2 + 0.001F * out);
    other.triangles.push_back({first, first + 1, first + 2});
  }
  const auto morphs = carry_expressions(*neutral_, same, face_patch(same), other);
  const MorphTarget& smile = morph(morphs, "mouthSmileLeft");
  float most = 0;
  Eigen::Vector3f where = Eigen::Vector3f::Zero();
  for (size_t i = 0; i < smile.vertices.size(); ++i)
    if (smile.offsets[i].norm() > most) {
      most = smile.offsets[i].norm();
      where = other.positions[smile.vertices[i]];
    }
  float given_most = 0;
  for (const Eigen::Vector3f& offset : expression("mouthSmileLeft").offsets)
    given_most = std::max(given_most, offset.norm());
  EXPECT_NEAR(most, given_most, 0.15F * given_most);
  EXPECT_GT(where.x(), 0.1F);  // the subject's left
}

TEST_F(Expressions, LeaveTheBodyAndWhatCoversTheFaceAlone) {
  FittedHead covered = head(Eigen::Matrix3f::Identity());
  // Hair over the left half of the face.
  for (size_t v = 0; v < covered.bare.size(); ++v)
    if (neutral_->mesh.positions[v].x() > 0) covered.bare[v] = 0;
  for (const MorphTarget& target : carry_expressions(*neutral_, covered, face_patch(covered), covered.mesh))
    for (const uint32_t v : target.vertices) {
      EXPECT_LE(neutral_->mesh.positions[v].x(), 0);
      EXPECT_NE(neutral_->face_front[v], 0);
    }
  Mesh elsewhere = covered.mesh;
  for (Eigen::Vector3f& p : elsewhere.positions) p.y() -= 1;
  EXPECT_TRUE(carry_expressions(*neutral_, covered, face_patch(covered), elsewhere).empty());
}

}  // namespace
}  // namespace booth
