// The masks of recordings whose truth is known; recordings as in avatar_quality_test.cpp.

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <functional>
#include <iostream>
#include <memory>
#include <random>
#include <utility>

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

/// Photographs of a recording, changed as a booth may change; linear light.
class ChangedBooth {
 public:
  ChangedBooth(const Recording& recording, const std::filesystem::path& folder, const std::string& camera)
      : true_coverage_(read_image(folder / "truth/masks" / (camera + ".png"))) {
    const LoadedShot empty = load_shot(recording, *recording.find(ShotRole::background));
    for (const FrameSet& set : empty.sets)
      for (const Frame& frame : set.frames)
        if (frame.camera == camera) background.push_back(frame);
    const LoadedShot subject = load_shot(recording, *recording.find(ShotRole::body));
    for (const Frame& frame : subject.sets.at(0).frames)
      if (frame.camera == camera) body = frame;
  }

  std::vector<Frame> background;
  Frame body;

  using Colour = std::array<double, 3>;
  using Painter = std::function<Colour(int x, int y, const Colour& before)>;

  static Frame painted(const Frame& frame, const Painter& painter) {
    Frame made = frame;
    auto pixels = std::make_shared<Image>(*frame.pixels);
    for (int y = 0; y < pixels->height; ++y)
      for (int x = 0; x < pixels->width; ++x) {
        const Colour after = painter(x, y, colour(*frame.pixels, x, y));
        for (int c = 0; c < 3; ++c) pixels->at(x, y, c) = srgb(after[static_cast<size_t>(c)]);
      }
    made.pixels = std::move(pixels);
    return made;
  }

  /// Puts another booth behind the subject: what was seen of the old one is taken away.
  void replace_background(const std::function<Colour(int x, int y)>& other, double noise_levels) {
    const std::vector<Frame> before = background;
    std::mt19937 random(5);
    std::normal_distribution<double> grain(0, noise_levels);
    const auto grained = [&](Colour colour) {
      for (double& v : colour) v = linear(std::clamp(srgb(v) + grain(random), 0.0, 255.0));
      return colour;
    };
    for (Frame& frame : background)
      frame = painted(frame, [&](int x, int y, const Colour&) { return grained(other(x, y)); });
    body = painted(body, [&](int x, int y, const Colour& seen) {
      const double through = 1 - true_coverage_.at(x, y) / 255.0;
      const Colour added = grained(other(x, y));
      Colour mixed;
      for (size_t c = 0; c < 3; ++c) {
        double old = 0;
        for (const Frame& frame : before) old += colour(*frame.pixels, x, y)[c] / static_cast<double>(before.size());
        // The old booth's shadows are left out with it.
        mixed[c] = through == 1 ? added[c] : std::max(0.0, seen[c] - through * old) + through * added[c];
      }
      return mixed;
    });
  }

  /// Paints something behind the subject, where `there` says.
  void stand_behind(Frame* frame, const std::function<double(int x, int y)>& there,
                    const std::function<Colour(int x, int y)>& look) const {
    const bool with_subject = frame == &body;
    *frame = painted(*frame, [&](int x, int y, const Colour& seen) {
      const double share = there(x, y) * (with_subject ? 1 - true_coverage_.at(x, y) / 255.0 : 1);
      const Colour front = look(x, y);
      return Colour{seen[0] + share * (front[0] - seen[0]), seen[1] + share * (front[1] - seen[1]),
                    seen[2] + share * (front[2] - seen[2])};
    });
  }

  const Image& true_coverage() const { return true_coverage_; }

  static Colour colour(const Image& image, int x, int y) {
    return {linear(image.at(x, y, 0)), linear(image.at(x, y, 1)), linear(image.at(x, y, 2))};
  }

