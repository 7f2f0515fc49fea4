// The masks of recordings whose truth is known; recordings as in avatar_quality_test.cpp.

#include <gtest/gtest.h>

#include <algorithm>
#include <iostream>

#include "pipeline/segmentation/segmentation.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"
#include "tests/quality/measures.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

class MaskQuality : public testing::TestWithParam<const char*> {};

TEST_P(MaskQuality, ReachesTheFloors) {
  const auto folder = find_recording(GetParam());
  if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
  ThreadPool pool;
  const Work work = pool.work();
  const Recording recording = read_recording(*folder).value();
  const auto background = load_shot(recording, *recording.find(ShotRole::background), work).sets;
  const FrameSet body = load_shot(recording, *recording.find(ShotRole::body), work).sets.at(0);
  double mean = 0, soft_mean = 0;
  for (const Frame& frame : body.frames) {
    std::vector<Frame> empty;
    for (const FrameSet& set : background)
      for (const Frame& other : set.frames)
        if (other.camera == frame.camera) empty.push_back(other);
    const auto made = segment(empty, frame, {});
    ASSERT_TRUE(made.ok()) << made.error().message;
    EXPECT_TRUE(made->warnings.empty()) << made->warnings.front();
    const MaskAgreement agreement =
        compare_masks(made->silhouette.coverage, read_image(*folder / "truth/masks" / (frame.camera + ".png")));
    EXPECT_GE(agreement.iou, 0.985) << frame.camera;
    EXPECT_GE(agreement.soft_iou, 0.975) << frame.camera;
    mean += agreement.iou / static_cast<double>(body.frames.size());
    soft_mean += agreement.soft_iou / static_cast<double>(body.frames.size());
    RecordProperty("iou_" + frame.camera, std::to_string(agreement.iou));
  }
  EXPECT_GE(mean, 0.988);
  EXPECT_GE(soft_mean, 0.98);
  std::cout << GetParam() << ": mean IoU of the masks " << mean << ", of coverage " << soft_mean << "\n";
}

INSTANTIATE_TEST_SUITE_P(Recordings, MaskQuality, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
