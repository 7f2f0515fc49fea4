#include "pipeline/calibration/calibration.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <random>
#include <sstream>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/board_pdf.h"
#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/coverage.h"
#include "pipeline/calibration/report.h"
#include "pipeline/calibration/world_frame.h"
#include "pipeline/geometry/camera_model.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/scene.h"

namespace booth {
namespace {

using testing::HasSubstr;

const CalibrationBoard board{
    .squares_x = 8, .squares_y = 11, .square_m = 0.06, .marker_m = 0.045, .dictionary = "DICT_5X5_250"};

/// Somewhere about the volume's middle, its face towards the azimuth and tilted at random.
Eigen::Isometry3d place_of_board(double azimuth, double most_tilt, std::mt19937& random) {
  std::uniform_real_distribution<double> share(-1, 1);
  Eigen::Isometry3d middle_from_board = Eigen::Isometry3d::Identity();
  middle_from_board.translation() =
      Eigen::Vector3d(-0.5 * board.squares_x * board.square_m, -0.5 * board.squares_y * board.square_m, 0);
  Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
  pose.translation() = Eigen::Vector3d(0.3 * share(random), 1.0 + 0.4 * share(random), 0.3 * share(random));
  // Upright, its face (-z of its frame) towards +Z of the world, then turned.
  const Eigen::Matrix3d upright = Eigen::Vector3d(1, -1, -1).asDiagonal();
  pose.linear() = Eigen::AngleAxisd(azimuth + most_tilt * share(random), Eigen::Vector3d::UnitY()).toRotationMatrix() *
                  Eigen::AngleAxisd(most_tilt * share(random), Eigen::Vector3d::UnitX()).toRotationMatrix() *
                  Eigen::AngleAxisd(most_tilt * share(random), Eigen::Vector3d::UnitZ()).toRotationMatrix() * upright;
  return pose * middle_from_board;
}

std::vector<Eigen::Isometry3d> places_around(int count, double most_tilt, uint32_t seed) {
  std::mt19937 random(seed);
  std::vector<Eigen::Isometry3d> places;
  for (int i = 0; i < count; ++i) places.push_back(place_of_board(2 * std::numbers::pi * i / count, most_tilt, random));
  return places;
}

/// What each device of a rig sees of the board, by projection, with noise; from behind and at grazing angles nothing.
std::vector<BoardView> project_views(const Rig& rig, const std::vector<Eigen::Isometry3d>& places, double noise_px,
                                     uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, noise_px);
  std::vector<const CalibratedView*> devices;
  for (const RigCamera& camera : rig.cameras) devices.push_back(&camera);
  if (rig.projector) devices.push_back(&*rig.projector);
  const auto corners = board_corners(board);
  std::vector<BoardView> views;
  for (size_t pose = 0; pose < places.size(); ++pose)
    for (const CalibratedView* device : devices) {
      const Eigen::Vector3d towards = (device->center() - places[pose] * corners[35]).normalized();
      constexpr double most_grazing = 0.35;
      if (-places[pose].linear().col(2).dot(towards) < most_grazing) continue;
      BoardView view;
      view.camera = device->id;
      view.pose = static_cast<int>(pose);
      for (size_t id = 0; id < corners.size(); ++id) {
        const auto pixel = project(*device, places[pose] * corners[id]);
        if (!pixel || pixel->minCoeff() < 0 || pixel->x() > device->intrinsics.width - 1 ||
            pixel->y() > device->intrinsics.height - 1)
          continue;
        const Eigen::Vector2d error(noise(random), noise(random));
        view.corners.push_back({.id = static_cast<int>(id),
                                .pixel = *pixel + error,
                                .covariance = std::max(1e-4, noise_px * noise_px) * Eigen::Matrix2d::Identity()});
      }
      if (!view.corners.empty()) views.push_back(std::move(view));
    }
  return views;
}

Rig ring(int cameras) { return synthetic::ring_rig({.cameras = cameras, .width = 960, .height = 1280}); }

CalibrationInput input_of(const Rig& rig, const std::vector<Eigen::Isometry3d>& places, double noise_px = 0) {
  CalibrationInput input;
  input.devices = calibration_devices(rig);
  input.board = board;
  input.views = project_views(rig, places, noise_px, 7);
  input.previous = rig;
  return input;
}

/// Largest distances of solved from true: centres in metres, turns in radians, focal lengths as shares.
struct WorstError {
  double center_m = 0, turn_rad = 0, focal = 0;
};

WorstError worst_error(const Rig& solved, const Rig& truth) {
  WorstError worst;
  const auto compare = [&](const CalibratedView& a, const CalibratedView& b) {
    worst.center_m = std::max(worst.center_m, (a.center() - b.center()).norm());
    const Eigen::AngleAxisd turn(a.camera_from_world.linear() * b.camera_from_world.linear().transpose());
    worst.turn_rad = std::max(worst.turn_rad, turn.angle());
    worst.focal = std::max(worst.focal, std::abs(a.intrinsics.fx / b.intrinsics.fx - 1));
  };
  for (const RigCamera& camera : solved.cameras) compare(camera, *truth.find(camera.id));
  if (solved.projector) compare(*solved.projector, *truth.projector);
  return worst;
}

/// A photograph of the board: the pattern averaged over each pixel, blurred, before a grey wall, with noise.
Image photograph(const CalibratedView& camera, const Eigen::Isometry3d& world_from_board, double blur_px,
                 uint32_t seed) {
  const BoardPattern pattern(board);
  const Eigen::Isometry3d board_from_camera = (camera.camera_from_world * world_from_board).inverse();
  const Eigen::Vector3d eye = board_from_camera.translation();
  const int width = camera.intrinsics.width, height = camera.intrinsics.height;
  FloatImage exact(width, height, 1);
  constexpr int samples = 4;
  constexpr double margin_m = 0.02;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      double sum = 0;
      for (int s = 0; s < samples * samples; ++s) {
        const Eigen::Vector2d pixel(x + (s % samples + 0.5) / samples - 0.5, y + (s / samples + 0.5) / samples - 0.5);
        const Eigen::Vector3d ray = board_from_camera.linear() * unproject(camera.intrinsics, pixel);
        const Eigen::Vector3d p = eye - eye.z() / ray.z() * ray;
        const bool on_board = eye.z() < 0 && p.x() > -margin_m && p.y() > -margin_m &&
                              p.x() < pattern.width_m() + margin_m && p.y() < pattern.height_m() + margin_m;
        sum += !on_board ? 120 : pattern.white(p.x(), p.y()) ? 190 : 25;
      }
      exact.at(x, y) = static_cast<float>(sum / (samples * samples));
    }
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, 1.5);
  const int reach = static_cast<int>(std::ceil(3 * blur_px));
  Image image(width, height, 1);
  FloatImage rows = exact;
  const auto blur = [&](const FloatImage& from, FloatImage& to, int dx, int dy) {
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        double sum = 0, weights = 0;
        for (int i = -reach; i <= reach; ++i) {
          const double weight = std::exp(-0.5 * i * i / (blur_px * blur_px));
          sum += weight * from.at(std::clamp(x + i * dx, 0, width - 1), std::clamp(y + i * dy, 0, height - 1));
          weights += weight;
        }
        to.at(x, y) = static_cast<float>(sum / weights);
      }
  };
  if (blur_px > 0) {
    FloatImage half = exact;
    blur(exact, half, 1, 0);
    blur(half, rows, 0, 1);
  }
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      image.at(x, y) = static_cast<uint8_t>(std::clamp(rows.at(x, y) + noise(random), 0.0, 255.0));
  return image;
}

