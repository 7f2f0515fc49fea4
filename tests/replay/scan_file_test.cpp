#include "replay/scan_file.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstring>
#include <fstream>

#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

using ::testing::HasSubstr;

Result<Mesh> parse(const std::string& name, const std::string& text) {
  return parse_scan_file(name, {reinterpret_cast<const uint8_t*>(text.data()), text.size()});
}
std::string message_of(const std::string& name, const std::string& text) {
  const auto mesh = parse(name, text);
  return mesh.ok() ? "" : mesh.error().message;
}

template <class T>
void append(std::string* to, T value, bool big) {
  char raw[sizeof value];
  std::memcpy(raw, &value, sizeof value);
  if (big) std::reverse(raw, raw + sizeof value);
  to->append(raw, sizeof value);
}

/// A square of two triangles with colours and a quality, a double among the properties.
std::string binary_square(bool big) {
  std::string ply = std::string("ply\nformat binary_") + (big ? "big" : "little") +
                    "_endian 1.0\ncomment made by hand\nelement vertex 4\nproperty float x\nproperty double y\n"
                    "property float z\nproperty uchar red\nelement face 1\nproperty uchar flags\n"
                    "property list uchar int vertex_indices\nend_header\n";
  for (const auto& [x, y] : {std::pair{0.0F, 0.0}, {1.0F, 0.0}, {1.0F, 1.0}, {0.0F, 1.0}}) {
    append(&ply, x, big);
    append(&ply, y, big);
    append(&ply, 0.5F, big);
    append(&ply, uint8_t{200}, big);
  }
  append(&ply, uint8_t{7}, big);
  append(&ply, uint8_t{4}, big);
  for (int32_t corner = 0; corner < 4; ++corner) append(&ply, corner, big);
  return ply;
}

void expect_square(const Result<Mesh>& mesh) {
  ASSERT_TRUE(mesh.ok()) << mesh.error().message;
  ASSERT_EQ(mesh->positions.size(), 4U);
  EXPECT_EQ(mesh->positions[2], Eigen::Vector3f(1, 1, 0.5F));
  ASSERT_EQ(mesh->triangles.size(), 2U);
  EXPECT_EQ(mesh->triangles[1], (std::array<uint32_t, 3>{0, 2, 3}));
}

TEST(ScanFile, ReadsBothByteOrders) {
  expect_square(parse("face.ply", binary_square(false)));
  expect_square(parse("face.ply", binary_square(true)));
}

TEST(ScanFile, ReadsAsciiPly) {
  expect_square(parse("face.ply",
                      "ply\r\nformat ascii 1.0\r\nelement vertex 4\r\nproperty float x\r\nproperty float y\r\n"
                      "property float z\r\nelement face 1\r\nproperty list uchar uint vertex_index\r\nend_header\r\n"
                      "0 0 .5\r\n1 0 0.5\r\n1 1 5e-1\r\n0 1 0.5\r\n4 0 1 2 3\r\n"));
}

TEST(ScanFile, ReadsObj) {
  expect_square(parse("face.obj",
                      "# a comment\nmtllib none.mtl\no face\nv 0 0 0.5\nv 1 0 0.5 1.0\nv 1 1 0.5\nv 0 1 0.5\n"
                      "vt 0 0\nvn 0 0 1\ns off\nf 1/1/1 2//1 -2 4\n"));
}

TEST(ScanFile, ReadsACloud) {
  const auto cloud = parse("face.obj", "v 0 0 0\nv 1 2 3");
  ASSERT_TRUE(cloud.ok());
  EXPECT_EQ(cloud->positions.size(), 2U);
  EXPECT_TRUE(cloud->triangles.empty());
}

TEST(ScanFile, SaysWhatIsWrong) {
  const std::string vertices = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n";
  EXPECT_THAT(message_of("face.ply", ""), HasSubstr("face.ply: the first line"));
  EXPECT_THAT(message_of("face.ply", "ply\nelement vertex 1\n"), HasSubstr("has no end"));
  EXPECT_THAT(message_of("face.ply", "ply\nformat ascii 1.0\nelement vertex x\n"), HasSubstr("element vertex x"));
  EXPECT_THAT(message_of("face.ply", vertices + "end_header\n1 2\n"), HasSubstr("no finite position"));
  EXPECT_THAT(message_of("face.ply", vertices + "property float z\nend_header\n1 2 nan\n"), HasSubstr("vertex 0"));
  EXPECT_THAT(message_of("face.ply", vertices + "property float z\nend_header\n1 2\n"), HasSubstr("the file ends"));
  EXPECT_THAT(
      message_of("face.ply", "ply\nformat ascii 1.0\nelement vertex 9999999\nproperty float x\nend_header\n1\n"),
      HasSubstr("too short"));
  EXPECT_THAT(message_of("face.ply",
                         "ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int vertex_indices\n"
                         "end_header\n"),
              HasSubstr("no vertex"));
  EXPECT_THAT(message_of("face.obj", "v 0 0 0\nf 1 2 3\n"), HasSubstr("line 2"));
  EXPECT_THAT(message_of("face.obj", "v 0 0\n"), HasSubstr("line 1"));
  EXPECT_THAT(message_of("face.obj", "v 0 0 0\nf 1 x 1\n"), HasSubstr("\"x\""));
}

TEST(ScanFile, EveryCutIsAnErrorOrAMesh) {
  const std::string whole = binary_square(false);
  for (size_t size = 0; size < whole.size(); ++size)
    EXPECT_FALSE(parse("face.ply", whole.substr(0, size)).ok()) << size;
}

TEST(ScanFile, IsLookedForBesideTheRecording) {
  const ScratchFolder folder;
  auto none = find_scan_file(folder.path());
  ASSERT_TRUE(none.ok());
  EXPECT_FALSE(none->has_value());
  std::ofstream(folder.path() / "face.obj") << "v 0 0 0\n";
  EXPECT_EQ(find_scan_file(folder.path()).value()->name, "face.obj");
  std::ofstream(folder.path() / "face.ply") << "nonsense";
  EXPECT_EQ(find_scan_file(folder.path()).error().code, ErrorCode::invalid_file);
}

}  // namespace
}  // namespace booth
