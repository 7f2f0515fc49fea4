// The solver on recordings whose rig is known exactly, and on OpenCV's stereo pictures beside cv::stereoCalibrate.

#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <iostream>
#include <numbers>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>

#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/calibration.h"
#include "pipeline/thread_pool.h"
#include "replay/recording.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

std::vector<fs::path> recordings_with_board() {
  std::vector<fs::path> found;
  const char* folder = std::getenv("BOOTH_RECORDINGS");
  if (!folder) return found;
  for (const auto& entry : fs::directory_iterator(folder)) {
    const auto recording = read_recording(entry.path());
    if (recording && recording->find(ShotRole::calibration_board) && fs::exists(entry.path() / "truth" / "rig.json"))
      found.push_back(entry.path());
  }
  return found;
}

/// How far a camera is from where it truly is.
struct CameraError {
  double center_m = 0, rotation_deg = 0, focal = 0;
};

/// After the rigid motion that brings the centres closest.
std::vector<CameraError> errors_against(const Rig& solved, const Rig& truth) {
  const auto cameras = static_cast<Eigen::Index>(solved.cameras.size());
  Eigen::Matrix3Xd from(3, cameras), to(3, cameras);
  for (Eigen::Index i = 0; i < cameras; ++i) {
    from.col(i) = solved.cameras[static_cast<size_t>(i)].center();
    to.col(i) = truth.find(solved.cameras[static_cast<size_t>(i)].id)->center();
  }
  const Eigen::Isometry3d motion(Eigen::umeyama(from, to, false));
  std::vector<CameraError> errors;
  for (const RigCamera& camera : solved.cameras) {
    const RigCamera& exact = *truth.find(camera.id);
    const Eigen::AngleAxisd turn(exact.camera_from_world.linear() * motion.linear() *
                                 camera.camera_from_world.linear().transpose());
    errors.push_back({(motion * camera.center() - exact.center()).norm(), turn.angle() * 180 / std::numbers::pi,
                      std::max(std::abs(camera.intrinsics.fx / exact.intrinsics.fx - 1),
                               std::abs(camera.intrinsics.fy / exact.intrinsics.fy - 1))});
  }
  return errors;
}

TEST(CalibrationOfRecordings, FindsTheTrueRigFromTheBoardAlone) {
  const auto folders = recordings_with_board();
  if (folders.empty()) GTEST_SKIP() << "BOOTH_RECORDINGS names no recording with a board shot";
  ThreadPool pool(2);
  for (const fs::path& folder : folders) {
    const auto recording = read_recording(folder);
    const auto truth = read_rig(folder / "truth" / "rig.json");
    ASSERT_TRUE(recording && truth) << folder;
    const Shot& shot = *recording->find(ShotRole::calibration_board);
    CalibrationInput input;
    // Nothing of the recording's own calibration goes in: face cameras, which never see the board, aside.
    for (const CalibrationDevice& device : calibration_devices(recording->rig))
      for (const FrameRecord& frame : shot.frames)
        if (frame.camera == device.id) {
          input.devices.push_back(device);
          break;
        }
    input.board = *shot.board;
    for (const FrameSet& set : load_shot(*recording, shot, pool.work()).sets)
      for (const Frame& frame : set.frames) {
        auto view = find_board(frame.camera, frame.index, *frame.pixels, input.board);
        ASSERT_TRUE(view) << view.error().message;
        input.views.push_back(std::move(*view));
      }
    const auto solved = solve_calibration(input, {}, pool.work());
    ASSERT_TRUE(solved) << solved.error().message;
    EXPECT_LE(solved->rms_px, 0.25);
    const auto errors = errors_against(solved->rig, *truth);
    for (size_t i = 0; i < errors.size(); ++i) {
      const DeviceQuality& quality = solved->devices[i];
      std::cout << quality.id << ": rms " << quality.rms_px << " px, centre " << 1000 * errors[i].center_m
                << " mm (sigma " << 1000 * quality.pose.center_m << "), rotation " << errors[i].rotation_deg
                << " deg (sigma " << quality.pose.rotation_rad * 180 / std::numbers::pi << "), focal "
                << 100 * errors[i].focal << " % (sigma " << quality.focal_sigma_px << " px), views " << quality.views
                << ", corners " << quality.corners << ", outliers " << quality.outliers << "\n";
      EXPECT_LE(quality.rms_px, 0.25) << quality.id;
      EXPECT_LE(errors[i].center_m, 0.001) << quality.id;
      EXPECT_LE(errors[i].rotation_deg, 0.02) << quality.id;
      EXPECT_LE(errors[i].focal, 0.001) << quality.id;
    }
    // What the lines between the squares add to saddle points.
    const auto from_saddles = solve_calibration(input, {.refine_corners = false}, pool.work());
    ASSERT_TRUE(from_saddles) << from_saddles.error().message;
    const auto worst = [](const std::vector<CameraError>& all) {
      CameraError most;
      for (const CameraError& error : all) {
        most.center_m = std::max(most.center_m, error.center_m);
        most.rotation_deg = std::max(most.rotation_deg, error.rotation_deg);
        most.focal = std::max(most.focal, error.focal);
      }
      return most;
    };
    const CameraError ours = worst(errors), saddles = worst(errors_against(from_saddles->rig, *truth));
    std::cout << "worst: centre " << 1000 * ours.center_m << " mm, rotation " << ours.rotation_deg << " deg, focal "
              << 100 * ours.focal << " %; from saddle points alone " << 1000 * saddles.center_m << " mm, "
              << saddles.rotation_deg << " deg, " << 100 * saddles.focal << " %\n";
    EXPECT_LT(2 * ours.rotation_deg, saddles.rotation_deg);
    std::cout << "verdict " << to_string(solved->verdict) << ": " << solved->reason << "\n";
  }
}