/// A camera 1.2 m before the board.
RigCamera near_camera() {
  RigCamera camera;
  camera.id = "near";
  camera.intrinsics = {.width = 480,
                       .height = 640,
                       .fx = 620,
                       .fy = 622,
                       .cx = 243,
                       .cy = 315,
                       .distortion = {-0.05, 0.02, 0.0004, -0.0003, 0}};
  camera.camera_from_world.translation() = Eigen::Vector3d(-0.24, -0.33, 1.1);
  camera.camera_from_world.linear() =
      (Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitX()) * Eigen::AngleAxisd(-0.25, Eigen::Vector3d::UnitY()) *
       Eigen::AngleAxisd(0.1, Eigen::Vector3d::UnitZ()))
          .toRotationMatrix();
  return camera;
}

Image turned_clockwise(const Image& image) {
  Image turned(image.height, image.width, image.channels);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) turned.at(image.height - 1 - y, x) = image.at(x, y);
  return turned;
}

TEST(Board, IsRefusedWithTheFieldAndItsValue) {
  EXPECT_TRUE(check(board));
  CalibrationBoard wrong = board;
  wrong.dictionary = "DICT_9X9";
  EXPECT_THAT(check(wrong).error().message, HasSubstr("board.dictionary: \"DICT_9X9\""));
  wrong = board;
  wrong.marker_m = 0.07;
  EXPECT_THAT(check(wrong).error().message, HasSubstr("board.marker_m: 0.07"));
  wrong = board;
  wrong.squares_x = 60;
  wrong.squares_y = 60;
  EXPECT_THAT(check(wrong).error().message, HasSubstr("at least 1800 markers"));
}

