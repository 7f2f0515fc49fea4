// The projector calibrated as an inverse camera, from pictures to its pose: Gray codes thrown on a board, photographed
// with noise, decoded, read at the board's corners, and solved together with the cameras.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <iostream>
#include <numbers>
#include <random>
#include <span>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/calibration.h"
#include "pipeline/geometry/camera_model.h"
#include "pipeline/structured_light/gray_code.h"
#include "pipeline/thread_pool.h"
#include "tests/synthetic/structured_light.h"

namespace booth {
namespace {

const CalibrationBoard board{
    .squares_x = 5, .squares_y = 7, .square_m = 0.036, .marker_m = 0.027, .dictionary = "DICT_4X4_50"};
const Eigen::Vector3d target(0, 1.5, 0);

/// Two cameras and a projector before the place of a face.
Rig scanner() {
  Rig rig = synthetic::scanner_rig(target);
  constexpr double finer = 480.0 / 360;
  for (RigCamera& camera : rig.cameras) {
    Intrinsics& k = camera.intrinsics;
    k.width = 480, k.height = 360;
    k.fx *= finer, k.fy *= finer, k.cx *= finer, k.cy *= finer;
  }
  return rig;
}

std::vector<Eigen::Isometry3d> places(int count) {
  std::mt19937 random(11);
  std::uniform_real_distribution<double> share(-1, 1);
  std::vector<Eigen::Isometry3d> poses;
  for (int i = 0; i < count; ++i) {
    Eigen::Isometry3d middle_from_board = Eigen::Isometry3d::Identity();
    middle_from_board.translation() << -board.squares_x * board.square_m / 2, -board.squares_y * board.square_m / 2, 0;
    Eigen::Isometry3d pose = Eigen::Isometry3d::Identity();
    pose.translation() = target + Eigen::Vector3d(0.03 * share(random), 0.02 * share(random), 0.06 * share(random));
    const Eigen::Matrix3d upright = Eigen::Vector3d(1, -1, -1).asDiagonal();
    // Tilted to another side each time.
    const double side = 2 * std::numbers::pi * i / count, tilt = 0.45;
    pose.linear() = Eigen::AngleAxisd(tilt, Eigen::Vector3d(std::cos(side), std::sin(side), 0)).toRotationMatrix() *
                    Eigen::AngleAxisd(0.2 * share(random), Eigen::Vector3d::UnitZ()).toRotationMatrix() * upright;
    poses.push_back(pose * middle_from_board);
  }
  return poses;
}

/// Standard normal numbers, drawn once.
const std::vector<float>& noise() {
  static const std::vector<float> values = [] {
    std::mt19937 random(5);
    std::normal_distribution<float> normal;
    std::vector<float> drawn(100003);
    for (float& value : drawn) value = normal(random);
    return drawn;
  }();
  return values;
}

/// The light of the room, and what the projector adds to white paper.
constexpr double room = 110, contrast = 120, dimmed_room = 30;
constexpr double noise_levels = 1.2;

/// One image of the pattern: a stripe's brightness depends on one coordinate, and is looked up.
struct Stripes {
  static constexpr int steps = 50;  ///< a projector pixel
  bool columns = true;
  std::vector<float> brightness;