  /// What a change has come to: the mask is right, or the operator is told.
  void expect_right_or_reported(double least_iou) const {
    const auto made = segment(background, body, {});
    ASSERT_TRUE(made.ok()) << made.error().message;
    const double iou = compare_masks(made->silhouette.coverage, true_coverage_).iou;
    EXPECT_TRUE(iou >= least_iou || !made->warnings.empty()) << body.camera << ": IoU " << iou << " without a warning";
    std::cout << body.camera << ": IoU " << iou << (made->warnings.empty() ? "" : ", " + made->warnings.front())
              << "\n";
  }

 private:
  static double linear(double level) {
    const double v = level / 255;
    return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
  }
  static uint8_t srgb(double light) {
    const double l = std::clamp(light, 0.0, 1.0);
    return static_cast<uint8_t>(std::lround(255 * (l <= 0.0031308 ? 12.92 * l : 1.055 * std::pow(l, 1 / 2.4) - 0.055)));
  }

  Image true_coverage_;
};

class MaskOfChangedBooth : public testing::Test {
 protected:
  std::filesystem::path folder_ = find_recording("mini").value();
  Recording recording_ = read_recording(folder_).value();
  std::vector<ChangedBooth> booths() const {
    std::vector<ChangedBooth> made;
    for (const char* camera : {"body-00", "body-03"}) made.emplace_back(recording_, folder_, camera);
    return made;
  }
};

TEST_F(MaskOfChangedBooth, ACameraThatWasMovedIsRegisteredAndReported) {
  for (const auto& [dx, dy] : {std::pair{1.0, 0.0}, std::pair{-2.0, 1.0}, std::pair{1.5, -2.5}}) {
    for (ChangedBooth& booth : booths()) {
      for (Frame& frame : booth.background) {
        const std::shared_ptr<const Image> before = frame.pixels;
        frame = ChangedBooth::painted(frame, [&](int x, int y, const ChangedBooth::Colour&) {
          const double u = std::clamp(x - dx, 0.0, before->width - 1.001);
          const double v = std::clamp(y - dy, 0.0, before->height - 1.001);
          const int left = static_cast<int>(u), top = static_cast<int>(v);
          ChangedBooth::Colour sum{};
          for (const auto& [i, j] : {std::pair{0, 0}, std::pair{1, 0}, std::pair{0, 1}, std::pair{1, 1}}) {
            const double weight = (i == 1 ? u - left : 1 - u + left) * (j == 1 ? v - top : 1 - v + top);
            const auto corner = ChangedBooth::colour(*before, left + i, top + j);
            for (size_t c = 0; c < 3; ++c) sum[c] += weight * corner[c];
          }
          return sum;
        });
      }
      const auto made = segment(booth.background, booth.body, {});
      ASSERT_TRUE(made.ok()) << made.error().message;
      EXPECT_GE(compare_masks(made->silhouette.coverage, booth.true_coverage()).iou, 0.98) << dx << " " << dy;
      ASSERT_EQ(made->warnings.size(), 1U) << booth.body.camera << " " << dx << " " << dy;
      EXPECT_NE(made->warnings[0].find("moved"), std::string::npos) << made->warnings[0];
    }
  }
}

TEST_F(MaskOfChangedBooth, DriftOfGainAndWhiteBalanceIsCompensated) {
  for (ChangedBooth& booth : booths()) {
    booth.body = ChangedBooth::painted(booth.body, [](int, int, const ChangedBooth::Colour& seen) {
      return ChangedBooth::Colour{1.25 * seen[0], 1.2 * seen[1], 1.3 * seen[2]};
    });
    booth.expect_right_or_reported(0.98);
  }
}

TEST_F(MaskOfChangedBooth, AGreenBoothIsServedByTheSameModel) {
  for (ChangedBooth& booth : booths()) {
    booth.replace_background(
        [](int x, int y) {
          const double light = 0.8 + 0.0003 * x - 0.0002 * y;
          return ChangedBooth::Colour{0.05 * light, 0.45 * light, 0.09 * light};
        },
        1.0);
    const auto made = segment(booth.background, booth.body, {});
    ASSERT_TRUE(made.ok()) << made.error().message;
    EXPECT_GE(compare_masks(made->silhouette.coverage, booth.true_coverage()).iou, 0.98);
    EXPECT_TRUE(made->warnings.empty()) << made->warnings.front();
  }
}