/// OpenCV's pairs of pictures of a chessboard of 9 × 6 corners, squares of one unit.
TEST(CalibrationOfStereoPictures, IsNoWorseThanStereoCalibrate) {
  const fs::path folder = "/usr/share/doc/opencv-doc/examples/data";
  if (!fs::exists(folder / "left01.jpg")) GTEST_SKIP() << "the package opencv-doc is not installed";
  const cv::Size corners(9, 6);
  std::vector<cv::Point3f> object;
  for (int y = 0; y < corners.height; ++y)
    for (int x = 0; x < corners.width; ++x)
      object.emplace_back(static_cast<float>(x + 1), static_cast<float>(y + 1), 0.0F);
  CalibrationInput input;
  input.board = {.type = "chessboard", .squares_x = 10, .squares_y = 7, .square_m = 1, .marker_m = 0, .dictionary = ""};
  std::vector<std::vector<cv::Point3f>> objects;
  std::array<std::vector<std::vector<cv::Point2f>>, 2> points;
  cv::Size size;
  for (int number = 1; number <= 14; ++number) {
    std::array<std::vector<cv::Point2f>, 2> pair;
    bool both = true;
    for (const size_t side : {0U, 1U}) {
      char name[32];
      std::snprintf(name, sizeof name, "%s%02d.jpg", side == 0 ? "left" : "right", number);
      const cv::Mat picture = cv::imread((folder / name).string(), cv::IMREAD_GRAYSCALE);
      if (picture.empty() || !cv::findChessboardCorners(picture, corners, pair[side])) {
        both = false;
        break;
      }
      size = picture.size();
      cv::cornerSubPix(picture, pair[side], {5, 5}, {-1, -1},
                       {cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 30, 0.01});
    }
    if (!both) continue;
    objects.push_back(object);
    for (const size_t side : {0U, 1U}) {
      points[side].push_back(pair[side]);
      BoardView view;
      view.camera = side == 0 ? "left" : "right";
      view.pose = number;
      for (size_t i = 0; i < object.size(); ++i)
        view.corners.push_back({.id = static_cast<int>(i),
                                .pixel = {pair[side][i].x, pair[side][i].y},
                                .covariance = 0.01 * Eigen::Matrix2d::Identity()});
      input.views.push_back(std::move(view));
    }
  }
  ASSERT_GE(objects.size(), 10U);
  for (const char* id : {"left", "right"})
    input.devices.push_back({.id = id, .width = size.width, .height = size.height});

  cv::Mat k1 = cv::initCameraMatrix2D(objects, points[0], size, 0),
          k2 = cv::initCameraMatrix2D(objects, points[1], size, 0);
  cv::Mat d1, d2, rotation, translation, essential, fundamental;
  const double theirs = cv::stereoCalibrate(objects, points[0], points[1], k1, d1, k2, d2, size, rotation, translation,
                                            essential, fundamental, cv::CALIB_USE_INTRINSIC_GUESS,
                                            {cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 200, 1e-9});

  // The same cost on the same points: theirs is plain least squares over all corners.
  const auto plain = solve_calibration(input, {.plain_least_squares = true});
  ASSERT_TRUE(plain) << plain.error().message;
  size_t count = 0;
  for (const DeviceQuality& quality : plain->devices) {
    count += quality.residuals.size();
    EXPECT_EQ(quality.outliers, 0);
  }
  ASSERT_EQ(count, 2 * objects.size() * object.size());
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  std::cout.precision(9);
  std::cout << "rms " << plain->rms_px << " px by plain least squares, cv::stereoCalibrate " << theirs
            << " px; by default, without outliers, " << solved->rms_px << " px; verdict " << to_string(solved->verdict)
            << ": " << solved->reason << "\n";
  // Both stop within this of the minimum that they share.
  constexpr double converged = 1e-7;
  EXPECT_LE(plain->rms_px, theirs * (1 + converged));
  // Outliers aside, which are few, the default is no worse either.
  EXPECT_LE(solved->rms_px, theirs);
  int outliers = 0;
  for (const DeviceQuality& quality : solved->devices) outliers += quality.outliers;
  EXPECT_LT(outliers, 0.01 * static_cast<double>(count));
}

}  // namespace
}  // namespace booth
