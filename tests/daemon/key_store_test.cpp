#include "daemon/api/key_store.h"

#include <gtest/gtest.h>
#include <spdlog/spdlog.h>

#include <atomic>
#include <fstream>
#include <nlohmann/json.hpp>
#include <thread>

#include "tests/replay/scratch_folder.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;

class KeyStoreTest : public testing::Test {
 protected:
  void SetUp() override { spdlog::set_level(spdlog::level::off); }
  void open() {
    auto opened = KeyStore::open(file_, now_);
    ASSERT_TRUE(opened) << opened.error().message;
    store_ = std::move(*opened);
  }
  static std::string key_of(int number) { return "press-" + std::to_string(number); }
  void remember(int number) { store_->remember(key_of(number), "capture.start", params_, answer_of(number), now_); }
  static std::string answer_of(int number) { return Json{{"capture", number}}.dump(); }
  bool knows(int number) {
    const auto found = store_->find(key_of(number), "capture.start", params_, now_);
    const auto* const answer = std::get_if<std::string>(&found);
    return answer != nullptr && *answer == answer_of(number);
  }
  size_t lines() const {
    std::ifstream stream(file_);
    size_t count = 0;
    for (std::string line; std::getline(stream, line);) ++count;
    return count;
  }

  const ScratchFolder folder_;
  const std::filesystem::path file_ = folder_.path() / "keys.jsonl";
  const Json params_ = {{"face", "auto"}};
  KeyStore::Clock::time_point now_ = std::chrono::sys_days(std::chrono::year(2026) / 11 / 22);
  std::unique_ptr<KeyStore> store_;
};

TEST_F(KeyStoreTest, RemembersADayAcrossRestarts) {
  open();
  remember(1);
  EXPECT_TRUE(knows(1));
  EXPECT_TRUE(std::holds_alternative<KeyStore::OtherRequest>(
      store_->find(key_of(1), "capture.start", Json{{"face", "none"}}, now_)));
  now_ += std::chrono::hours(23);
  open();
  EXPECT_TRUE(knows(1));
  now_ += std::chrono::hours(2);
  EXPECT_FALSE(knows(1));
  open();
  EXPECT_EQ(lines(), 0);
}

TEST_F(KeyStoreTest, TheJournalDoesNotGrowForMonths) {
  open();
  constexpr int a_day = 1500;
  size_t most = 0;
  for (int day = 0; day < 5; ++day) {
    for (int i = 0; i < a_day; ++i) remember(day * a_day + i);
    EXPECT_TRUE(knows(day * a_day));
    store_->sync();
    most = std::max(most, lines());
    EXPECT_TRUE(knows(day * a_day + a_day - 1));
    now_ += std::chrono::hours(25);
  }
  EXPECT_LE(most, 2 * a_day + 1000);
  now_ -= std::chrono::hours(25);
  open();
  for (int i = 0; i < a_day; ++i) EXPECT_TRUE(knows(4 * a_day + i));
}

TEST_F(KeyStoreTest, NothingIsLostThatComesWhileTheJournalIsWrittenAnew) {
  open();
  constexpr int ended = 3500, kept = 2000;
  for (int i = 0; i < ended; ++i) remember(i);
  now_ += std::chrono::hours(25);
  EXPECT_FALSE(knows(0));
  std::atomic<bool> all = false;
  std::jthread syncing([&] {
    while (!all) store_->sync();
  });
  for (int i = 0; i < kept; ++i) remember(ended + i);
  all = true;
  syncing.join();
  store_->sync();
  EXPECT_LT(lines(), ended + kept) << "it was written anew";
  open();
  for (int i = 0; i < kept; ++i) EXPECT_TRUE(knows(ended + i)) << i;
}

TEST_F(KeyStoreTest, ATimeThatIsNoneIsDropped) {
  for (const char* until : {"1e300", "-1", "9223372036854775807", "18446744073709551615", "\"soon\"", "null"})
    std::ofstream(file_, std::ios::app) << R"({"key": "press-1", "digest": "d", "result": "{}", "until": )" << until
                                        << "}\n";
  open();
  EXPECT_FALSE(knows(1));
  EXPECT_EQ(lines(), 0U);
}

TEST_F(KeyStoreTest, ALineThatWasTornIsDroppedAndTheSuccessorOfAKilledProcessToo) {
  open();
  remember(1);
  std::ofstream(file_, std::ios::app) << "{\"key\": \"press-2";
  std::ofstream(file_.string() + ".next") << "anything";
  open();
  EXPECT_TRUE(knows(1));
  EXPECT_FALSE(knows(2));
  EXPECT_FALSE(std::filesystem::exists(file_.string() + ".next"));
}

}  // namespace
}  // namespace booth::api
