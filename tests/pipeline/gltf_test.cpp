#include "pipeline/export/gltf.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <nlohmann/json.hpp>
#include <set>
#include <string>
#include <vector>

#include "tests/synthetic/avatar.h"

namespace booth {
namespace {

using Json = nlohmann::json;
using Bytes = std::vector<uint8_t>;

uint32_t word(const Bytes& bytes, size_t at) {
  return static_cast<uint32_t>(bytes[at] | bytes[at + 1] << 8 | bytes[at + 2] << 16) |
         static_cast<uint32_t>(bytes[at + 3]) << 24;
}

/// A GLB taken apart.
struct Glb {
  Json json;
  Bytes binary;

  explicit Glb(const Bytes& bytes) {
    EXPECT_EQ(std::string(bytes.begin(), bytes.begin() + 4), "glTF");
    EXPECT_EQ(word(bytes, 4), 2U);
    EXPECT_EQ(word(bytes, 8), bytes.size());
    const size_t json_bytes = word(bytes, 12), binary_at = 20 + json_bytes;
    EXPECT_EQ(json_bytes % 4, 0U);
    json = Json::parse(bytes.begin() + 20, bytes.begin() + static_cast<long>(binary_at));
    EXPECT_EQ(binary_at + 8 + word(bytes, binary_at), bytes.size());
    binary.assign(bytes.begin() + static_cast<long>(binary_at) + 8, bytes.end());
  }

  Bytes view(size_t index) const {
    const Json& view = json["bufferViews"][index];
    const auto begin = binary.begin() + view["byteOffset"].get<long>();
    return {begin, begin + view["byteLength"].get<long>()};
  }

  template <class Component>
  std::vector<Component> array(const Json& accessor_index) const {
    const Bytes bytes = view(json["accessors"][accessor_index.get<size_t>()]["bufferView"]);
    std::vector<Component> values(bytes.size() / sizeof(Component));
    std::memcpy(values.data(), bytes.data(), bytes.size());
    return values;
  }

  const Json& primitive() const { return json["meshes"][0]["primitives"][0]; }
  const Json& attribute(const char* name) const { return primitive()["attributes"][name]; }
  int component_type(const Json& accessor_index) const {
    return json["accessors"][accessor_index.get<size_t>()]["componentType"];
  }
};

constexpr int unsigned_byte = 5121, unsigned_short = 5123, unsigned_int = 5125;

TEST(Glb, HoldsEveryCornerOfTheAvatar) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const Glb glb(write_glb(avatar, {}, {}, {}));
  const auto positions = glb.array<float>(glb.attribute("POSITION"));
  const auto uvs = glb.array<float>(glb.attribute("TEXCOORD_0"));
  ASSERT_EQ(glb.component_type(glb.primitive()["indices"]), unsigned_short);
  const auto indices = glb.array<uint16_t>(glb.primitive()["indices"]);
  ASSERT_EQ(indices.size(), avatar.mesh.triangles.size() * 3);
  for (size_t corner = 0; corner < indices.size(); ++corner) {
    const size_t i = indices[corner];
    const Eigen::Vector3f& p = avatar.mesh.positions[avatar.mesh.triangles[corner / 3][corner % 3]];
    ASSERT_EQ(Eigen::Vector3f(positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]), p);
    ASSERT_EQ(Eigen::Vector2f(uvs[2 * i], uvs[2 * i + 1]), avatar.atlas.uv[corner / 3][corner % 3]);
  }
}

TEST(Glb, SplitsVerticesNoMoreThanTheSeamsDemand) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  std::set<std::tuple<uint32_t, float, float>> distinct;
  for (size_t t = 0; t < avatar.mesh.triangles.size(); ++t)
    for (size_t k = 0; k < 3; ++k)
      distinct.emplace(avatar.mesh.triangles[t][k], avatar.atlas.uv[t][k].x(), avatar.atlas.uv[t][k].y());
  EXPECT_GT(distinct.size(), avatar.mesh.positions.size());
  const Glb glb(write_glb(avatar, {}, {}, {}));
  EXPECT_EQ(glb.array<float>(glb.attribute("POSITION")).size(), distinct.size() * 3);
}