TEST_F(MaskOfChangedBooth, AChairThatCameOrWentIsReported) {
  const auto chair = [](int x, int y) {
    const bool seat = x > 30 && x < 95 && y > 420 && y<440, back = x> 30 && x < 40 && y > 330 && y < 440;
    const bool legs = y >= 440 && y < 530 && ((x > 30 && x < 40) || (x > 85 && x < 95));
    return seat || back || legs ? 1.0 : 0.0;
  };
  const auto wood = [](int, int) { return ChangedBooth::Colour{0.10, 0.05, 0.02}; };
  for (ChangedBooth& booth : booths()) {
    ChangedBooth came = booth, went = booth;
    came.stand_behind(&came.body, chair, wood);
    came.expect_right_or_reported(0.98);
    for (Frame& frame : went.background) went.stand_behind(&frame, chair, wood);
    went.expect_right_or_reported(0.98);
  }
}

TEST_F(MaskOfChangedBooth, ASecondPersonAtTheEdgeIsReported) {
  for (ChangedBooth& booth : booths()) {
    const Image truth = booth.true_coverage();
    const std::shared_ptr<const Image> before = booth.body.pixels;
    const int aside = 3 * truth.width / 5;
    booth.stand_behind(
        &booth.body, [&](int x, int y) { return x + aside < truth.width ? truth.at(x + aside, y) / 255.0 : 0.0; },
        [&](int x, int y) { return ChangedBooth::colour(*before, std::min(x + aside, truth.width - 1), y); });
    booth.expect_right_or_reported(0.98);
  }
}

TEST_F(MaskOfChangedBooth, GreyCamerasAreRightOrReported) {
  for (ChangedBooth& booth : booths()) {
    const auto grey = [](int, int, const ChangedBooth::Colour& seen) {
      const double light = 0.2126 * seen[0] + 0.7152 * seen[1] + 0.0722 * seen[2];
      return ChangedBooth::Colour{light, light, light};
    };
    booth.body = ChangedBooth::painted(booth.body, grey);
    for (Frame& frame : booth.background) frame = ChangedBooth::painted(frame, grey);
    booth.expect_right_or_reported(0.98);
  }
}

TEST_F(MaskOfChangedBooth, AWhiteShirtBeforeALightWallIsRightOrReported) {
  for (ChangedBooth& booth : booths()) {
    const Image truth = booth.true_coverage();
    const auto wall = [](int x, int y) {
      const double light = 0.62 + 0.0002 * x - 0.0001 * y;
      return ChangedBooth::Colour{light, 0.99 * light, 0.97 * light};
    };
    booth.replace_background(wall, 1.0);
    booth.body = ChangedBooth::painted(booth.body, [&](int x, int y, const ChangedBooth::Colour& seen) {
      if (y < truth.height / 4 || y > truth.height / 2) return seen;
      const double share = truth.at(x, y) / 255.0, folds = 0.74 + 0.05 * std::sin(x / 7.0 + y / 23.0);
      const ChangedBooth::Colour behind = wall(x, y);
      return ChangedBooth::Colour{share * folds + (1 - share) * behind[0], share * folds + (1 - share) * behind[1],
                                  share * folds + (1 - share) * behind[2]};
    });
    booth.expect_right_or_reported(0.97);
  }
}

INSTANTIATE_TEST_SUITE_P(Recordings, MaskQuality, testing::Values("mini", "man-casual", "woman-casual"),
                         [](const auto& name) {
                           std::string plain = name.param;
                           std::replace(plain.begin(), plain.end(), '-', '_');
                           return plain;
                         });

}  // namespace
}  // namespace booth::quality