TEST(Board, IsFoundInItsOwnPictureInAnyTurnAndNotInItsMirrorImage) {
  const int square_px = 40, margin_px = 30;
  Image picture = draw_board(board, square_px, margin_px);
  for (int turn = 0; turn < 4; ++turn) {
    const auto view = find_board("camera", 3, picture, board);
    ASSERT_TRUE(view) << view.error().message;
    EXPECT_EQ(view->pose, 3);
    EXPECT_EQ(view->markers, 44);
    ASSERT_EQ(view->corners.size(), 70U);
    for (const TargetCorner& corner : view->corners) {
      // The corner lies between pixels, half a pixel before the first of the next square.
      Eigen::Vector2d expected((corner.id % 7 + 1) * square_px + margin_px - 0.5,
                               (corner.id / 7 + 1) * square_px + margin_px - 0.5);
      Eigen::Vector2i size(8 * square_px + 2 * margin_px, 11 * square_px + 2 * margin_px);
      for (int i = 0; i < turn; ++i) {
        expected = Eigen::Vector2d(size.y() - 1 - expected.y(), expected.x());
        std::swap(size.x(), size.y());
      }
      EXPECT_LT((corner.pixel - expected).norm(), 0.1) << corner.id << " after " << turn << " turns";
    }
    picture = turned_clockwise(picture);
  }
  Image mirrored = picture;
  for (int y = 0; y < picture.height; ++y)
    for (int x = 0; x < picture.width; ++x) mirrored.at(picture.width - 1 - x, y) = picture.at(x, y);
  const auto behind = find_board("camera", 0, mirrored, board);
  ASSERT_TRUE(behind);
  EXPECT_TRUE(behind->corners.empty());
  EXPECT_FALSE(behind->message.empty());
}

TEST(Board, IsFoundWherePartOfItIsOutsideThePicture) {
  const Image whole = draw_board(board, 40, 30);
  Image part(200, 300, 1);
  for (int y = 0; y < part.height; ++y)
    for (int x = 0; x < part.width; ++x) part.at(x, y) = whole.at(x, y);
  const auto view = find_board("camera", 0, part, board);
  ASSERT_TRUE(view);
  EXPECT_GE(view->corners.size(), 15U);
  EXPECT_LE(view->corners.size(), 24U);
}

TEST(BoardPhotograph, HasCornersAsCertainAsTheySay) {
  const RigCamera camera = near_camera();
  const Image image = photograph(camera, Eigen::Isometry3d::Identity(), 0.7, 1);
  const auto view = find_board("near", 0, image, board);
  ASSERT_TRUE(view);
  ASSERT_GE(view->corners.size(), 60U);
  EXPECT_FALSE(view->blurred);
  double squares = 0, predicted = 0;
  const auto corners = board_corners(board);
  for (const TargetCorner& corner : view->corners) {
    squares += (corner.pixel - *project(camera, corners[static_cast<size_t>(corner.id)])).squaredNorm();
    predicted += corner.covariance.trace();
  }
  EXPECT_LT(std::sqrt(squares / static_cast<double>(view->corners.size())), 0.15);
  EXPECT_LT(squares, 9 * predicted);
}