  double at(float coordinate) const { return double{brightness[static_cast<size_t>(std::lround(coordinate * steps))]}; }
};
std::vector<Stripes> stripes_of(const GrayCodePattern& pattern) {
  constexpr double blur_px = 0.6;
  std::vector<Stripes> all;
  for (int image = 0; image < pattern_count(pattern); ++image)
    for (const bool columns : {true, false}) {
      Stripes stripes{.columns = columns, .brightness = {}};
      for (int i = 0; i < (columns ? pattern.width : pattern.height) * Stripes::steps; ++i) {
        const double at = i / double{Stripes::steps};
        const Eigen::Vector2d place = columns ? Eigen::Vector2d(at, 0.5) : Eigen::Vector2d(0.5, at);
        stripes.brightness.push_back(static_cast<float>(synthetic::brightness(pattern, image, place, blur_px)));
      }
      const auto [least, most] = std::minmax_element(stripes.brightness.begin(), stripes.brightness.end());
      // White and black are alike in both.
      if (*least == *most && columns && image < pattern_count(pattern) - 2) continue;
      all.push_back(std::move(stripes));
      break;
    }
  return all;
}

/// A camera that sees the board.
class View {
 public:
  View(const CalibratedView& camera, const CalibratedView& projector, const Eigen::Isometry3d& world_from_board)
      : camera_(camera),
        albedo_(camera.intrinsics.width, camera.intrinsics.height, 1),
        lit_(camera.intrinsics.width, camera.intrinsics.height, 2, -1) {
    const BoardPattern pattern(board);
    const Eigen::Isometry3d board_from_world = world_from_board.inverse();
    const Eigen::Vector3d eye = board_from_world * camera.center();
    constexpr int samples = 3;
    constexpr double margin_m = 0.01, wall = 0.4;
    const auto meet = [&](double x, double y) -> Eigen::Vector3d {
      const Eigen::Vector3d ray = board_from_world.linear() * world_ray(camera, {x, y});
      return eye - eye.z() / ray.z() * ray;
    };
    for (int y = 0; y < albedo_.height; ++y)
      for (int x = 0; x < albedo_.width; ++x) {
        double sum = 0;
        for (int s = 0; s < samples * samples; ++s) {
          const Eigen::Vector3d p =
              meet(x + (s % samples + 0.5) / samples - 0.5, y + (s / samples + 0.5) / samples - 0.5);
          const bool on_board = p.x() > -margin_m && p.y() > -margin_m && p.x() < pattern.width_m() + margin_m &&
                                p.y() < pattern.height_m() + margin_m;
          sum += !on_board ? wall : pattern.white(p.x(), p.y()) ? 1.0 : 0.12;
        }
        albedo_.at(x, y) = static_cast<float>(sum / (samples * samples));
        const auto at = project(projector, world_from_board * meet(x, y));
        if (!at || at->minCoeff() < 0 || at->x() > projector.intrinsics.width - 1 ||
            at->y() > projector.intrinsics.height - 1)
          continue;
        lit_.at(x, y, 0) = static_cast<float>(at->x());
        lit_.at(x, y, 1) = static_cast<float>(at->y());
      }
  }

  Image photograph(uint32_t seed) const {
    return picture(seed, [](int, int) { return room; });
  }

  std::vector<Frame> sequence(std::span<const Stripes> pattern, uint32_t seed) const {
    std::vector<Frame> frames;
    for (const Stripes& stripes : pattern) {
      Frame frame;
      frame.camera = camera_.id;
      frame.index = static_cast<int>(frames.size());
      frame.pixels =
          std::make_shared<const Image>(picture(seed + static_cast<uint32_t>(frame.index), [&](int x, int y) {
            const float at = lit_.at(x, y, stripes.columns ? 0 : 1);
            return at < 0 ? dimmed_room : dimmed_room + contrast * stripes.at(at);
          }));
      frames.push_back(std::move(frame));
    }
    return frames;
  }

 private:
  template <class Light>
  Image picture(uint32_t seed, const Light& light) const {
    Image image(albedo_.width, albedo_.height, 1);
    size_t draw = seed * 7919 % noise().size();
    for (int y = 0; y < image.height; ++y)
      for (int x = 0; x < image.width; ++x) {
        draw = draw + 1 < noise().size() ? draw + 1 : 0;
        const double value = double{albedo_.at(x, y)} * light(x, y) + noise_levels * double{noise()[draw]};
        image.at(x, y) = static_cast<uint8_t>(std::clamp(std::lround(value), 0L, 255L));
      }
    return image;
  }

