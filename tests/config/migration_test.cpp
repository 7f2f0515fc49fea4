#include "config/migration.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <fstream>

#include "config/booth_config.h"
#include "replay/durable_folder.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

/// As version 1 was shipped, with an operator's own settings.
constexpr const char* version_1 = R"(# My booth. [drivers] is the section of drivers.
[booth]
name = "a [drivers] booth"            # shown to operators
state_directory = "/srv/booth"

[log]
level = "debug"

# Cameras, trigger and projector.
[drivers]
camera = "replay"          # "replay": cameras, trigger and projector are played back from a recording

# What is played.
[replay]
recording = "/srv/recordings/mini"
)";

std::string text_of(const fs::path& file) {
  const auto bytes = read_file(file, 1 << 20);
  return bytes ? std::string(bytes->begin(), bytes->end()) : std::string();
}

class Migration : public testing::Test {
 protected:
  void write(const std::string& text) { std::ofstream(file_) << text; }
  fs::path backup(int number) const { return file_.string() + ".bak-" + std::to_string(number); }
  const ScratchFolder folder_;
  const fs::path file_ = folder_.path() / "boothd.toml";
};

TEST_F(Migration, AnOlderConfigurationMeansTheSameAfterwards) {
  const auto migrated = migrate_config(version_1);
  ASSERT_TRUE(migrated && *migrated);
  EXPECT_EQ((*migrated)->from, 1);
  const std::string text = (*migrated)->text;
  EXPECT_THAT(text, HasSubstr("version = 2\n"));
  EXPECT_THAT(text, Not(HasSubstr("\n[drivers]")));
  for (const char* kept :
       {"# My booth. [drivers] is the section of drivers.", "a [drivers] booth", "# What is played."})
    EXPECT_THAT(text, HasSubstr(kept));
  for (const std::string& read : {std::string(version_1), text}) {
    const auto reading = parse_config(read, "/etc/booth");
    EXPECT_THAT(reading.faults, IsEmpty());
    EXPECT_EQ(reading.config.booth.state_directory, "/srv/booth");
    EXPECT_EQ(reading.config.replay.recording, "/srv/recordings/mini");
    EXPECT_EQ(reading.config.log.level, LogLevel::debug);
  }
  EXPECT_FALSE(*migrate_config(text)) << "once is enough";
}

TEST_F(Migration, EveryWayToWriteTheOldSectionIsUnderstood) {
  for (const char* text : {"[drivers]\n", "drivers.camera = \"replay\"\n[log]\nlevel = \"debug\"\n",
                           "drivers = { camera = \"replay\" }\n", "[ drivers ] # which\ncamera=\"replay\"\n[log]\n"}) {
    const auto migrated = migrate_config(text);
    ASSERT_TRUE(migrated && *migrated) << text;
    EXPECT_THAT(parse_config((*migrated)->text, "/etc/booth").faults, IsEmpty()) << text;
  }
}

TEST_F(Migration, WhatIsNoOlderConfigurationIsLeftAlone) {
  for (const char* text :
       {"", "[log]\nlevel = \"debug\"\n", "version = 2\n[drivers]\ncamera = \"replay\"\n", "not = = toml",
        "[drivers]\ncamera = \"v4l2\"\n", "[drivers]\nlens = \"replay\"\n", "drivers = 7\n", "version = \"3\"\n",
        // Not a header, but text: nothing of it may be lost.
        "[booth]\nname = '''\n[drivers]\ncamera'''\n[drivers]\ncamera = \"replay\"\n"}) {
    const auto migrated = migrate_config(text);
    ASSERT_TRUE(migrated) << text;
    EXPECT_FALSE(*migrated) << text;
    write(text);
    EXPECT_EQ(*migrate_config_file(file_), "");
    EXPECT_EQ(text_of(file_), text);
    EXPECT_FALSE(fs::exists(backup(1)));
  }
}

TEST_F(Migration, ANewerConfigurationIsRefusedInASentence) {
  write("version = 3\n[lasers]\ncount = 4\n");
  const auto migrated = migrate_config_file(file_);
  ASSERT_FALSE(migrated);
  EXPECT_EQ(migrated.error().code, ErrorCode::unsupported);
  EXPECT_THAT(migrated.error().message, HasSubstr("boothd.toml: version: 3, expected at most 2: it was written for"));
  const auto loaded = load_config(file_);
  ASSERT_FALSE(loaded);
  EXPECT_EQ(loaded.error().message, migrated.error().message);
  EXPECT_FALSE(fs::exists(backup(1)));
}

TEST_F(Migration, TheOriginalIsKeptAndItsPermissionsToo) {
  write(version_1);
  ASSERT_EQ(::chmod(file_.c_str(), 0640), 0);
  std::ofstream(backup(1)) << "of an earlier migration";
  const auto migrated = migrate_config_file(file_);
  ASSERT_TRUE(migrated) << migrated.error().message;
  EXPECT_EQ(*migrated,
            file_.string() + ": migrated from version 1 to 2; the original is kept as " + backup(2).string());
  EXPECT_EQ(text_of(backup(1)), "of an earlier migration");
  EXPECT_EQ(text_of(backup(2)), version_1);
  EXPECT_EQ(text_of(file_), (*migrate_config(version_1))->text);
  EXPECT_EQ(fs::status(file_).permissions(), fs::perms(0640));
  EXPECT_EQ(fs::status(backup(2)).permissions(), fs::perms(0640));
  EXPECT_EQ(*migrate_config_file(file_), "") << "once is enough";
}

TEST_F(Migration, OneThatWasInterruptedGoesOnWithItsCopy) {
  write(version_1);
  std::ofstream(backup(1)) << version_1;
  ASSERT_TRUE(migrate_config_file(file_));
  EXPECT_FALSE(fs::exists(backup(2)));
  EXPECT_EQ(load_config(file_)->booth.name, "a [drivers] booth");
}

TEST_F(Migration, ALinkStaysOne) {
  write(version_1);
  const fs::path link = folder_.path() / "link.toml";
  fs::create_symlink(file_, link);
  ASSERT_TRUE(migrate_config_file(link));
  EXPECT_TRUE(fs::is_symlink(link));
  EXPECT_FALSE(*migrate_config(text_of(file_)));
}

}  // namespace
}  // namespace booth