TEST(Glb, EmbedsTheTextureAsItIs) {
  const Bytes texture{1, 2, 3, 4, 5};
  const Glb glb(write_glb(synthetic::make_avatar(synthetic::person()), {}, texture, {.generator = "A \"tool\""}));
  EXPECT_EQ(glb.view(glb.json["images"][0]["bufferView"]), texture);
  EXPECT_EQ(glb.json["images"][0]["mimeType"], "image/png");
  EXPECT_EQ(glb.json["asset"]["generator"], "A \"tool\"");
  const Json& material = glb.json["materials"][glb.primitive()["material"].get<size_t>()]["pbrMetallicRoughness"];
  EXPECT_EQ(material["metallicFactor"], 0);
  EXPECT_EQ(material["baseColorTexture"]["index"], 0);
}

TEST(Glb, ViewsBeginAtMultiplesOfFour) {
  const Glb glb(write_glb(synthetic::make_avatar(synthetic::person()), {}, Bytes{1, 2, 3}, {}));
  for (const Json& view : glb.json["bufferViews"]) {
    EXPECT_EQ(view["byteOffset"].get<size_t>() % 4, 0U);
    EXPECT_LE(view["byteOffset"].get<size_t>() + view["byteLength"].get<size_t>(), glb.binary.size());
  }
}

TEST(Glb, JointsStandWhereTheSkeletonHasThem) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const Glb glb(write_glb(avatar, {}, {}, {}));
  const Json& skin = glb.json["skins"][0];
  const auto inverse_bind = glb.array<float>(skin["inverseBindMatrices"]);
  const auto world = world_from_joints(avatar.skeleton);
  ASSERT_EQ(skin["joints"].size(), world.size());
  for (size_t j = 0; j < world.size(); ++j) {
    const Json& node = glb.json["nodes"][skin["joints"][j].get<size_t>()];
    EXPECT_EQ(node["name"], avatar.skeleton.joints[j].name);
    const Json &t = node["translation"], &q = node["rotation"];
    const Eigen::Isometry3d local =
        Eigen::Translation3d(t[0], t[1], t[2]) *
        Eigen::Quaterniond(q[3].get<double>(), q[0].get<double>(), q[1].get<double>(), q[2].get<double>());
    EXPECT_TRUE(local.isApprox(avatar.skeleton.joints[j].parent_from_joint, 1e-6));
    const Eigen::Matrix4f inverse(inverse_bind.data() + 16 * j);
    EXPECT_TRUE((inverse.cast<double>() * world[j].matrix()).isApprox(Eigen::Matrix4d::Identity(), 1e-5));
    EXPECT_EQ(inverse.row(3), Eigen::RowVector4f(0, 0, 0, 1));
  }
}

TEST(Glb, WeightsSumToOneAndUnusedJointsAreZero) {
  const Glb glb(write_glb(synthetic::make_avatar(synthetic::person()), {}, {}, {}));
  ASSERT_EQ(glb.component_type(glb.attribute("JOINTS_0")), unsigned_byte);
  const auto joints = glb.array<uint8_t>(glb.attribute("JOINTS_0"));
  const auto weights = glb.array<float>(glb.attribute("WEIGHTS_0"));
  ASSERT_EQ(joints.size(), weights.size());
  for (size_t i = 0; i < weights.size(); i += 4) {
    EXPECT_NEAR(weights[i] + weights[i + 1] + weights[i + 2] + weights[i + 3], 1, 2e-7);
    for (size_t k = i; k < i + 4; ++k) EXPECT_TRUE(weights[k] > 0 || joints[k] == 0);
  }
}

TEST(Glb, UsesWiderIndicesForManyVertices) {
  const Glb glb(write_glb(synthetic::make_avatar(synthetic::person(), {.segments = 480}), {}, {}, {}));
  EXPECT_GT(glb.array<float>(glb.attribute("POSITION")).size(), size_t{3} * 65535);
  EXPECT_EQ(glb.component_type(glb.primitive()["indices"]), unsigned_int);
}

TEST(Glb, UsesWiderJointsForManyBones) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  for (int extra = 0; avatar.skeleton.joints.size() < 300; ++extra)
    avatar.skeleton.joints.push_back({"extra" + std::to_string(extra), 0, Eigen::Isometry3d::Identity()});
  avatar.skin.influences[0] = {{299, 0, 0, 0}, {1, 0, 0, 0}};
  ASSERT_TRUE(check(avatar));
  const Glb glb(write_glb(avatar, {}, {}, {}));
  ASSERT_EQ(glb.component_type(glb.attribute("JOINTS_0")), unsigned_short);
  EXPECT_THAT(glb.array<uint16_t>(glb.attribute("JOINTS_0")), testing::Contains(299));
}

