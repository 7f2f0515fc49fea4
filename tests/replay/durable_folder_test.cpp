#include "replay/durable_folder.h"

#include <gtest/gtest.h>
#include <sys/mount.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <fstream>
#include <thread>

#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

std::string content(const fs::path& file) {
  const auto bytes = read_file(file, 1 << 20);
  return bytes ? std::string(bytes->begin(), bytes->end()) : "error: " + bytes.error().message;
}

/// The names in a folder, hidden ones included.
std::vector<std::string> names_in(const fs::path& folder) {
  std::vector<std::string> names;
  for (const auto& entry : fs::directory_iterator(folder)) names.push_back(entry.path().filename());
  return names;
}

/// Runs `body` in a child process that then kills itself as a power cut would.
template <class Body>
void run_and_kill(const Body& body) {
  const pid_t child = ::fork();
  ASSERT_GE(child, 0);
  if (child == 0) {
    body();
    ::kill(::getpid(), SIGKILL);
  }
  int status = 0;
  ASSERT_EQ(::waitpid(child, &status, 0), child);
  ASSERT_TRUE(WIFSIGNALED(status));
}

TEST(DurableFolder, AppearsWholeOnCommit) {
  const ScratchFolder scratch;
  const fs::path parent = scratch.path() / "made" / "on the way";
  auto folder = DurableFolder::begin(parent, "avatar");
  ASSERT_TRUE(folder) << folder.error().message;
  EXPECT_TRUE(folder->write("one.txt", "1"));
  EXPECT_TRUE(folder->write("deep/er/two.txt", "22"));
  EXPECT_FALSE(fs::exists(parent / "avatar"));
  const auto committed = folder->commit();
  ASSERT_TRUE(committed) << committed.error().message;
  EXPECT_EQ(names_in(parent), std::vector<std::string>{"avatar"});
  EXPECT_EQ(content(parent / "avatar/one.txt"), "1");
  EXPECT_EQ(content(parent / "avatar/deep/er/two.txt"), "22");
  EXPECT_EQ(folder->commit().error().code, ErrorCode::invalid_state);
  EXPECT_EQ(folder->write("late.txt", "3").error().code, ErrorCode::invalid_state);
}

TEST(DurableFolder, LeavesNothingWithoutCommit) {
  const ScratchFolder scratch;
  {
    auto folder = DurableFolder::begin(scratch.path(), "avatar");
    ASSERT_TRUE(folder);
    EXPECT_TRUE(folder->write("one.txt", "1"));
    auto moved = *std::move(folder);
    EXPECT_TRUE(moved.write("two.txt", "2"));
  }
  EXPECT_TRUE(names_in(scratch.path()).empty());
}

TEST(DurableFolder, DoesNotReplaceWhatIsThere) {
  const ScratchFolder scratch;
  for (const char* text : {"first", "second"}) {
    auto folder = DurableFolder::begin(scratch.path(), "avatar");
    ASSERT_TRUE(folder);
    EXPECT_TRUE(folder->write("text", text));
    const auto committed = folder->commit();
    EXPECT_EQ(committed.ok(), std::string(text) == "first");
    if (!committed) {
      EXPECT_EQ(committed.error().code, ErrorCode::invalid_state);
    }
  }
  EXPECT_EQ(content(scratch.path() / "avatar/text"), "first");
  EXPECT_EQ(names_in(scratch.path()).size(), 1U);
}

TEST(DurableFolder, TakesThePlaceOfAnEmptyFolder) {
  const ScratchFolder scratch;
  fs::create_directory(scratch.path() / "out");
  auto folder = DurableFolder::begin(scratch.path(), "out");
  ASSERT_TRUE(folder);
  EXPECT_TRUE(folder->write("text", "here"));
  EXPECT_TRUE(folder->commit());
  EXPECT_EQ(content(scratch.path() / "out/text"), "here");
}