TEST(BoardPhotograph, IsCalledBlurredWhenItIs) {
  const Image image = photograph(near_camera(), Eigen::Isometry3d::Identity(), 3.5, 1);
  const auto view = find_board("near", 0, image, board);
  ASSERT_TRUE(view);
  EXPECT_TRUE(view->corners.empty());
  EXPECT_TRUE(view->blurred) << view->message;
  EXPECT_THAT(view->message, HasSubstr("blurred"));
}

TEST(BoardPhotograph, OfAnEmptyRoomHasNoBoard) {
  const auto view = find_board("near", 0, Image(320, 240, 3, 90), board);
  ASSERT_TRUE(view);
  EXPECT_TRUE(view->corners.empty());
  EXPECT_FALSE(view->blurred);
  EXPECT_THAT(view->message, HasSubstr("does not see"));
}

TEST(BoardPdf, HasEverySquareAndCellWhereThePatternHasItTrueToScale) {
  for (const auto& [paper, name] : paper_sizes) {
    const CalibrationBoard printed = board_for(paper);
    const auto pdf = board_pdf(printed, paper);
    ASSERT_TRUE(pdf) << name;
    // Plays the drawing operators on a few thousand points of the board.
    std::istringstream lines(*pdf);
    std::vector<std::array<double, 4>> pending;
    struct Fill {
      double grey;
      std::vector<std::array<double, 4>> rectangles;
    };
    std::vector<Fill> fills;
    double grey = 0;
    for (std::string line; std::getline(lines, line);) {
      std::istringstream words(line);
      std::array<double, 4> numbers{};
      if (line.ends_with(" re")) {
        for (double& number : numbers) words >> number;
        pending.push_back(numbers);
      } else if (line.ends_with(" g")) {
        words >> grey;
      } else if (line == "f") {
        fills.push_back({grey, pending});
        pending.clear();
      }
    }
    ASSERT_GE(fills.size(), 3U);
    ASSERT_FALSE(fills[0].rectangles.empty());
    // The first rectangle is the top left square.
    constexpr double points_per_metre = 72 / 0.0254;
    const auto& first = fills[0].rectangles[0];
    EXPECT_NEAR(first[2], printed.square_m * points_per_metre, 1e-3);
    const double left = first[0], top = first[1] + first[3];
    const BoardPattern pattern(printed);
    std::mt19937 random(3);
    std::uniform_real_distribution<double> share(0, 1);
    for (int i = 0; i < 3000; ++i) {
      const double x = share(random) * pattern.width_m(), y = share(random) * pattern.height_m();
      const double px = left + x * points_per_metre, py = top - y * points_per_metre;
      bool white = true;
      for (const Fill& fill : fills)
        for (const auto& r : fill.rectangles)
          if (px > r[0] && px < r[0] + r[2] && py > r[1] && py < r[1] + r[3]) white = fill.grey > 0.5;
      ASSERT_EQ(white, pattern.white(x, y)) << name << " at " << x << ", " << y;
    }
  }
}

TEST(BoardPdf, SaysThatABoardDoesNotFit) {
  const auto pdf = board_pdf(board, PaperSize::a4);
  ASSERT_FALSE(pdf);
  EXPECT_THAT(pdf.error().message, HasSubstr("480 × 660 mm and does not fit on A4"));
}

TEST(Calibration, IsExactWithoutNoise) {
  const Rig rig = ring(6);
  const auto solved = solve_calibration(input_of(rig, places_around(12, 0.5, 1)));
  ASSERT_TRUE(solved) << solved.error().message;
  ASSERT_EQ(solved->rig.cameras.size(), rig.cameras.size());
  const WorstError worst = worst_error(solved->rig, rig);
  EXPECT_LT(worst.center_m, 2e-4);
  EXPECT_LT(worst.turn_rad, 2e-4);
  EXPECT_LT(worst.focal, 2e-4);
  EXPECT_EQ(solved->verdict, CalibrationVerdict::good) << solved->reason;
  EXPECT_TRUE(check(solved->rig));
}

