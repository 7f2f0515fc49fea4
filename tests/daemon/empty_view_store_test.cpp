#include "daemon/empty_view_store.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <fstream>
#include <string>
#include <vector>

namespace booth {
namespace {

namespace fs = std::filesystem;

class EmptyViewStoreTest : public testing::Test {
 protected:
  EmptyViewStoreTest() {
    fs::create_directories(folder_);
    fs::copy(fs::path(BOOTH_SOURCE_DIR) / "replay/recordings/mini", folder_ / "recording", fs::copy_options::recursive);
    recording_ = read_recording(folder_ / "recording").value();
  }
  ~EmptyViewStoreTest() override { fs::remove_all(folder_); }

  const Shot& background() const { return *recording_.find(ShotRole::background); }
  EmptyBooth learn(const EmptyViewStore* store) const { return learn_background(recording_, background(), store); }
  /// Overwrites the middle of each kept file, or cuts it off there.
  void damage(bool cut) const {
    for (const auto& file : fs::directory_iterator(cache_)) {
      const auto middle = fs::file_size(file) / 2;
      if (cut) fs::resize_file(file, middle);
      std::fstream bytes(file.path(), std::ios::in | std::ios::out | std::ios::binary);
      bytes.seekp(static_cast<std::streamoff>(middle));
      bytes << "torn";
    }
  }

  fs::path folder_ = fs::temp_directory_path() / ("empty-view-store-" + std::to_string(getpid()));
  fs::path cache_ = folder_ / "cache";
  EmptyViewStore store_{cache_};
  Recording recording_;
};

void expect_same(const EmptyBooth& a, const EmptyBooth& b) {
  EXPECT_EQ(a.faults, b.faults);
  ASSERT_EQ(a.views.size(), b.views.size());
  for (size_t i = 0; i < a.views.size(); ++i) {
    EXPECT_EQ(a.views[i].camera, b.views[i].camera);
    EXPECT_EQ(a.views[i].mean.width, b.views[i].mean.width);
    EXPECT_EQ(a.views[i].mean.samples, b.views[i].mean.samples);
    EXPECT_EQ(a.views[i].flicker, b.views[i].flicker);
  }
}

TEST_F(EmptyViewStoreTest, GivesBackWhatWasLearnedWithoutTheFrames) {
  const EmptyBooth learned = learn(nullptr);
  ASSERT_EQ(learned.views.size(), 8U);
  EXPECT_FALSE(fs::exists(cache_));
  expect_same(learn(&store_), learned);
  // A frame is overwritten in a way that leaves its size and time: nobody reads it again.
  const fs::path frame = recording_.folder / background().frames[0].file;
  const auto time = fs::last_write_time(frame);
  const auto size = fs::file_size(frame);
  { std::ofstream(frame, std::ios::binary | std::ios::in) << std::string(size, ' '); }
  fs::last_write_time(frame, time);
  expect_same(learn(&store_), learned);
}

TEST_F(EmptyViewStoreTest, LearnsAnewWhatAnotherFileShows) {
  const EmptyBooth learned = learn(&store_);
  const fs::path frame = recording_.folder / background().frames[0].file;
  fs::copy_file(recording_.folder / background().frames[1].file, folder_ / "other.jpg");
  fs::rename(folder_ / "other.jpg", frame);
  const EmptyBooth anew = learn(&store_);
  ASSERT_EQ(anew.views.size(), learned.views.size());
  EXPECT_NE(anew.views[0].mean.samples, learned.views[0].mean.samples);
  EXPECT_EQ(anew.views[1].mean.samples, learned.views[1].mean.samples);
}

TEST_F(EmptyViewStoreTest, KnowsALinkToTheSameFile) {
  const EmptyBooth learned = learn(&store_);
  Recording linked = recording_;
  linked.folder = folder_ / "linked";
  for (const FrameRecord& frame : background().frames) {
    fs::create_directories((linked.folder / frame.file).parent_path());
    fs::create_hard_link(recording_.folder / frame.file, linked.folder / frame.file);
    EXPECT_TRUE(store_.find(linked, std::vector{frame})) << frame.file;
  }
}

TEST_F(EmptyViewStoreTest, LearnsAnewWhatIsDamaged) {
  const EmptyBooth learned = learn(&store_);
  for (const bool cut : {false, true}) {
    damage(cut);
    EXPECT_FALSE(store_.find(recording_, std::vector{background().frames[0]}));
    expect_same(learn(&store_), learned);
    EXPECT_TRUE(store_.find(recording_, std::vector{background().frames[0]}));
  }
}

TEST_F(EmptyViewStoreTest, TellsAFaultEachTimeAndKeepsNothingOfThatCamera) {
  std::ofstream(recording_.folder / background().frames[0].file) << "no image";
  for (int time = 0; time < 2; ++time) {
    const EmptyBooth learned = learn(&store_);
    EXPECT_EQ(learned.views.size(), 7U);
    ASSERT_EQ(learned.faults.size(), 1U);
    EXPECT_NE(learned.faults[0].find(background().frames[0].file), std::string::npos);
  }
}

TEST_F(EmptyViewStoreTest, SaysWhatCannotBeKeptAndGoesOn) {
  std::ofstream(cache_) << "a file where the folder should be";
  const EmptyBooth learned = learn(&store_);
  EXPECT_EQ(learned.views.size(), 8U);
  ASSERT_EQ(learned.faults.size(), 8U);
  EXPECT_NE(learned.faults[0].find(cache_.string()), std::string::npos);
}

TEST_F(EmptyViewStoreTest, ForgetsWhatWasLongestUnused) {
  learn(&store_);
  const auto bytes_of_one = fs::file_size(fs::directory_iterator(cache_)->path());
  int age = 0;
  for (const auto& file : fs::directory_iterator(cache_))
    fs::last_write_time(file, fs::file_time_type::clock::now() - std::chrono::hours(++age));
  const std::vector first{background().frames[0]};
  ASSERT_TRUE(store_.find(recording_, first));  // used just now
  const EmptyViewStore small(cache_, 3 * bytes_of_one);
  ASSERT_TRUE(small.keep(recording_, std::vector{background().frames[1]},
                         *store_.find(recording_, std::vector{background().frames[1]})));
  EXPECT_EQ(std::distance(fs::directory_iterator(cache_), fs::directory_iterator()), 3);
  EXPECT_TRUE(small.find(recording_, first));
}

}  // namespace
}  // namespace booth
