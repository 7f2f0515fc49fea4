#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/wait.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

#include "pipeline/export/avatar_files.h"
#include "pipeline/export/sha256.h"
#include "pipeline/image/codec.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/avatar.h"

namespace booth {
namespace {

AvatarMetadata metadata() {
  AvatarMetadata result;
  result.id = "a-1";
  result.created = "2026-11-22T10:15:00Z";
  result.recording = "r-1";
  result.cameras = {"body-00"};
  return result;
}

const std::vector<uint8_t>& bytes_of(const std::vector<NamedBytes>& files, const std::string& name) {
  for (const NamedBytes& file : files)
    if (file.name == name) return file.bytes;
  throw std::invalid_argument("no " + name);
}

/// A folder of its own that goes away with it.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "avatar-XXXXXX").string();
    if (mkdtemp(name.data()) == nullptr) throw std::runtime_error("mkdtemp failed");
    path_ = name;
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  const std::filesystem::path& path() const { return path_; }

 private:
  std::filesystem::path path_;
};

TEST(AvatarFiles, AreThoseOfTheContract) {
  const auto files = make_avatar_files(synthetic::make_avatar(synthetic::person()), metadata(), {});
  std::vector<std::string> names;
  for (const NamedBytes& file : files) names.push_back(file.name);
  EXPECT_THAT(names,
              testing::UnorderedElementsAre("avatar.dae", "texture.png", "avatar.glb", "preview.png", "metadata.json"));
  EXPECT_EQ(names.back(), "metadata.json");
}

AvatarFileOptions everything() {
  AvatarFileOptions options;
  options.texture = ImageFormat::jpeg;
  options.animation = true;
  options.turntable = true;
  options.formats = {MeshFormat::stl, MeshFormat::obj, MeshFormat::ply};
  options.turning.frames = 6;
  return options;
}

TEST(AvatarFiles, AreAllThatIsAskedFor) {
  const auto files = make_avatar_files(synthetic::make_avatar(synthetic::person()), metadata(), everything());
  std::vector<std::string> names;
  for (const NamedBytes& file : files) names.push_back(file.name);
  EXPECT_THAT(names,
              testing::UnorderedElementsAre("avatar.dae", "texture.jpg", "avatar.glb", "preview.png", "turntable.webp",
                                            "avatar.stl", "avatar.obj", "avatar.mtl", "avatar.ply", "metadata.json"));
  const auto texture = read_image_header(bytes_of(files, "texture.jpg"));
  ASSERT_TRUE(texture);
  EXPECT_EQ(texture->format, ImageFormat::jpeg);
  const auto& dae = bytes_of(files, "avatar.dae");
  EXPECT_NE(std::string(dae.begin(), dae.end()).find("<init_from>texture.jpg<"), std::string::npos);
}

TEST(AvatarFiles, AreDescribedByTheirMetadata) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const auto files = make_avatar_files(avatar, metadata(), {});
  const auto& json = bytes_of(files, "metadata.json");
  const auto read = read_metadata({reinterpret_cast<const char*>(json.data()), json.size()});
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->id, "a-1");
  EXPECT_EQ(read->triangles, avatar.mesh.triangles.size());
  EXPECT_EQ(read->joints, avatar.skeleton.joints.size());
  ASSERT_EQ(read->files.size(), files.size() - 1);
  for (const AvatarFile& file : read->files) {
    EXPECT_EQ(file.size, bytes_of(files, file.name).size());
    EXPECT_EQ(file.sha256, sha256_hex(bytes_of(files, file.name)));
  }
}

TEST(AvatarFiles, HoldTheAtlasAndAPortrait) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const auto files = make_avatar_files(avatar, metadata(), {});
  const auto texture = decode_image(bytes_of(files, "texture.png"));
  ASSERT_TRUE(texture);
  EXPECT_EQ(texture->samples, avatar.atlas.image.samples);
  const auto preview = read_image_header(bytes_of(files, "preview.png"));
  ASSERT_TRUE(preview);
  EXPECT_EQ(preview->width, 768);
  EXPECT_EQ(preview->height, 1024);
  EXPECT_EQ(preview->channels, 4);
}

TEST(AvatarFiles, AreTheSameWithAnyNumberOfThreads) {
  const Avatar avatar = synthetic::make_avatar(synthetic::person());
  const auto alone = make_avatar_files(avatar, metadata(), {});
  ThreadPool pool(4);
  const auto together = make_avatar_files(avatar, metadata(), {}, pool.work());
  ASSERT_EQ(together.size(), alone.size());
  for (size_t i = 0; i < alone.size(); ++i) EXPECT_EQ(together[i].bytes, alone[i].bytes) << alone[i].name;
}

/// Other people's readers find nothing wrong with it.
struct FolderCase {
  const char* name;
  bool rigged, morphs;
};
class AvatarFolder : public testing::TestWithParam<FolderCase> {};

TEST_P(AvatarFolder, PassesTheAcceptanceChecks) {
  const TemporaryFolder folder;
  Avatar avatar = synthetic::make_avatar(synthetic::person(), {.rigged = GetParam().rigged});
  AvatarFileOptions options;
  options.collada_morphs = GetParam().morphs;
  if (GetParam().morphs)
    avatar.morphs = {{"smile", {3, 7, 20}, {{0.01F, 0, 0}, {0, 0.02F, 0}, {0, 0, -0.03F}}}, {"nothing", {}, {}}};
  for (const NamedBytes& file : make_avatar_files(avatar, metadata(), options)) {
    std::ofstream out(folder.path() / file.name, std::ios::binary);
    out.write(reinterpret_cast<const char*>(file.bytes.data()), static_cast<std::streamsize>(file.bytes.size()));
    ASSERT_TRUE(out.flush());
  }
  const std::string command =
      "/usr/bin/python3 " BOOTH_SOURCE_DIR "/tests/files/check_avatar.py '" + folder.path().string() + "'";
  const int status = std::system(command.c_str());
  ASSERT_TRUE(WIFEXITED(status));
  constexpr int skipped = 77, not_found = 127;
  if (WEXITSTATUS(status) == skipped || WEXITSTATUS(status) == not_found)
    GTEST_SKIP() << "python3-collada, python3-lxml or python3-numpy is not installed";
  EXPECT_EQ(WEXITSTATUS(status), 0);
}

INSTANTIATE_TEST_SUITE_P(All, AvatarFolder,
                         testing::Values(FolderCase{"Rigged", true, false}, FolderCase{"Unrigged", false, false},
                                         FolderCase{"RiggedWithMorphs", true, true},
                                         FolderCase{"UnriggedWithMorphs", false, true}),
                         [](const auto& instance) { return instance.param.name; });

}  // namespace
}  // namespace booth
