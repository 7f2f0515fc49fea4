#include "pipeline/calibration/coverage.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>
#include <opencv2/calib3d.hpp>
#include <set>

#include "pipeline/calibration/board.h"

namespace booth {
namespace {

/// Cells along the longer side of a picture.
constexpr int cells_along = 8;

struct Cells {
  int columns = 0, rows = 0;
  double width = 0, height = 0;  ///< of one, pixels

  size_t at(const Eigen::Vector2d& pixel) const {
    const int x = std::clamp(static_cast<int>((pixel.x() + 0.5) / width), 0, columns - 1);
    const int y = std::clamp(static_cast<int>((pixel.y() + 0.5) / height), 0, rows - 1);
    return static_cast<size_t>(y * columns + x);
  }
};

Cells cells_of(const CalibrationDevice& device) {
  const double side = static_cast<double>(std::max(device.width, device.height)) / cells_along;
  Cells cells;
  cells.columns = std::max(1, static_cast<int>(std::lround(device.width / side)));
  cells.rows = std::max(1, static_cast<int>(std::lround(device.height / side)));
  cells.width = static_cast<double>(device.width) / cells.columns;
  cells.height = static_cast<double>(device.height) / cells.rows;
  return cells;
}

/// The direction that the board faces as a camera sees it, from its homography and a lens of usual width: good enough
/// to tell whether the board was tilted. Nothing where the corners are too few or in a row.
std::optional<Eigen::Vector3d> facing(const CalibrationDevice& device, const std::vector<Eigen::Vector3d>& on_board,
                                      const BoardView& view) {
  constexpr size_t fewest_corners = 4;
  if (view.corners.size() < fewest_corners) return std::nullopt;
  std::vector<cv::Point2f> board, pixel;
  const double focal = 1.2 * std::max(device.width, device.height);
  for (const TargetCorner& corner : view.corners) {
    const Eigen::Vector3d& p = on_board[static_cast<size_t>(corner.id)];
    board.emplace_back(static_cast<float>(p.x()), static_cast<float>(p.y()));
    pixel.emplace_back(static_cast<float>((corner.pixel.x() - 0.5 * device.width) / focal),
                       static_cast<float>((corner.pixel.y() - 0.5 * device.height) / focal));
  }
  const cv::Mat found = cv::findHomography(board, pixel, 0);
  if (found.empty()) return std::nullopt;
  const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> h(found.ptr<double>());
  const Eigen::Vector3d normal = h.col(0).cross(h.col(1));
  if (!(normal.norm() > 0)) return std::nullopt;
  return normal.normalized();
}

std::string number_of(int count, const char* one, const char* many) {
  return std::to_string(count) + " " + (count == 1 ? one : many);
}

/// Where the picture is emptiest, in words, as one sees it upright.
std::string emptiest_part(const CalibrationDevice& device, const CameraCoverage& coverage) {
  struct Part {
    const char* name;
    double x, y;  ///< direction from the middle in the upright picture
  };
  constexpr std::array<Part, 4> parts{{{"left", -1, 0}, {"right", 1, 0}, {"upper", 0, -1}, {"lower", 0, 1}}};
  const char* emptiest = "left";
  double fewest = 2;
  for (const Part& part : parts) {
    // The stored picture is turned back by the mount's rotation.
    double x = part.x, y = part.y;
    for (int turn = 0; turn < device.mount_rotation_deg; turn += 90) std::tie(x, y) = std::pair{y, -x};
    int cells = 0, filled = 0;
    for (int row = 0; row < coverage.rows; ++row)
      for (int column = 0; column < coverage.columns; ++column) {
        const double u = (column + 0.5) / coverage.columns - 0.5, v = (row + 0.5) / coverage.rows - 0.5;
        if (u * x + v * y <= 0) continue;
        ++cells;
        filled += coverage.corners[static_cast<size_t>(row * coverage.columns + column)] > 0 ? 1 : 0;
      }
    const double share = cells > 0 ? static_cast<double>(filled) / cells : 1;
    if (share < fewest) {
      fewest = share;
      emptiest = part.name;
    }
  }
  return emptiest;
}

}  // namespace

Coverage assess_coverage(std::span<const CalibrationDevice> devices, const CalibrationBoard& board,
                         std::span<const BoardView> views, const CoverageOptions& options) {
  const auto on_board = board_corners(board);
  std::map<int, std::set<std::string>> seen_by;  // by pose
  for (const BoardView& view : views)
    if (!view.corners.empty()) seen_by[view.pose].insert(view.camera);

  Coverage coverage;
  for (const CalibrationDevice& device : devices) {
    const Cells cells = cells_of(device);
    CameraCoverage camera;
    camera.camera = device.id;
    camera.columns = cells.columns;
    camera.rows = cells.rows;
    camera.corners.assign(static_cast<size_t>(cells.columns * cells.rows), 0);
    std::vector<Eigen::Vector3d> directions;
    for (const BoardView& view : views) {
      if (view.camera != device.id || view.corners.empty()) continue;
      ++camera.views;
      if (seen_by[view.pose].size() > 1) ++camera.shared_views;
      for (const TargetCorner& corner : view.corners) ++camera.corners[cells.at(corner.pixel)];
      if (const auto direction = facing(device, on_board, view)) directions.push_back(*direction);
    }
    for (const Eigen::Vector3d& a : directions)
      for (const Eigen::Vector3d& b : directions)
        camera.tilt_rad = std::max(camera.tilt_rad, std::acos(std::clamp(a.dot(b), -1.0, 1.0)));
    const auto filled = std::count_if(camera.corners.begin(), camera.corners.end(), [](int n) { return n > 0; });
    camera.covered = static_cast<double>(filled) / static_cast<double>(camera.corners.size());

    if (camera.views == 0)
      camera.wants = device.id + " has not seen the board yet";
    else if (camera.shared_views < options.fewest_shared)
      camera.wants = device.id + " shares " + number_of(camera.shared_views, "shot", "shots") +
                     " with other cameras: show it the board together with a neighbour";
    else if (camera.views < options.fewest_views)
      camera.wants = device.id + " has " + number_of(camera.views, "shot", "shots") + " of the board; " +
                     std::to_string(options.fewest_views - camera.views) + " more are wanted";
    else if (camera.tilt_rad < options.least_tilt_rad)
      camera.wants = device.id + " saw the board always from the same direction: tilt it more";
    else if (camera.covered < options.least_covered)
      camera.wants = device.id + " has seen the board in too little of its picture: hold it towards the " +
                     emptiest_part(device, camera) + " part";
    else
      camera.enough = true;
    coverage.cameras.push_back(std::move(camera));
  }

  // Cameras tied by poses that they saw in common.
  std::vector<size_t> set(devices.size());
  std::iota(set.begin(), set.end(), size_t{0});
  const auto root = [&](size_t i) {
    while (set[i] != i) i = set[i];
    return i;
  };
  for (const auto& [pose, cameras] : seen_by) {
    std::optional<size_t> first;
    for (size_t i = 0; i < devices.size(); ++i) {
      if (!cameras.contains(devices[i].id)) continue;
      if (first)
        set[std::max(root(i), root(*first))] = std::min(root(i), root(*first));
      else
        first = i;
    }
  }
  coverage.connected = !devices.empty();
  for (size_t i = 0; i < devices.size(); ++i) coverage.connected &= root(i) == 0;
  const auto poorest = std::min_element(coverage.cameras.begin(), coverage.cameras.end(),
                                        [](const CameraCoverage& a, const CameraCoverage& b) {
                                          return std::tuple(a.enough, a.shared_views, a.views, a.covered) <
                                                 std::tuple(b.enough, b.shared_views, b.views, b.covered);
                                        });
  const bool all = std::all_of(coverage.cameras.begin(), coverage.cameras.end(),
                               [](const CameraCoverage& camera) { return camera.enough; });
  coverage.enough = coverage.connected && all;
  if (!all)
    coverage.wants = poorest->wants;
  else if (!coverage.connected)
    coverage.wants =
        "the cameras fall into groups that saw no pose of the board in common: show the board between them";
  return coverage;
}

Image draw_coverage(const CalibrationDevice& device, const CameraCoverage& coverage, std::span<const BoardView> views,
                    const Image* backdrop, int width) {
  const bool turned = device.mount_rotation_deg % 180 != 0;
  const int upright_width = turned ? device.height : device.width;
  const int upright_height = turned ? device.width : device.height;
  const double scale = static_cast<double>(upright_width) / width;
  const int height = std::max(1, static_cast<int>(std::lround(upright_height / scale)));
  // From the upright picture to the stored one.
  const auto stored = [&](double x, double y) -> Eigen::Vector2d {
    switch (device.mount_rotation_deg) {
      case 90: return {y, device.height - 1 - x};
      case 180: return {device.width - 1 - x, device.height - 1 - y};
      case 270: return {device.width - 1 - y, x};
      default: return {x, y};
    }
  };
  const auto upright = [&](const Eigen::Vector2d& p) -> Eigen::Vector2d {
    switch (device.mount_rotation_deg) {
      case 90: return {device.height - 1 - p.y(), p.x()};
      case 180: return {device.width - 1 - p.x(), device.height - 1 - p.y()};
      case 270: return {p.y(), device.width - 1 - p.x()};
      default: return p;
    }
  };
  const bool usable = backdrop && backdrop->width == device.width && backdrop->height == device.height;
  const Cells cells = cells_of(device);
  constexpr int plenty = 20;  // corners in a cell
  Image picture(width, height, 3, 128);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const Eigen::Vector2d p = stored((x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5);
      const int column = std::clamp(static_cast<int>(std::lround(p.x())), 0, device.width - 1);
      const int row = std::clamp(static_cast<int>(std::lround(p.y())), 0, device.height - 1);
      const double filled =
          std::min(1.0, static_cast<double>(coverage.corners[cells.at(p)]) / static_cast<double>(plenty));
      // Thin cells are red, well covered ones green.
      const std::array<double, 3> tint{220 * (1 - filled), 180 * filled, 40};
      constexpr double opacity = 0.3;
      for (int channel = 0; channel < 3; ++channel) {
        const double base =
            usable ? backdrop->at(column, row, backdrop->channels >= 3 ? channel : 0) : picture.at(x, y, channel);
        picture.at(x, y, channel) =
            static_cast<uint8_t>(std::lround((1 - opacity) * base + opacity * tint[static_cast<size_t>(channel)]));
      }
    }
  const int dot = std::max(1, width / 200);
  for (const BoardView& view : views) {
    if (view.camera != device.id) continue;
    for (const TargetCorner& corner : view.corners) {
      const Eigen::Vector2d p = (upright(corner.pixel) + Eigen::Vector2d(0.5, 0.5)) / scale;
      const int cx = static_cast<int>(p.x()), cy = static_cast<int>(p.y());
      for (int y = cy - dot; y <= cy + dot; ++y)
        for (int x = cx - dot; x <= cx + dot; ++x)
          if (picture.contains(x, y)) {
            picture.at(x, y, 0) = 255;
            picture.at(x, y, 1) = 230;
            picture.at(x, y, 2) = 0;
          }
    }
  }
  return picture;
}

}  // namespace booth
