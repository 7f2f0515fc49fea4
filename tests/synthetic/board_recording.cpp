#include "tests/synthetic/board_recording.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <numbers>
#include <random>
#include <stdexcept>
#include <string>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/world_frame.h"
#include "pipeline/geometry/camera_model.h"
#include "replay/recording_writer.h"

namespace booth::synthetic {
namespace {

constexpr double degree = std::numbers::pi / 180;
const Eigen::Vector3d middle(0, 0.75, 0);

Eigen::Isometry3d looking_at(const Eigen::Vector3d& eye, const Eigen::Vector3d& target) {
  const Eigen::Vector3d forward = (target - eye).normalized();
  const Eigen::Vector3d right = forward.cross(Eigen::Vector3d::UnitY()).normalized();
  Eigen::Isometry3d camera_from_world = Eigen::Isometry3d::Identity();
  camera_from_world.linear().row(0) = right.transpose();
  camera_from_world.linear().row(1) = forward.cross(right).transpose();
  camera_from_world.linear().row(2) = forward.transpose();
  camera_from_world.translation() = -(camera_from_world.linear() * eye);
  return camera_from_world;
}

/// The board's middle at a point, its face towards +Z of the world, then turned about x, y and z.
Eigen::Isometry3d place(const CalibrationBoard& board, const Eigen::Vector3d& at, const Eigen::Vector3d& turns) {
  Eigen::Isometry3d centred = Eigen::Isometry3d::Identity();
  centred.translation() =
      Eigen::Vector3d(-0.5 * board.squares_x * board.square_m, -0.5 * board.squares_y * board.square_m, 0);
  Eigen::Isometry3d world_from_middle = Eigen::Isometry3d::Identity();
  const Eigen::Matrix3d upright = Eigen::Vector3d(1, -1, -1).asDiagonal();
  world_from_middle.linear() = Eigen::AngleAxisd(turns.y(), Eigen::Vector3d::UnitY()).toRotationMatrix() *
                               Eigen::AngleAxisd(turns.x(), Eigen::Vector3d::UnitX()).toRotationMatrix() *
                               Eigen::AngleAxisd(turns.z(), Eigen::Vector3d::UnitZ()).toRotationMatrix() * upright;
  world_from_middle.translation() = at;
  return world_from_middle * centred;
}

void blur(FloatImage& image, double sigma_px) {
  const int reach = static_cast<int>(std::ceil(3 * sigma_px));
  for (const auto& [dx, dy] : {std::pair{1, 0}, {0, 1}}) {
    const FloatImage from = image;
    for (int y = 0; y < image.height; ++y)
      for (int x = 0; x < image.width; ++x) {
        double sum = 0, weights = 0;
        for (int i = -reach; i <= reach; ++i) {
          const double weight = std::exp(-0.5 * i * i / (sigma_px * sigma_px));
          sum +=
              weight * from.at(std::clamp(x + i * dx, 0, image.width - 1), std::clamp(y + i * dy, 0, image.height - 1));
          weights += weight;
        }
        image.at(x, y) = static_cast<float>(sum / weights);
      }
  }
}

void expect(const Result<void>& result) {
  if (!result) throw std::runtime_error(result.error().message);
}

}  // namespace

CalibrationBoard small_board() {
  return {.squares_x = 6, .squares_y = 5, .square_m = 0.1, .marker_m = 0.075, .dictionary = "DICT_4X4_50"};
}

Rig arc_rig() {
  Rig rig;
  rig.name = "arc";
  rig.volume = {Eigen::Vector3d(-0.9, 0, -0.6), Eigen::Vector3d(0.9, 2.2, 0.6)};
  constexpr std::array<double, 4> azimuths{-36, -12, 12, 36};
  for (size_t i = 0; i < azimuths.size(); ++i) {
    RigCamera camera;
    camera.id = std::string("b").append(std::to_string(i));
    const double offset = static_cast<double>(i);
    camera.intrinsics = {.width = 320,
                         .height = 420,
                         .fx = 420 + offset,
                         .fy = 421 - offset,
                         .cx = 158 + offset,
                         .cy = 211 - offset,
                         .distortion = {-0.05, 0.02, 0.0003, -0.0004, 0}};
    const double azimuth = azimuths[i] * degree;
    constexpr double distance_m = 1.7;
    const Eigen::Vector3d eye(distance_m * std::sin(azimuth), i % 2 == 0 ? 1.5 : 1.7, distance_m * std::cos(azimuth));
    camera.camera_from_world = looking_at(eye, middle - Eigen::Vector3d(0, 0.15, 0));
    camera.rms_px = 0.3;
    rig.cameras.push_back(camera);
  }
  return rig;
}

std::vector<Eigen::Isometry3d> tilted_places(const CalibrationBoard& board, int count) {
  std::vector<Eigen::Isometry3d> places;
  for (int i = 0; i < count; ++i) {
    const double angle = 2 * std::numbers::pi * i / count;
    places.push_back(place(board,
                           middle + Eigen::Vector3d(0.2 * std::cos(angle), 0.15 * std::sin(angle), 0.1 * (i % 2)),
                           degree * Eigen::Vector3d(-25 + 25 * std::sin(angle), 18 * std::cos(angle), 8 * (i % 3))));
  }
  return places;
}

std::vector<Eigen::Isometry3d> coplanar_places(const CalibrationBoard& board, int count) {
  std::vector<Eigen::Isometry3d> places;
  for (int i = 0; i < count; ++i)
    places.push_back(place(board, middle + Eigen::Vector3d(0.06 * (i - count / 2), 0.04 * (i % 3), 0),
                           degree * Eigen::Vector3d(0, 0, 3 * i)));
  return places;
}

Eigen::Isometry3d place_on_floor(const CalibrationBoard& board) { return world_from_floor_board(board); }

Image photograph_board(const CalibratedView& camera, const CalibrationBoard& board,
                       const Eigen::Isometry3d& world_from_board, double blur_px, uint32_t seed) {
  constexpr float wall = 120;
  constexpr int samples = 3;
  constexpr double margin_m = 0.02;
  const BoardPattern pattern(board);
  const Eigen::Isometry3d board_from_camera = (camera.camera_from_world * world_from_board).inverse();
  const Eigen::Vector3d eye = board_from_camera.translation();
  const int width = camera.intrinsics.width, height = camera.intrinsics.height;
  FloatImage exact(width, height, 1);
  std::fill(exact.samples.begin(), exact.samples.end(), wall);
  // Nothing is to be seen of the board outside the box of its corners; from behind it is as the wall.
  Eigen::AlignedBox2d box;
  for (const double x : {-margin_m, pattern.width_m() + margin_m})
    for (const double y : {-margin_m, pattern.height_m() + margin_m})
      if (const auto pixel = project(camera, world_from_board * Eigen::Vector3d(x, y, 0))) box.extend(*pixel);
  for (int y = std::max(0, static_cast<int>(box.min().y()) - 2);
       eye.z() < 0 && y <= std::min(height - 1, static_cast<int>(box.max().y()) + 2); ++y)
    for (int x = std::max(0, static_cast<int>(box.min().x()) - 2);
         x <= std::min(width - 1, static_cast<int>(box.max().x()) + 2); ++x) {
      double sum = 0;
      for (int s = 0; s < samples * samples; ++s) {
        const Eigen::Vector2d pixel(x + (s % samples + 0.5) / samples - 0.5, y + (s / samples + 0.5) / samples - 0.5);
        const Eigen::Vector3d ray = board_from_camera.linear() * unproject(camera.intrinsics, pixel);
        const Eigen::Vector3d p = eye - eye.z() / ray.z() * ray;
        const bool on_paper = p.x() > -margin_m && p.y() > -margin_m && p.x() < pattern.width_m() + margin_m &&
                              p.y() < pattern.height_m() + margin_m;
        constexpr double paper = 190, ink = 25;
        sum += !on_paper ? wall : pattern.white(p.x(), p.y()) ? paper : ink;
      }
      exact.at(x, y) = static_cast<float>(sum / (samples * samples));
    }
  if (blur_px > 0) blur(exact, blur_px);
  std::mt19937 random(seed);
  std::normal_distribution<double> noise(0, 1);
  Image image(width, height, 1);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      image.at(x, y) = static_cast<uint8_t>(std::clamp(exact.at(x, y) + noise(random), 0.0, 255.0));
  return image;
}

std::filesystem::path write_board_recording(const std::filesystem::path& parent, const std::string& name,
                                            const BoardRecordingOptions& options) {
  auto writer = RecordingWriter::begin(parent, {.id = name, .created = "2026-11-22T10:15:00Z", .label = {}, .face = {}},
                                       options.rig);
  if (!writer) throw std::runtime_error(writer.error().message);
  const auto add = [&](const std::string& shot, const RigCamera& camera, int index, Image image) {
    expect((*writer)->add(shot, {.camera = camera.id,
                                 .index = index,
                                 .timestamp_ns = 1'000'000'000 + 40'000'000 * index,
                                 .frame_id = static_cast<uint64_t>(index),
                                 .exposure_us = 4000,
                                 .pixels = std::make_shared<const Image>(std::move(image))}));
  };
  constexpr uint8_t wall = 120;
  for (const auto& [shot, role] : {std::pair{"background", ShotRole::background}, {"body", ShotRole::body}}) {
    expect((*writer)->begin_shot({.name = shot, .role = role, .pattern = {}, .board = {}}));
    for (const RigCamera& camera : options.rig.cameras)
      add(shot, camera, 0, Image(camera.intrinsics.width, camera.intrinsics.height, 1, wall));
  }
  expect((*writer)->begin_shot(
      {.name = "board", .role = ShotRole::calibration_board, .pattern = {}, .board = options.told}));
  for (size_t pose = 0; pose < options.places.size(); ++pose)
    for (const RigCamera& camera : options.rig.cameras) {
      const bool blind = std::find(options.blind.begin(), options.blind.end(), camera.id) != options.blind.end();
      add("board", camera, static_cast<int>(pose),
          blind ? Image(camera.intrinsics.width, camera.intrinsics.height, 1, wall)
                : photograph_board(camera, options.board, options.places[pose], options.blur_px,
                                   static_cast<uint32_t>(pose)));
    }
  expect((*writer)->commit());
  return parent / name;
}

}  // namespace booth::synthetic