TEST(Calibration, IsAsUncertainAsItSays) {
  const Rig rig = ring(6);
  constexpr double noise_px = 0.1;
  auto input = input_of(rig, places_around(12, 0.5, 1), noise_px);
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  EXPECT_NEAR(solved->rms_px, noise_px * std::numbers::sqrt2, 0.02);
  for (const RigCamera& camera : solved->rig.cameras) {
    ASSERT_TRUE(camera.uncertainty);
    EXPECT_GT(camera.uncertainty->center_m, 1e-5);
    EXPECT_LT((camera.center() - rig.find(camera.id)->center()).norm(), 5 * camera.uncertainty->center_m) << camera.id;
    const Eigen::AngleAxisd turn(camera.camera_from_world.linear() *
                                 rig.find(camera.id)->camera_from_world.linear().transpose());
    EXPECT_LT(turn.angle(), 5 * camera.uncertainty->rotation_rad) << camera.id;
  }
}

TEST(Calibration, DoesNotDependOnTheOrderOfViewsOrOnThreads) {
  const Rig rig = ring(4);
  auto input = input_of(rig, places_around(8, 0.5, 2), 0.1);
  const auto first = solve_calibration(input);
  std::reverse(input.views.begin(), input.views.end());
  ThreadPool pool(3);
  const auto second = solve_calibration(input, {}, pool.work());
  ASSERT_TRUE(first && second);
  for (size_t i = 0; i < rig.cameras.size(); ++i) {
    EXPECT_EQ(first->rig.cameras[i].camera_from_world.matrix(), second->rig.cameras[i].camera_from_world.matrix());
    EXPECT_EQ(first->rig.cameras[i].intrinsics.fx, second->rig.cameras[i].intrinsics.fx);
  }
}

TEST(Calibration, TakesCamerasMountedInAnyTurnAndAProjectorAsInverseCamera) {
  Rig rig = ring(4);
  rig.cameras[1].mount_rotation_deg = 90;
  const Eigen::Matrix3d sideways =
      Eigen::AngleAxisd(-std::numbers::pi / 2, Eigen::Vector3d::UnitZ()).toRotationMatrix();
  rig.cameras[1].camera_from_world.prerotate(sideways);
  rig.cameras[2].camera_from_world.prerotate(sideways * sideways);
  rig.cameras[2].mount_rotation_deg = 180;
  rig.projector = static_cast<CalibratedView>(rig.cameras[0]);
  rig.projector->id = "projector";
  rig.projector->intrinsics.width = 1024;
  rig.projector->intrinsics.height = 768;
  rig.projector->intrinsics.cx = 505;
  rig.projector->intrinsics.cy = 700;  // shifted upwards, as projectors are
  rig.projector->camera_from_world.pretranslate(Eigen::Vector3d(0.2, -0.5, 0.3));
  const auto solved = solve_calibration(input_of(rig, places_around(16, 0.5, 3), 0.05));
  ASSERT_TRUE(solved) << solved.error().message;
  ASSERT_TRUE(solved->rig.projector);
  const WorstError worst = worst_error(solved->rig, rig);
  EXPECT_LT(worst.center_m, 0.004);
  EXPECT_LT(worst.turn_rad, 0.003);
}

TEST(Calibration, ReportsCornersThatAreWrongAndGoesOnWithoutThem) {
  const Rig rig = ring(4);
  auto input = input_of(rig, places_around(10, 0.5, 4), 0.05);
  std::mt19937 random(5);
  size_t wrong = 0;
  for (BoardView& view : input.views)
    for (TargetCorner& corner : view.corners)
      if (random() % 50 == 0) {
        corner.pixel += Eigen::Vector2d(4, -3);
        ++wrong;
      }
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  size_t outliers = 0;
  for (const DeviceQuality& device : solved->devices) outliers += static_cast<size_t>(device.outliers);
  EXPECT_GE(outliers, wrong);
  EXPECT_LE(outliers, wrong + wrong / 10 + 5);
  EXPECT_LT(worst_error(solved->rig, rig).center_m, 0.002);
}

