#include "pipeline/calibration/pattern_registration.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "pipeline/geometry/camera_model.h"

namespace booth {
namespace {

constexpr double nowhere = std::numeric_limits<double>::quiet_NaN();

/// The board's coordinates at the corners of the crop's pixels.
struct BoardCoordinates {
  int width = 0;  ///< one more than the crop's
  std::vector<Eigen::Vector2d> at;

  const Eigen::Vector2d& corner(int x, int y) const {
    return at[static_cast<size_t>(y) * static_cast<size_t>(width) + static_cast<size_t>(x)];
  }
  Eigen::Vector2d inside(int x, int y, double fx, double fy) const {
    return (1 - fy) * ((1 - fx) * corner(x, y) + fx * corner(x + 1, y)) +
           fy * ((1 - fx) * corner(x, y + 1) + fx * corner(x + 1, y + 1));
  }
};

BoardCoordinates trace_board(const BoardView& view, const Intrinsics& intrinsics,
                             const Eigen::Isometry3d& camera_from_board) {
  BoardCoordinates coordinates;
  coordinates.width = view.crop.width + 1;
  coordinates.at.reserve(static_cast<size_t>(coordinates.width) * static_cast<size_t>(view.crop.height + 1));
  const Eigen::Isometry3d board_from_camera = camera_from_board.inverse();
  const Eigen::Vector3d eye = board_from_camera.translation();
  for (int y = 0; y <= view.crop.height; ++y)
    for (int x = 0; x <= view.crop.width; ++x) {
      const Eigen::Vector2d pixel = view.crop_origin.cast<double>() + Eigen::Vector2d(x - 0.5, y - 0.5);
      const Eigen::Vector3d ray = board_from_camera.linear() * unproject(intrinsics, pixel);
      const double distance = -eye.z() / ray.z();
      coordinates.at.emplace_back(distance > 0 ? Eigen::Vector2d((eye + distance * ray).head<2>())
                                               : Eigen::Vector2d(nowhere, nowhere));
    }
  return coordinates;
}

/// How far (x, y) lies from the nearest line between squares, in squares.
double distance_from_line(const Eigen::Vector2d& p, double square_m) {
  const Eigen::Vector2d squares = p / square_m;
  return std::min(std::abs(squares.x() - std::round(squares.x())), std::abs(squares.y() - std::round(squares.y())));
}

/// The share of white in each pixel's square, 0 … 1; exact only up to `near` squares from the lines.
FloatImage draw_pattern(const BoardPattern& pattern, const BoardCoordinates& coordinates, int width, int height,
                        double near) {
  // A low-discrepancy set, so that also a line along the pixels' rows is placed to 1/48 of a pixel. Source: M. Roberts,
  // "The unreasonable effectiveness of quasirandom sequences", 2018 (the additive recurrence R2).
  constexpr int samples = 48;
  constexpr double plastic = 1.32471795724474602596;
  std::array<Eigen::Vector2d, samples> places;
  for (size_t i = 0; i < samples; ++i) {
    const double n = static_cast<double>(i) + 0.5;
    places[i] = {std::fmod(n / plastic, 1.0), std::fmod(n / (plastic * plastic), 1.0)};
  }
  const double square_m = pattern.board().square_m;
  const auto white = [&](const Eigen::Vector2d& p) { return !p.allFinite() || pattern.white(p.x(), p.y()); };
  FloatImage drawing(width, height, 1, 1.0F);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const Eigen::Vector2d centre = coordinates.inside(x, y, 0.5, 0.5);
      if (!centre.allFinite() || distance_from_line(centre, square_m) > near) {
        drawing.at(x, y) = white(centre) ? 1.0F : 0.0F;
        continue;
      }
      int count = 0;
      for (const Eigen::Vector2d& place : places)
        count += white(coordinates.inside(x, y, place.x(), place.y())) ? 1 : 0;
      drawing.at(x, y) = static_cast<float>(count) / static_cast<float>(samples);
    }
  return drawing;
}

FloatImage blurred(const FloatImage& image, double sigma_px) {
  constexpr double negligible_px = 0.15;
  if (sigma_px < negligible_px) return image;
  const int radius = static_cast<int>(std::ceil(3.5 * sigma_px));
  std::vector<float> kernel;
  float sum = 0;
  for (int i = -radius; i <= radius; ++i) {
    kernel.push_back(static_cast<float>(std::exp(-0.5 * i * i / (sigma_px * sigma_px))));
    sum += kernel.back();
  }
  for (float& weight : kernel) weight /= sum;
  FloatImage rows(image.width, image.height, 1), result(image.width, image.height, 1);
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      float value = 0;
      for (int i = -radius; i <= radius; ++i)
        value += kernel[static_cast<size_t>(i + radius)] * image.at(std::clamp(x + i, 0, image.width - 1), y);
      rows.at(x, y) = value;
    }
  for (int y = 0; y < image.height; ++y)
    for (int x = 0; x < image.width; ++x) {
      float value = 0;
      for (int i = -radius; i <= radius; ++i)
        value += kernel[static_cast<size_t>(i + radius)] * rows.at(x, std::clamp(y + i, 0, image.height - 1));
      result.at(x, y) = value;
    }
  return result;
}

/// The appearance model's terms: light and its slope, drawing with its square and cube, gradient, Laplacian.
constexpr int terms = 9;
constexpr int drawing_term = 3, gradient_x_term = 6, gradient_y_term = 7, laplacian_term = 8;
using Terms = Eigen::Matrix<double, terms, 1>;

struct Patch {
  Eigen::Matrix<double, terms, terms> normal = Eigen::Matrix<double, terms, terms>::Zero();
  Terms right = Terms::Zero();
  double squares = 0, sum = 0;
  int pixels = 0;
};

}  // namespace