TEST(DurableFolder, RefusesNamesThatLeadElsewhere) {
  const ScratchFolder scratch;
  for (const char* name : {"", ".", "..", "a/b", "/etc", ".hidden", "a\nb"})
    EXPECT_EQ(DurableFolder::begin(scratch.path(), name).error().code, ErrorCode::invalid_argument) << name;
  auto folder = DurableFolder::begin(scratch.path(), "fine");
  ASSERT_TRUE(folder);
  for (const char* file : {"", "..", "../up", "a/../../up", "/etc/passwd", "a//b", "a/", "./a", "a\\b", "a\tb"})
    EXPECT_EQ(folder->write(file, "x").error().code, ErrorCode::invalid_argument) << file;
  EXPECT_EQ(remove_folder(scratch.path(), "../x").error().code, ErrorCode::invalid_argument);
}

TEST(DurableFolder, RefusesASecondFileOfTheSameName) {
  const ScratchFolder scratch;
  auto folder = DurableFolder::begin(scratch.path(), "avatar");
  ASSERT_TRUE(folder);
  EXPECT_TRUE(folder->write("one", "1"));
  EXPECT_EQ(folder->write("one", "2").error().code, ErrorCode::io);
}

TEST(DurableFolder, SeveralThreadsMayWrite) {
  const ScratchFolder scratch;
  auto folder = DurableFolder::begin(scratch.path(), "avatar");
  ASSERT_TRUE(folder);
  {
    std::vector<std::jthread> threads;
    for (int thread = 0; thread < 4; ++thread)
      threads.emplace_back([&, thread] {
        for (int i = 0; i < 10; ++i)
          EXPECT_TRUE(folder->write("shared/" + std::to_string(thread) + "-" + std::to_string(i), "x"));
      });
  }
  ASSERT_TRUE(folder->commit());
  EXPECT_EQ(names_in(scratch.path() / "avatar/shared").size(), 40U);
}

TEST(DurableFolder, AKilledProcessLeavesNothingVisible) {
  const ScratchFolder scratch;
  for (int step = 0; step < 3; ++step) {
    run_and_kill([&] {
      auto folder = DurableFolder::begin(scratch.path(), "avatar");
      if (step > 0) (void)folder->write("one", "1").ok();
      if (step > 1) (void)folder->write("two/three", "3").ok();
      (void)folder.ok();
      ::kill(::getpid(), SIGKILL);
    });
    EXPECT_FALSE(fs::exists(scratch.path() / "avatar")) << step;
    EXPECT_EQ(names_in(scratch.path()).size(), 1U) << step;
    EXPECT_EQ(*remove_partial_folders(scratch.path()), 1) << step;
    EXPECT_TRUE(names_in(scratch.path()).empty()) << step;
  }
  run_and_kill([&] { (void)DurableFolder::begin(scratch.path(), "avatar")->commit().ok(); });
  EXPECT_EQ(names_in(scratch.path()), std::vector<std::string>{"avatar"});
}

TEST(DurableFolder, WhatALivingProcessBuildsIsNotALeftover) {
  const ScratchFolder scratch;
  auto folder = DurableFolder::begin(scratch.path(), "avatar");
  ASSERT_TRUE(folder);
  EXPECT_EQ(*remove_partial_folders(scratch.path()), 0);
  EXPECT_TRUE(folder->write("one", "1"));
  EXPECT_TRUE(folder->commit());
  EXPECT_EQ(content(scratch.path() / "avatar/one"), "1");
}

TEST(DurableFolder, NoFolderHasNoLeftovers) {
  const ScratchFolder scratch;
  EXPECT_EQ(*remove_partial_folders(scratch.path() / "absent"), 0);
}

TEST(DurableFolder, SaysWhereItCannotWrite) {
  const ScratchFolder scratch;
  ASSERT_TRUE(write_file_atomically(scratch.path() / "file", "x"));
  const auto folder = DurableFolder::begin(scratch.path() / "file", "avatar");
  ASSERT_FALSE(folder);
  EXPECT_EQ(folder.error().code, ErrorCode::io);
  EXPECT_NE(folder.error().message.find((scratch.path() / "file").string()), std::string::npos);
}