TEST(Calibration, TakesTheWorldFromTheBoardOnTheFloor) {
  const Rig rig = ring(6);
  auto places = places_around(12, 0.5, 6);
  // On the floor where the subject stands, turned and shifted by a known amount.
  const Eigen::Isometry3d offset =
      Eigen::Translation3d(0.1, 0, -0.2) * Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitY());
  places.push_back(offset * world_from_floor_board(board));
  auto input = input_of(rig, places);
  input.floor_pose = 12;
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  for (const RigCamera& camera : solved->rig.cameras)
    EXPECT_LT((offset * camera.center() - rig.find(camera.id)->center()).norm(), 5e-4) << camera.id;
}

TEST(Calibration, GuessesTheWorldFromTheMountsAndSaysSo) {
  const Rig rig = ring(6);
  auto input = input_of(rig, places_around(12, 0.5, 1));
  input.previous.reset();
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  EXPECT_EQ(solved->verdict, CalibrationVerdict::usable);
  EXPECT_THAT(solved->reason, HasSubstr("floor"));
  // The cameras are upright, so up is up within their mutual tilt.
  for (const RigCamera& camera : solved->rig.cameras)
    EXPECT_LT((camera.camera_from_world.linear() * Eigen::Vector3d::UnitY()).y(), -0.8) << camera.id;
}

TEST(DegenerateCalibration, OfOnePoseSaysThatTheBoardMustMove) {
  const Rig rig = ring(3);
  auto places = places_around(1, 0.1, 1);
  const auto solved = solve_calibration(input_of(rig, places));
  ASSERT_FALSE(solved);
  EXPECT_EQ(solved.error().code, ErrorCode::too_few_views);
  EXPECT_THAT(solved.error().message, HasSubstr("in one place only"));
}

TEST(DegenerateCalibration, OfCoplanarBoardsSaysThatTheyMustBeTilted) {
  const Rig rig = ring(5);
  std::vector<Eigen::Isometry3d> places;
  // Slid and turned about within one upright plane.
  for (int i = 0; i < 6; ++i)
    places.push_back(Eigen::Translation3d(0.1 * i - 0.3, 1.2 + 0.05 * i, 0.1) *
                     Eigen::AngleAxisd(0.2 * i, Eigen::Vector3d::UnitZ()) *
                     Eigen::Isometry3d(Eigen::Matrix3d(Eigen::Vector3d(1, -1, -1).asDiagonal())));
  const auto solved = solve_calibration(input_of(rig, places, 0.05));
  ASSERT_FALSE(solved);
  EXPECT_THAT(solved.error().message, HasSubstr("in the same plane"));
  for (int i = 0; i < 6; ++i) places[static_cast<size_t>(i)].pretranslate(Eigen::Vector3d(0, 0, 0.06 * i));
  const auto parallel = solve_calibration(input_of(rig, places, 0.05));
  ASSERT_FALSE(parallel);
  EXPECT_THAT(parallel.error().message, HasSubstr("faced the same way"));
}

TEST(DegenerateCalibration, WithoutAnyBoardSaysSo) {
  CalibrationInput input = input_of(ring(3), {});
  const auto nothing = solve_calibration(input);
  ASSERT_FALSE(nothing);
  EXPECT_THAT(nothing.error().message, HasSubstr("no camera found the board"));
  BoardView blurred;
  blurred.camera = input.devices[0].id;
  blurred.blurred = true;
  input.views = {blurred};
  const auto unsharp = solve_calibration(input);
  ASSERT_FALSE(unsharp);
  EXPECT_THAT(unsharp.error().message, HasSubstr("blur"));
}

