// The face scans of recordings whose truth is known, as they are and with faults. Recordings as in
// avatar_quality_test.cpp; face_scan_figures prints all of them.

#include "tests/quality/face_scan.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "pipeline/thread_pool.h"
#include "tests/quality/face_perturbation.h"
#include "tests/quality/truth.h"

namespace booth::quality {
namespace {

class FaceScan : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    const auto folder = find_recording(GetParam());
    if (!folder) GTEST_SKIP() << "set BOOTH_RECORDINGS to the larger recordings";
    face_ = read_face_recording(*folder, pool_.work());
  }
  ScanErrors errors_of(const GrayCodeCapture& capture) {
    const auto scan = scan_structured_light(face_.rig, capture, {}, face_.region, {}, pool_.work());
    EXPECT_TRUE(scan.ok()) << scan.error().message;
    return scan ? compare(scan->scan, face_.truth) : ScanErrors{};
  }
  ThreadPool pool_;
  FaceRecording face_;
};

TEST_P(FaceScan, MeasuresTheFace) {
  const ScanErrors errors = errors_of(face_.capture);
  EXPECT_GE(errors.coverage, 0.95);
  EXPECT_LE(errors.median_m, 0.0003);
  EXPECT_LE(errors.p95_m, 0.001);
}

TEST_P(FaceScan, BearsNoiseAndLight) {
  constexpr uint32_t seed = 5;
  const ScanErrors noisy = errors_of(with_noise(face_.capture, 4, seed));
  EXPECT_GE(noisy.coverage, 0.8);
  EXPECT_LE(noisy.median_m, 0.0005);
  const ScanErrors lit = errors_of(with_ambient_light(face_.capture, 0.5, seed));
  EXPECT_GE(lit.coverage, 0.9);
  EXPECT_LE(lit.median_m, 0.0004);
}

TEST_P(FaceScan, BearsMissingImages) {
  const ScanErrors errors = errors_of(without_images(face_.capture, 0.1, 5));
  EXPECT_GE(errors.coverage, 0.9);
  EXPECT_LE(errors.median_m, 0.0005);
}

TEST_P(FaceScan, BearsImagesThatStandTwice) {
  const ScanErrors errors = errors_of(with_repeats(face_.capture, 0.05, 5));
  EXPECT_GE(errors.coverage, 0.85);
  EXPECT_LE(errors.median_m, 0.0005);
}

INSTANTIATE_TEST_SUITE_P(Recordings, FaceScan, testing::Values("man-casual", "woman-casual"), [](const auto& name) {
  std::string plain = name.param;
  std::replace(plain.begin(), plain.end(), '-', '_');
  return plain;
});

}  // namespace
}  // namespace booth::quality
