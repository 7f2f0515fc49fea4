#include "pipeline/export/mesh_files.h"

#include <gtest/gtest.h>

#include <array>
#include <cstring>
#include <sstream>
#include <string>
#include <vector>

#include "tests/synthetic/avatar.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

template <class Number>
Number number_at(const std::vector<uint8_t>& bytes, size_t at) {
  Number number{};
  EXPECT_LE(at + sizeof(Number), bytes.size());
  if (at + sizeof(Number) <= bytes.size()) std::memcpy(&number, bytes.data() + at, sizeof(Number));
  return number;
}

Eigen::Vector3f vector_at(const std::vector<uint8_t>& bytes, size_t at) {
  return {number_at<float>(bytes, at), number_at<float>(bytes, at + 4), number_at<float>(bytes, at + 8)};
}

Avatar example() { return synthetic::make_avatar(synthetic::person()); }

TEST(Stl, StandsUprightInMillimetres) {
  const Avatar avatar = example();
  const std::vector<uint8_t> stl = write_stl(avatar);
  ASSERT_EQ(stl.size(), 84 + 50 * avatar.mesh.triangles.size());
  EXPECT_NE(std::memcmp(stl.data(), "solid", 5), 0);
  EXPECT_EQ(number_at<uint32_t>(stl, 80), avatar.mesh.triangles.size());
  double volume = 0;
  for (size_t t = 0; t < avatar.mesh.triangles.size(); ++t) {
    std::array<Eigen::Vector3f, 3> p;
    for (size_t c = 0; c < 3; ++c) {
      p[c] = vector_at(stl, 84 + 50 * t + 12 * (c + 1));
      const Eigen::Vector3f& ours = avatar.mesh.positions[avatar.mesh.triangles[t][c]];
      EXPECT_NEAR((p[c] - 1000 * Eigen::Vector3f(ours.x(), -ours.z(), ours.y())).norm(), 0, 1e-3);
    }
    const Eigen::Vector3f normal = vector_at(stl, 84 + 50 * t), around = (p[1] - p[0]).cross(p[2] - p[0]);
    EXPECT_GT(normal.dot(around), 0.999F * around.norm());
    volume += static_cast<double>(p[0].dot(p[1].cross(p[2]))) / 6;
  }
  EXPECT_NEAR(volume / 1e9, topology(avatar.mesh).signed_volume_m3, 1e-4);
}

TEST(Obj, HoldsTheMeshWithItsUvs) {
  const Avatar avatar = example();
  std::istringstream lines(write_obj(avatar, "person.mtl"));
  std::vector<Eigen::Vector3f> positions, normals;
  std::vector<Eigen::Vector2f> uvs;
  size_t triangle = 0;
  bool library = false;
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string kind;
    words >> kind;
    if (kind == "mtllib") library = line == "mtllib person.mtl";
    if (kind == "v" || kind == "vn") {
      Eigen::Vector3f v;
      words >> v.x() >> v.y() >> v.z();
      (kind == "v" ? positions : normals).push_back(v);
    }
    if (kind == "vt") {
      Eigen::Vector2f uv;
      words >> uv.x() >> uv.y();
      uvs.push_back(uv);
    }
    if (kind != "f") continue;
    ASSERT_LT(triangle, avatar.mesh.triangles.size());
    for (size_t c = 0; c < 3; ++c) {
      size_t v = 0, vt = 0, vn = 0;
      char slash = 0;
      words >> v >> slash >> vt >> slash >> vn;
      ASSERT_EQ(v - 1, avatar.mesh.triangles[triangle][c]);
      EXPECT_EQ(vn, v);
      ASSERT_LE(vt, uvs.size());
      const Eigen::Vector2f& uv = avatar.atlas.uv[triangle][c];
      EXPECT_NEAR((uvs[vt - 1] - Eigen::Vector2f(uv.x(), 1 - uv.y())).norm(), 0, 1e-6);
    }
    ++triangle;
  }
  EXPECT_TRUE(library);
  EXPECT_EQ(triangle, avatar.mesh.triangles.size());
  EXPECT_EQ(positions, avatar.mesh.positions);
  EXPECT_EQ(normals.size(), positions.size());
}

TEST(Obj, TheMaterialShowsTheTexture) {
  EXPECT_NE(write_obj_material("texture.jpg").find("\nmap_Kd texture.jpg\n"), std::string::npos);
}

TEST(Ply, HasTheColoursOfTheAtlas) {
  const Avatar avatar = example();
  const std::vector<uint8_t> ply = write_ply(avatar);
  const std::string text(ply.begin(), ply.end());
  const size_t data = text.find("end_header\n") + 11;
  const size_t vertices = avatar.mesh.positions.size(), triangles = avatar.mesh.triangles.size();
  EXPECT_NE(text.find("element vertex " + std::to_string(vertices) + "\n"), std::string::npos);
  EXPECT_NE(text.find("element face " + std::to_string(triangles) + "\n"), std::string::npos);
  ASSERT_EQ(ply.size(), data + 27 * vertices + 13 * triangles);
  for (size_t v = 0; v < vertices; ++v) {
    EXPECT_EQ(vector_at(ply, data + 27 * v), avatar.mesh.positions[v]);
    EXPECT_NEAR(vector_at(ply, data + 27 * v + 12).norm(), 1, 1e-4);
    const Eigen::Vector3d colour = 255 * synthetic::colour_at(avatar.mesh.positions[v].cast<double>());
    for (size_t c = 0; c < 3; ++c)
      EXPECT_NEAR(ply[data + 27 * v + 24 + c], colour[static_cast<int>(c)], 12) << "vertex " << v;
  }
  for (size_t t = 0; t < triangles; ++t) {
    const size_t at = data + 27 * vertices + 13 * t;
    EXPECT_EQ(ply[at], 3);
    for (size_t c = 0; c < 3; ++c) EXPECT_EQ(number_at<uint32_t>(ply, at + 1 + 4 * c), avatar.mesh.triangles[t][c]);
  }
}

}  // namespace
}  // namespace booth