TEST(DegenerateCalibration, NamesTheCameraThatNeverSawTheBoard) {
  const Rig rig = ring(5);
  auto input = input_of(rig, places_around(10, 0.5, 1), 0.05);
  std::erase_if(input.views, [&](const BoardView& view) { return view.camera == rig.cameras[2].id; });
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  EXPECT_EQ(solved->verdict, CalibrationVerdict::bad);
  EXPECT_THAT(solved->reason, HasSubstr(rig.cameras[2].id + ": never saw the board"));
  EXPECT_EQ(solved->rig.cameras.size(), 4U);
  // The ring is open now, and a chain of four is less certain.
  EXPECT_LT(worst_error(solved->rig, rig).center_m, 0.01);
}

TEST(DegenerateCalibration, NamesTheCameraThatSharesNoPose) {
  const Rig rig = ring(5);
  auto input = input_of(rig, places_around(10, 0.5, 1), 0.05);
  // Its views are made to be of poses of their own.
  for (BoardView& view : input.views)
    if (view.camera == rig.cameras[3].id) view.pose += 100;
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  EXPECT_EQ(solved->verdict, CalibrationVerdict::bad);
  EXPECT_THAT(solved->reason, HasSubstr(rig.cameras[3].id + ": shares no pose"));
}

TEST(DegenerateCalibration, ComparesTheSquaresWithThePreviousRig) {
  const Rig rig = ring(5);
  auto input = input_of(rig, places_around(10, 0.5, 1), 0.05);
  input.board.square_m = 0.066;  // truly 60 mm
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  EXPECT_EQ(solved->verdict, CalibrationVerdict::bad);
  EXPECT_THAT(solved->reason, HasSubstr("10.0 % larger"));
  EXPECT_THAT(solved->reason, HasSubstr("60.00 mm would agree"));
}

TEST(Calibration, RefusesViewsThatCannotBe) {
  const Rig rig = ring(3);
  const auto input = input_of(rig, places_around(6, 0.5, 1));
  auto wrong = input;
  wrong.views[0].camera = "somebody";
  EXPECT_THAT(solve_calibration(wrong).error().message, HasSubstr("somebody"));
  wrong = input;
  wrong.views[0].corners[0].id = 700;
  EXPECT_EQ(solve_calibration(wrong).error().code, ErrorCode::invalid_argument);
  wrong = input;
  wrong.views[0].corners[0].pixel.x() = std::nan("");
  EXPECT_EQ(solve_calibration(wrong).error().code, ErrorCode::invalid_argument);
  wrong = input;
  wrong.views.push_back(wrong.views[0]);
  EXPECT_THAT(solve_calibration(wrong).error().message, HasSubstr("two views of pose"));
}

TEST(Calibration, GoesOnWithoutViewsOfASingleRow) {
  const Rig rig = ring(4);
  auto input = input_of(rig, places_around(10, 0.5, 4), 0.05);
  std::erase_if(input.views[0].corners, [](const TargetCorner& corner) { return corner.id / 7 != 2; });
  const auto solved = solve_calibration(input);
  ASSERT_TRUE(solved) << solved.error().message;
  EXPECT_EQ(solved->rig.cameras.size(), rig.cameras.size());
}

TEST(ProjectorView, IsWhatWasDecodedAroundEachCorner) {
  BoardView camera;
  camera.camera = "camera";
  camera.pose = 4;
  const Eigen::Vector2d good(30.3, 25.6), dark(70.2, 25.1), edge(2.0, 2.0);
  for (int id = 0; id < 3; ++id)
    camera.corners.push_back({.id = id,
                              .pixel = std::array{good, dark, edge}[static_cast<size_t>(id)],
                              .covariance = 1e-4 * Eigen::Matrix2d::Identity()});
  FloatImage position(100, 50, 2), sigma(100, 50, 1, 0.1F);
  std::mt19937 random(1);
  std::normal_distribution<double> noise(0, 0.1);
  for (int y = 0; y < 50; ++y)
    for (int x = 0; x < 100; ++x) {
      const bool lit = x < 50;
      position.at(x, y, 0) = lit ? static_cast<float>(200 + 0.8 * x - 0.1 * y + noise(random)) : std::nanf("");
      position.at(x, y, 1) = lit ? static_cast<float>(100 + 0.05 * x + 0.7 * y + noise(random)) : std::nanf("");
    }
  position.at(31, 26, 0) += 40;  // a pixel that was decoded wrongly
  const auto view = projector_view(camera, position, sigma, "projector");
  ASSERT_TRUE(view);
  EXPECT_EQ(view->camera, "projector");
  EXPECT_EQ(view->pose, 4);
  ASSERT_GE(view->corners.size(), 1U);
  EXPECT_EQ(view->corners[0].id, 0);
  const Eigen::Vector2d expected(200 + 0.8 * good.x() - 0.1 * good.y(), 100 + 0.05 * good.x() + 0.7 * good.y());
  EXPECT_LT((view->corners[0].pixel - expected).norm(), 0.1);
  EXPECT_LT(view->corners[0].covariance.trace(), 0.01);
  for (const TargetCorner& corner : view->corners) EXPECT_NE(corner.id, 1) << "nothing was decoded there";
  EXPECT_FALSE(projector_view(camera, position, FloatImage(100, 50, 2), "projector"));
}

