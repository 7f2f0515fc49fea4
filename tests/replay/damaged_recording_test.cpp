// Nothing that can be done to a recording's files may do more than lead to one clear sentence.

#include <gtest/gtest.h>

#include <fstream>
#include <nlohmann/json.hpp>
#include <random>

#include "replay/durable_folder.h"
#include "replay/recording.h"
#include "tests/replay/scratch_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

const fs::path mini = fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini";

bool is_one_line(const std::string& text) {
  return !text.empty() && text.size() < 500 &&
         std::none_of(text.begin(), text.end(), [](unsigned char c) { return c < 0x20; });
}

/// File systems flush a file that is cut to nothing, and not one that is new: hundreds of writes are faster so.
void write_new(const fs::path& file, std::string_view content) {
  fs::remove(file);
  std::ofstream(file, std::ios::binary) << content;
}

/// Reads and loads everything, as a job would; what it says about faults.
struct Outcome {
  std::string refusal;              ///< of the recording as a whole
  std::vector<std::string> faults;  ///< of single frames
};

Outcome load_all(const fs::path& folder) {
  const auto recording = read_recording(folder);
  if (!recording) return {recording.error().message, {}};
  Outcome outcome;
  for (const Shot& shot : recording->shots)
    for (std::string& fault : load_shot(*recording, shot).faults) outcome.faults.push_back(std::move(fault));
  return outcome;
}

class DamagedRecording : public testing::Test {
 protected:
  DamagedRecording() : folder_(scratch_.path() / "copy") {
    fs::copy(mini, folder_, fs::copy_options::recursive);
    fs::remove_all(folder_ / "truth");
    for (const auto& entry : fs::recursive_directory_iterator(folder_))
      if (entry.is_regular_file()) files_.push_back(fs::relative(entry.path(), folder_).string());
    std::sort(files_.begin(), files_.end());
  }

  std::vector<uint8_t> bytes(const std::string& file) const { return *read_file(mini / file, 1 << 24); }
  void write(const std::string& file, std::span<const uint8_t> content) const {
    write_new(folder_ / file, {reinterpret_cast<const char*>(content.data()), content.size()});
  }

  /// A damaged file is either named by the refusal, or by just one fault.
  void expect_named(const std::string& file, const std::string& what) const {
    const Outcome outcome = load_all(folder_);
    if (file.ends_with(".json")) {
      EXPECT_NE(outcome.refusal.find(file), std::string::npos) << file << " " << what << ": " << outcome.refusal;
      EXPECT_TRUE(is_one_line(outcome.refusal)) << outcome.refusal;
    } else {
      EXPECT_EQ(outcome.refusal, "") << file << " " << what;
      ASSERT_EQ(outcome.faults.size(), 1U) << file << " " << what;
      EXPECT_EQ(outcome.faults[0].find(file), 0U) << outcome.faults[0];
      EXPECT_TRUE(is_one_line(outcome.faults[0])) << outcome.faults[0];
    }
  }

  ScratchFolder scratch_;
  const fs::path folder_;
  std::vector<std::string> files_;
};

TEST_F(DamagedRecording, EveryMissingFileIsNamed) {
  for (const std::string& file : files_) {
    fs::remove(folder_ / file);
    expect_named(file, "deleted");
    fs::create_directory(folder_ / file);
    expect_named(file, "replaced by a folder");
    fs::remove(folder_ / file);
    write(file, bytes(file));
  }
}

TEST_F(DamagedRecording, EveryTruncatedFileIsNamed) {
  for (const std::string& file : files_) {
    const auto whole = bytes(file);
    for (const size_t length : {size_t{0}, size_t{1}, whole.size() / 2, whole.size() - 3}) {
      write(file, std::span(whole).first(length));
      expect_named(file, "cut to " + std::to_string(length));
    }
    write(file, whole);
  }
}

TEST_F(DamagedRecording, EveryFileOfNoiseIsNamed) {
  std::mt19937 random(7);
  for (const std::string& file : files_) {
    const auto whole = bytes(file);
    auto noise = whole;
    for (uint8_t& byte : noise) byte = static_cast<uint8_t>(random());
    write(file, noise);
    expect_named(file, "noise");
    write(file, whole);
  }
}

/// Single changed bytes may pass unnoticed, or not; nothing else may happen.
TEST_F(DamagedRecording, ScrambledBytesNeverDoMore) {
  std::mt19937 random(11);
  for (const std::string& file : files_) {
    const auto whole = bytes(file);
    for (int round = 0; round < 6; ++round) {
      auto scrambled = whole;
      for (int i = 0; i < 1 << round; ++i) scrambled[random() % scrambled.size()] = static_cast<uint8_t>(random());
      write(file, scrambled);
      const Outcome outcome = load_all(folder_);
      if (!outcome.refusal.empty()) {
        EXPECT_TRUE(is_one_line(outcome.refusal)) << outcome.refusal;
      }
      for (const std::string& fault : outcome.faults) EXPECT_TRUE(is_one_line(fault)) << fault;
    }
    write(file, whole);
  }
}

/// Calls `visit` with every value in `json`, containers included.
template <class Visit>
void for_each_value(Json& json, const Visit& visit) {
  visit(json);
  if (json.is_structured())
    for (Json& element : json) for_each_value(element, visit);
}

/// Keeps two of each array of objects: cameras and frames all have the same fields, so two tell as much as all.
void shorten(Json& json) {
  for_each_value(json, [](Json& value) {
    if (value.is_array() && value.size() > 2 && value[0].is_object()) value.erase(value.begin() + 2, value.end());
  });
}

/// Every value of the file, one after the other, is replaced by values of other kinds and sizes.
void replace_every_value(const fs::path& folder, const std::string& file) {
  const auto original = *read_file(mini / file, 1 << 24);
  Json json = Json::parse(original.begin(), original.end());
  shorten(json);
  const Json others[] = {nullptr,
                         "text",
                         "",
                         -1,
                         1e308,
                         1e-308,
                         0,
                         true,
                         Json::array(),
                         Json::object(),
                         std::string(5000, 'x'),
                         Json::array({1, 2, 3}),
                         18446744073709551615U};
  size_t values = 0;
  const auto mutate = [&](Json& value) {
    ++values;
    for (const Json& other : others) {
      Json kept = other;
      std::swap(value, kept);
      write_new(folder / file, json.dump(1));
      std::swap(value, kept);
      const auto recording = read_recording(folder);
      if (recording) {
        EXPECT_TRUE(check(recording->rig));
      } else {
        EXPECT_TRUE(is_one_line(recording.error().message)) << recording.error().message;
        EXPECT_NE(recording.error().message.find(".json"), std::string::npos) << recording.error().message;
      }
    }
  };
  for_each_value(json, mutate);
  EXPECT_GT(values, 40U);
  write_new(folder / file, std::string(original.begin(), original.end()));
}

TEST(MutatedRecording, EveryValueMayBeAnything) {
  const ScratchFolder scratch;
  const fs::path folder = scratch.path() / "copy";
  fs::create_directory(folder);
  for (const char* file : {"recording.json", "rig.json"}) fs::copy(mini / file, folder / file);
  for (const char* file : {"recording.json", "rig.json"}) replace_every_value(folder, file);
}

}  // namespace
}  // namespace booth