std::vector<TargetCorner> register_pattern(const BoardPattern& pattern, const BoardView& view,
                                           const Intrinsics& intrinsics, const Eigen::Isometry3d& camera_from_board,
                                           double& blur_px) {
  const CalibrationBoard& board = pattern.board();
  const int width = view.crop.width, height = view.crop.height;
  const auto on_board = board_corners(board);
  const BoardCoordinates coordinates = trace_board(view, intrinsics, camera_from_board);
  const double margin = 0.5 * (1 - board.marker_m / board.square_m);
  const double near = 0.75 * margin;
  const FloatImage drawing = blurred(draw_pattern(pattern, coordinates, width, height, 1.5 * margin), blur_px);

  std::vector<std::optional<Eigen::Vector2d>> predicted;
  for (const Eigen::Vector3d& p : on_board)
    predicted.push_back(project_camera_point(intrinsics, camera_from_board * p));

  std::vector<Patch> patches(on_board.size());
  constexpr double size_of_slope = 16;  // pixels; keeps the normal equations' terms of one size
  for (int y = 1; y + 1 < height; ++y)
    for (int x = 1; x + 1 < width; ++x) {
      const Eigen::Vector2d p = coordinates.inside(x, y, 0.5, 0.5);
      if (!p.allFinite() || distance_from_line(p, board.square_m) > near) continue;
      // The outer squares' lines belong to the outermost corners.
      const int column = std::clamp(static_cast<int>(std::floor(p.x() / board.square_m + 0.5)), 1, board.squares_x - 1);
      const int row = std::clamp(static_cast<int>(std::floor(p.y() / board.square_m + 0.5)), 1, board.squares_y - 1);
      // Where the board ends there is no telling what comes next.
      if (p.x() < near * board.square_m || p.y() < near * board.square_m ||
          p.x() > pattern.width_m() - near * board.square_m || p.y() > pattern.height_m() - near * board.square_m)
        continue;
      const auto id = static_cast<size_t>((row - 1) * (board.squares_x - 1) + column - 1);
      if (!predicted[id]) continue;
      const Eigen::Vector2d offset =
          (view.crop_origin.cast<double>() + Eigen::Vector2d(x, y) - *predicted[id]) / size_of_slope;
      const auto at = [&](int i, int j) { return static_cast<double>(drawing.at(i, j)); };
      const double here = at(x, y);
      Terms t;
      t << 1, offset.x(), offset.y(), here, here * here, here * here * here, 0.5 * (at(x + 1, y) - at(x - 1, y)),
          0.5 * (at(x, y + 1) - at(x, y - 1)), at(x + 1, y) + at(x - 1, y) + at(x, y + 1) + at(x, y - 1) - 4 * here;
      const double seen = view.crop.at(x, y);
      Patch& patch = patches[id];
      patch.normal += t * t.transpose();
      patch.right += seen * t;
      patch.squares += seen * seen;
      patch.sum += seen;
      ++patch.pixels;
    }

  std::vector<TargetCorner> corners;
  std::vector<double> variances;
  constexpr int fewest_pixels = 30;
  constexpr double least_explained = 0.8;  // of the grey values' variance
  constexpr double least_contrast = 10;    // grey levels
  constexpr double most_shift_px = 1.5;
  constexpr double model_error_px = 0.004;  // of the drawing itself
  for (size_t id = 0; id < patches.size(); ++id) {
    const Patch& patch = patches[id];
    if (patch.pixels < fewest_pixels) continue;
    const Eigen::LDLT<Eigen::Matrix<double, terms, terms>> solver(patch.normal);
    const Terms pivots = solver.vectorD();
    if (solver.info() != Eigen::Success || !(pivots.minCoeff() > 1e-9 * pivots.maxCoeff())) continue;
    const Terms fit = solver.solve(patch.right);
    const double unexplained = patch.squares - fit.dot(patch.right);
    const double variance = patch.squares - patch.sum * patch.sum / patch.pixels;
    // From black to white the drawing and its powers together are the contrast; on average its slope is as large.
    const double contrast = fit.segment<3>(drawing_term).sum();
    if (!(contrast > least_contrast) || unexplained > (1 - least_explained) * variance) continue;
    const double noise_squared = std::max(0.1, unexplained / (patch.pixels - terms));
    const Eigen::Matrix<double, terms, terms> inverse = solver.solve(Eigen::Matrix<double, terms, terms>::Identity());
    TargetCorner corner;
    corner.id = static_cast<int>(id);
    // The picture is the drawing moved by d: to first order the drawing minus d times its gradient.
    const Eigen::Vector2d shift(-fit[gradient_x_term] / contrast, -fit[gradient_y_term] / contrast);
    if (!(shift.norm() < most_shift_px)) continue;
    corner.pixel = *predicted[id] + shift;
    corner.covariance = noise_squared / (contrast * contrast) * inverse.block<2, 2>(gradient_x_term, gradient_x_term) +
                        model_error_px * model_error_px * Eigen::Matrix2d::Identity();
    corners.push_back(corner);
    // A Gaussian's variance grows by twice the Laplacian's coefficient.
    variances.push_back(2 * fit[laplacian_term] / contrast);
  }
  if (!variances.empty()) {
    const auto middle = variances.begin() + static_cast<std::ptrdiff_t>(variances.size() / 2);
    std::nth_element(variances.begin(), middle, variances.end());
    constexpr double most_blur_px = 6;
    blur_px = std::clamp(std::sqrt(std::max(0.0, blur_px * blur_px + *middle)), 0.0, most_blur_px);
  }
  return corners;
}

}  // namespace booth