  const CalibratedView& camera_;
  FloatImage albedo_;
  FloatImage lit_;  ///< the projector's coordinates, −1 where it does not shine
};

TEST(ProjectorCalibration, FromPicturesOfGrayCodesOnTheBoardToItsPose) {
  const Rig truth = scanner();
  const CalibratedView& projector = *truth.projector;
  const GrayCodePattern pattern{projector.intrinsics.width, projector.intrinsics.height, true, true, true};
  const auto stripes = stripes_of(pattern);
  const auto poses = places(6);
  CalibrationInput input;
  input.devices = calibration_devices(truth);
  input.board = board;
  input.previous = truth;
  ThreadPool pool;
  std::vector<std::vector<BoardView>> views(poses.size());
  pool.work().parallel_for(poses.size(), 1, [&](size_t begin, size_t end) {
    for (size_t pose = begin; pose < end; ++pose)
      for (const RigCamera& camera : truth.cameras) {
        const View view(camera, projector, poses[pose]);
        const auto seed = static_cast<uint32_t>(1000 * pose);
        auto found = find_board(camera.id, static_cast<int>(pose), view.photograph(seed), board);
        ASSERT_TRUE(found);
        ASSERT_FALSE(found->corners.empty()) << camera.id << " in pose " << pose;
        if (&camera == &truth.cameras.front()) {
          const auto decoded = decode_gray_code(view.sequence(stripes, seed + 1), pattern);
          ASSERT_TRUE(decoded) << decoded.error().message;
          auto lit = projector_view(*found, decoded->position, decoded->sigma, projector.id);
          ASSERT_TRUE(lit) << lit.error().message;
          views[pose].push_back(std::move(*lit));
        }
        views[pose].push_back(std::move(*found));
      }
  });
  for (auto& of_pose : views) std::move(of_pose.begin(), of_pose.end(), std::back_inserter(input.views));
  const auto solved = solve_calibration(input, {}, pool.work());
  ASSERT_TRUE(solved) << solved.error().message;
  ASSERT_TRUE(solved->rig.projector);
  const DeviceQuality& quality = solved->devices.back();
  ASSERT_EQ(quality.id, projector.id);
  // Relative to a camera, whatever the world frame.
  const CalibratedView& found = *solved->rig.projector;
  const Eigen::Isometry3d expected = projector.camera_from_world * truth.cameras[0].camera_from_world.inverse();
  const Eigen::Isometry3d measured = found.camera_from_world * solved->rig.cameras[0].camera_from_world.inverse();
  const double center_m = (expected.inverse().translation() - measured.inverse().translation()).norm();
  const double turn_deg =
      Eigen::AngleAxisd(expected.linear() * measured.linear().transpose()).angle() * 180 / std::numbers::pi;
  const double focal = std::abs(found.intrinsics.fx / projector.intrinsics.fx - 1);
  std::cout << "projector: rms " << quality.rms_px << " px over " << quality.corners << " corners, centre off by "
            << 1000 * center_m << " mm (sigma " << 1000 * quality.pose.center_m << "), turned by " << turn_deg
            << " deg (sigma " << quality.pose.rotation_rad * 180 / std::numbers::pi << "), focal length by "
            << 100 * focal << " %\n";
  EXPECT_GT(quality.corners, 100);
  EXPECT_LT(quality.rms_px, 0.1);
  EXPECT_LT(center_m, 0.002);
  // A turn and the principal point make up for each other but for the depth of the scene.
  EXPECT_LT(turn_deg, 0.3);
  EXPECT_LT(focal, 0.003);
  // The corners' own rays meet where the projector sees them: what a face scan needs.
  double worst_px = 0;
  for (const double x : {-0.08, 0.0, 0.08})
    for (const double y : {-0.1, 0.0, 0.1})
      for (const double z : {-0.05, 0.05}) {
        const Eigen::Vector3d p_camera = truth.cameras[0].camera_from_world * (target + Eigen::Vector3d(x, y, z));
        const auto a = project_camera_point(projector.intrinsics, expected * p_camera);
        const auto b = project_camera_point(found.intrinsics, measured * p_camera);
        ASSERT_TRUE(a && b);
        worst_px = std::max(worst_px, (*a - *b).norm());
      }
  std::cout << "a point of the face is off by up to " << worst_px << " projector pixels\n";
  EXPECT_LT(worst_px, 0.15);
}

}  // namespace
}  // namespace booth
