#include "pipeline/export/metadata.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <functional>
#include <nlohmann/json.hpp>
#include <string>

#include "pipeline/export/sha256.h"

namespace booth {
namespace {

using testing::HasSubstr;

AvatarMetadata example() {
  return {.id = "2026-11-22T10-15-00Z-7f3a",
          .created = "2026-11-22T10:15:00Z",
          .label = "Zoë \"Z\" \\ <b>",
          .recording = "2026-11-22T10-14-00Z-11aa",
          .software_version = "1.2.3",
          .cameras = {"body-00", "body-01"},
          .texture_method = "full",
          .triangles = 19998,
          .joints = 23,
          .stage_seconds = {{"segmentation", 0.25}, {"hull", 0.125}},
          .warnings = {"body-03 was overruled."},
          .files = {{"texture.png", 12, std::string(64, 'a')}, {"avatar.dae", 5'000'000'000, std::string(64, '0')}}};
}

std::string digest(const std::string& text) {
  return sha256_hex(std::span(reinterpret_cast<const uint8_t*>(text.data()), text.size()));
}

TEST(Metadata, ComesBack) {
  const AvatarMetadata written = example();
  const auto read = read_metadata(write_metadata(written));
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->id, written.id);
  EXPECT_EQ(read->created, written.created);
  EXPECT_EQ(read->label, written.label);
  EXPECT_EQ(read->recording, written.recording);
  EXPECT_EQ(read->software_version, written.software_version);
  EXPECT_EQ(read->texture_method, written.texture_method);
  EXPECT_EQ(read->cameras, written.cameras);
  EXPECT_EQ(read->triangles, written.triangles);
  EXPECT_EQ(read->joints, written.joints);
  EXPECT_EQ(read->stage_seconds, written.stage_seconds);
  EXPECT_EQ(read->warnings, written.warnings);
  ASSERT_EQ(read->files.size(), 2U);
  EXPECT_EQ(read->files[0].name, "texture.png") << "in the order given";
  EXPECT_EQ(read->files[1].size, 5'000'000'000U);
  EXPECT_EQ(read->files[1].sha256, std::string(64, '0'));
  EXPECT_EQ(write_metadata(*read), write_metadata(written));
}

TEST(Metadata, IgnoresWhatItDoesNotKnowAndMissesWhatItNeedNotHave) {
  const auto read = read_metadata(R"({"id": "a", "created": "b", "recording": "c", "software_version": "d",
                                      "triangles": 1, "joints": 0, "news": [1, {"x": null}]})");
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->triangles, 1U);
  EXPECT_TRUE(read->files.empty());
}

TEST(Metadata, NamesTheKeyThatIsWrong) {
  const auto message = [](const std::function<void(nlohmann::json&)>& spoil) {
    nlohmann::json json = nlohmann::json::parse(write_metadata(example()));
    spoil(json);
    const auto read = read_metadata(json.dump());
    if (read) return std::string();
    EXPECT_EQ(read.error().code, ErrorCode::invalid_file);
    return read.error().message;
  };
  EXPECT_THAT(message([](auto& json) { json.erase("id"); }), HasSubstr("id must be a string"));
  EXPECT_THAT(message([](auto& json) { json["created"] = 5; }), HasSubstr("created"));
  EXPECT_THAT(message([](auto& json) { json["label"] = nullptr; }), HasSubstr("label"));
  EXPECT_THAT(message([](auto& json) { json["triangles"] = -1; }), HasSubstr("triangles"));
  EXPECT_THAT(message([](auto& json) { json["triangles"] = 1.5; }), HasSubstr("triangles"));
  EXPECT_THAT(message([](auto& json) { json["cameras"] = "body-00"; }), HasSubstr("cameras"));
  EXPECT_THAT(message([](auto& json) { json["cameras"][1] = 7; }), HasSubstr("cameras"));
  EXPECT_THAT(message([](auto& json) { json["stage_seconds"]["hull"] = "slow"; }), HasSubstr("stage_seconds"));
  EXPECT_THAT(message([](auto& json) { json["files"] = nlohmann::json::array(); }), HasSubstr("files"));
  EXPECT_THAT(message([](auto& json) { json["files"]["avatar.dae"] = 1; }), HasSubstr("files"));
  EXPECT_THAT(message([](auto& json) { json["files"]["avatar.dae"].erase("sha256"); }), HasSubstr("sha256"));
}

TEST(Metadata, RefusesWhatIsNoJsonObject) {
  const std::string whole = write_metadata(example());
  for (size_t length = 0; length + 2 < whole.size(); ++length)
    ASSERT_FALSE(read_metadata(std::string_view(whole).substr(0, length))) << length;
  for (const char* text : {"[]", "3", "null", "\"id\"", "{\"id\": \"\xff\"}"})
    EXPECT_FALSE(read_metadata(text)) << text;
  EXPECT_FALSE(read_metadata(std::string(100'000, '[')));
}

TEST(Metadata, ReplacesBytesThatAreNotUtf8) {
  AvatarMetadata metadata = example();
  metadata.label = "a\xff";
  const auto read = read_metadata(write_metadata(metadata));
  ASSERT_TRUE(read);
  EXPECT_EQ(read->label, "a\xef\xbf\xbd");
}

// NIST's examples for FIPS 180-4.
TEST(Sha256, OfKnownTexts) {
  EXPECT_EQ(digest(""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  EXPECT_EQ(digest("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  EXPECT_EQ(digest("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq"),
            "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  EXPECT_EQ(digest(std::string(1'000'000, 'a')), "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

}  // namespace
}  // namespace booth