TEST(Coverage, WantsTheNeediestCameraFirstAndIsContentInTheEnd) {
  const Rig rig = ring(4);
  const auto devices = calibration_devices(rig);
  const auto places = places_around(40, 0.5, 1);
  EXPECT_FALSE(assess_coverage(devices, board, {}).enough);
  const auto views = project_views(rig, places, 0, 1);
  // The first pose alone: cameras on the other side have seen nothing.
  const auto first_end = std::find_if(views.begin(), views.end(), [](const BoardView& view) { return view.pose > 0; });
  const Coverage begun = assess_coverage(devices, board, {views.begin(), first_end});
  EXPECT_FALSE(begun.enough);
  EXPECT_FALSE(begun.connected);
  EXPECT_THAT(begun.wants, HasSubstr("has not seen the board yet"));
  CoverageOptions options;
  options.least_covered = 0.2;
  const Coverage whole = assess_coverage(devices, board, views, options);
  EXPECT_TRUE(whole.connected);
  EXPECT_TRUE(whole.enough) << whole.wants;
  for (const CameraCoverage& camera : whole.cameras) {
    EXPECT_GT(camera.covered, 0.2);
    EXPECT_GE(camera.tilt_rad, options.least_tilt_rad);
  }
}

TEST(Coverage, IsDrawnUprightWithTheCornersWhereTheyWereSeen) {
  CalibrationDevice device{.id = "side", .width = 400, .height = 300, .mount_rotation_deg = 90};
  BoardView view;
  view.camera = "side";
  view.corners.push_back({.id = 0, .pixel = {0, 0}});
  const auto coverage = assess_coverage({&device, 1}, board, {&view, 1});
  const Image picture = draw_coverage(device, coverage.cameras[0], {&view, 1}, nullptr, 150);
  EXPECT_EQ(picture.width, 150);
  EXPECT_EQ(picture.height, 200);
  // Turned clockwise, the stored picture's top left corner is at the top right.
  EXPECT_EQ(picture.at(149, 0, 0), 255);
  EXPECT_NE(picture.at(0, 0, 0), 255);
}

TEST(CalibrationReport, NamesEveryDeviceAndNeedsNothingElse) {
  const Rig rig = ring(3);
  const auto input = input_of(rig, places_around(8, 0.5, 1), 0.05);
  auto solved = solve_calibration(input);
  ASSERT_TRUE(solved);
  solved->reason = "because <b> & \"quotes\"";
  const std::string page = calibration_report_html(*solved, input);
  for (const RigCamera& camera : rig.cameras) EXPECT_THAT(page, HasSubstr("<td>" + camera.id));
  EXPECT_THAT(page, HasSubstr("because &lt;b&gt; &amp; &quot;quotes&quot;"));
  EXPECT_EQ(page.find("http"), page.find("http://www.w3.org/2000/svg")) << "nothing is loaded from elsewhere";
  EXPECT_EQ(page.find("<script"), std::string::npos);
  EXPECT_EQ(page.find("nan"), std::string::npos);
}

}  // namespace
}  // namespace booth