TEST(RemoveFolder, RemovesEverythingAndMayBeRepeated) {
  const ScratchFolder scratch;
  auto folder = DurableFolder::begin(scratch.path(), "avatar");
  ASSERT_TRUE(folder->write("deep/er/file", "x"));
  ASSERT_TRUE(folder->commit());
  EXPECT_TRUE(remove_folder(scratch.path(), "avatar"));
  EXPECT_TRUE(names_in(scratch.path()).empty());
  EXPECT_TRUE(remove_folder(scratch.path(), "avatar"));
  EXPECT_TRUE(remove_folder(scratch.path() / "absent", "avatar"));
}

TEST(WriteFileAtomically, ReplacesTheWholeFile) {
  const ScratchFolder scratch;
  const fs::path file = scratch.path() / "state.json";
  EXPECT_TRUE(write_file_atomically(file, "a long first text"));
  EXPECT_TRUE(write_file_atomically(file, "second"));
  EXPECT_EQ(content(file), "second");
  EXPECT_EQ(names_in(scratch.path()).size(), 1U);
  const auto failed = write_file_atomically(scratch.path() / "absent" / "file", "x");
  EXPECT_EQ(failed.error().code, ErrorCode::io);
}

TEST(ReadFile, RefusesWhatIsNotAFile) {
  const ScratchFolder scratch;
  EXPECT_EQ(read_file(scratch.path() / "absent", 10).error().code, ErrorCode::not_found);
  EXPECT_EQ(read_file(scratch.path(), 10).error().code, ErrorCode::invalid_file);
  ASSERT_EQ(::mkfifo((scratch.path() / "pipe").c_str(), 0600), 0);
  EXPECT_EQ(read_file(scratch.path() / "pipe", 10).error().code, ErrorCode::invalid_file);
  ASSERT_TRUE(write_file_atomically(scratch.path() / "file", "0123456789"));
  EXPECT_EQ(read_file(scratch.path() / "file", 10)->size(), 10U);
  EXPECT_EQ(read_file(scratch.path() / "file", 9).error().code, ErrorCode::invalid_file);
}

/// Files of /proc say that they have no bytes.
TEST(ReadFile, ReadsFilesThatDoNotKnowTheirSize) {
  EXPECT_GT(read_file("/proc/self/status", 1 << 20)->size(), 100U);
  EXPECT_EQ(read_file("/proc/self/status", 16).error().code, ErrorCode::invalid_file);
}

/// A small file system that can be filled; needs the right to mount.
class FullDisk : public testing::Test {
 protected:
  void SetUp() override {
    if (::mount("none", scratch_.path().c_str(), "tmpfs", 0, "size=256k") != 0)
      GTEST_SKIP() << "mounting is not permitted";
    mounted_ = true;
  }
  void TearDown() override {
    if (mounted_) ::umount2(scratch_.path().c_str(), MNT_DETACH);
  }
  ScratchFolder scratch_;
  bool mounted_ = false;
};

TEST_F(FullDisk, IsSaidAndLeavesNothing) {
  const std::vector<uint8_t> much(1 << 20, 7);
  {
    auto folder = DurableFolder::begin(scratch_.path(), "avatar");
    ASSERT_TRUE(folder) << folder.error().message;
    const auto written = folder->write("image.png", much);
    ASSERT_FALSE(written);
    EXPECT_EQ(written.error().code, ErrorCode::disk_full);
    EXPECT_NE(written.error().message.find("image.png"), std::string::npos);
  }
  EXPECT_TRUE(names_in(scratch_.path()).empty());

  ASSERT_TRUE(write_file_atomically(scratch_.path() / "state", "old"));
  EXPECT_EQ(write_file_atomically(scratch_.path() / "state", much).error().code, ErrorCode::disk_full);
  EXPECT_EQ(content(scratch_.path() / "state"), "old");
  EXPECT_EQ(names_in(scratch_.path()).size(), 1U);
}

}  // namespace
}  // namespace booth