TEST(Glb, OfAnUnriggedAvatarHasNoSkin) {
  const Glb glb(write_glb(synthetic::make_avatar(synthetic::person(), {.rigged = false}), {}, {}, {}));
  EXPECT_FALSE(glb.json.contains("skins"));
  EXPECT_FALSE(glb.primitive()["attributes"].contains("JOINTS_0"));
  EXPECT_EQ(glb.json["scenes"][0]["nodes"].size(), 1U);
}

TEST(Glb, HoldsMorphTargetsByName) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  avatar.morphs.push_back({"smile", {3, 7, 20}, {{0.001F, 0, 0}, {0, 0.002F, 0}, {0, 0, -0.003F}}});
  avatar.morphs.push_back({"nothing", {}, {}});
  ASSERT_TRUE(check(avatar).ok());
  const Glb glb(write_glb(avatar, {}, {}, {}));
  const Json& mesh = glb.json["meshes"][0];
  EXPECT_EQ(mesh["extras"]["targetNames"], (Json{"smile", "nothing"}));
  EXPECT_EQ(mesh["weights"], (Json{0, 0}));
  ASSERT_EQ(glb.primitive()["targets"].size(), 2U);

  const auto positions = glb.array<float>(glb.attribute("POSITION"));
  const size_t count = positions.size() / 3;
  const auto sparse = [&](size_t target, const char* name) {
    const Json& accessor = glb.json["accessors"][glb.primitive()["targets"][target][name].get<size_t>()];
    EXPECT_EQ(accessor["count"], count);
    EXPECT_FALSE(accessor.contains("bufferView"));
    const Bytes index_bytes = glb.view(accessor["sparse"]["indices"]["bufferView"]);
    const Bytes value_bytes = glb.view(accessor["sparse"]["values"]["bufferView"]);
    EXPECT_EQ(accessor["sparse"]["indices"]["componentType"], unsigned_short);
    std::vector<uint16_t> indices(index_bytes.size() / 2);
    std::vector<float> values(value_bytes.size() / 4);
    std::memcpy(indices.data(), index_bytes.data(), index_bytes.size());
    std::memcpy(values.data(), value_bytes.data(), value_bytes.size());
    EXPECT_EQ(indices.size(), accessor["sparse"]["count"].get<size_t>());
    EXPECT_TRUE(std::is_sorted(indices.begin(), indices.end()));
    std::vector<Eigen::Vector3f> all(count, Eigen::Vector3f::Zero());
    for (size_t i = 0; i < indices.size(); ++i) all[indices[i]] = {values[3 * i], values[3 * i + 1], values[3 * i + 2]};
    return all;
  };
  // Every copy of a vertex that a seam has split moves with it, and nothing else does.
  const auto moved = sparse(0, "POSITION");
  for (size_t i = 0; i < count; ++i) {
    const Eigen::Vector3f p(positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]);
    Eigen::Vector3f expected = Eigen::Vector3f::Zero();
    for (size_t m = 0; m < 3; ++m)
      if (p == avatar.mesh.positions[avatar.morphs[0].vertices[m]]) expected = avatar.morphs[0].offsets[m];
    EXPECT_EQ(moved[i], expected) << i;
  }
  size_t turned = 0;
  for (const Eigen::Vector3f& n : sparse(0, "NORMAL")) turned += n.isZero() ? 0 : 1;
  EXPECT_GE(turned, 3U);
  for (const Eigen::Vector3f& p : sparse(1, "POSITION")) EXPECT_TRUE(p.isZero());
}

TEST(MorphTargets, AreChecked) {
  Avatar avatar = synthetic::make_avatar(synthetic::person());
  const auto complaint = [&](std::vector<MorphTarget> morphs) {
    avatar.morphs = std::move(morphs);
    const auto checked = check(avatar);
    return checked ? std::string() : checked.error().message;
  };
  const Eigen::Vector3f by(0, 0.001F, 0);
  EXPECT_EQ(complaint({{"a", {1, 2}, {by, by}}, {"b", {}, {}}}), "");
  EXPECT_NE(complaint({{"a", {}, {}}, {"a", {}, {}}}), "");
  EXPECT_NE(complaint({{"", {}, {}}}), "");
  EXPECT_NE(complaint({{"a", {2, 1}, {by, by}}}), "");
  EXPECT_NE(complaint({{"a", {1}, {by, by}}}), "");
  EXPECT_NE(complaint({{"a", {4000000}, {by}}}), "");
  EXPECT_NE(complaint({{"a", {1}, {by / 0.0F}}}), "");
}

}  // namespace
}  // namespace booth
