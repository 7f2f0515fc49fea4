#include "pipeline/calibration/board_view.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <numbers>
#include <opencv2/aruco.hpp>
#include <opencv2/calib3d.hpp>
#include <opencv2/imgproc.hpp>

#include "pipeline/calibration/board.h"
#include "pipeline/calibration/marker_dictionary.h"

namespace booth {
namespace {

cv::Mat grey_of(const Image& image) {
  // OpenCV does not write through these headers.
  const cv::Mat pixels(image.height, image.width, CV_8UC(image.channels),
                       const_cast<uint8_t*>(image.samples.data()));  // NOLINT
  if (image.channels == 1) return pixels;
  cv::Mat grey;
  cv::cvtColor(pixels, grey, image.channels == 4 ? cv::COLOR_RGBA2GRAY : cv::COLOR_RGB2GRAY);
  return grey;
}

double median(std::vector<double> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// A marker of the board with its corners in the picture and on the board, both in the same order.
struct FoundMarker {
  int id = 0;
  std::array<cv::Point2f, 4> pixel;
  std::array<cv::Point2f, 4> board_m;
};

std::array<cv::Point2f, 4> marker_on_board(const BoardPattern::Marker& marker, double size_m) {
  const auto x = static_cast<float>(marker.corner.x()), y = static_cast<float>(marker.corner.y());
  const auto size = static_cast<float>(size_m);
  return {cv::Point2f(x, y), {x + size, y}, {x + size, y + size}, {x, y + size}};
}

struct MarkerSearch {
  std::vector<FoundMarker> markers;
  std::vector<std::vector<cv::Point2f>> unread;  ///< squares that hold no readable marker
};

MarkerSearch find_markers(const cv::Mat& grey, const BoardPattern& pattern) {
  const auto dictionary = cv::aruco::getPredefinedDictionary(find_dictionary(pattern.board().dictionary).value());
  const auto parameters = cv::aruco::DetectorParameters::create();
  parameters->cornerRefinementMethod = cv::aruco::CORNER_REFINE_NONE;
  std::vector<std::vector<cv::Point2f>> corners;
  std::vector<int> ids;
  MarkerSearch found;
  cv::aruco::detectMarkers(grey, dictionary, corners, ids, parameters, found.unread);
  for (size_t i = 0; i < ids.size(); ++i) {
    if (ids[i] < 0 || static_cast<size_t>(ids[i]) >= pattern.markers().size()) continue;
    FoundMarker marker{.id = ids[i], .pixel = {}, .board_m = {}};
    std::copy_n(corners[i].begin(), 4, marker.pixel.begin());
    marker.board_m = marker_on_board(pattern.markers()[static_cast<size_t>(ids[i])], pattern.board().marker_m);
    found.markers.push_back(marker);
  }
  std::sort(found.markers.begin(), found.markers.end(), [](const auto& a, const auto& b) { return a.id < b.id; });
  return found;
}

cv::Mat homography_of(const std::vector<const FoundMarker*>& markers) {
  std::vector<cv::Point2f> board, pixel;
  for (const FoundMarker* marker : markers) {
    board.insert(board.end(), marker->board_m.begin(), marker->board_m.end());
    pixel.insert(pixel.end(), marker->pixel.begin(), marker->pixel.end());
  }
  return cv::findHomography(board, pixel, 0);
}

Eigen::Vector2d apply(const cv::Mat& homography, const Eigen::Vector2d& p) {
  const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> h(homography.ptr<double>());
  return (h * p.homogeneous()).hnormalized();
}

/// Drops markers that the others say are elsewhere: a misread number, or a marker that lies about.
cv::Mat keep_consistent(std::vector<FoundMarker>& markers) {
  std::vector<cv::Point2f> board, pixel;
  double side_px = 0;
  for (const FoundMarker& marker : markers) {
    board.insert(board.end(), marker.board_m.begin(), marker.board_m.end());
    pixel.insert(pixel.end(), marker.pixel.begin(), marker.pixel.end());
    side_px = std::max(side_px, cv::norm(marker.pixel[0] - marker.pixel[2]));
  }
  // A lens's distortion bends a board that fills the picture by less than a marker's size.
  const double tolerance_px = std::max(3.0, 0.5 * side_px);
  cv::Mat homography = cv::findHomography(board, pixel, cv::RANSAC, tolerance_px);
  if (homography.empty()) {
    markers.clear();
    return homography;
  }
  std::erase_if(markers, [&](const FoundMarker& marker) {
    for (size_t i = 0; i < 4; ++i) {
      const Eigen::Vector2d expected = apply(homography, {marker.board_m[i].x, marker.board_m[i].y});
      if ((expected - Eigen::Vector2d(marker.pixel[i].x, marker.pixel[i].y)).norm() > tolerance_px) return true;
    }
    return false;
  });
  return homography;
}

/// Standard deviation of the picture's noise: of the second differences along rows, which edges touch rarely.
double noise_of(const cv::Mat& grey) {
  std::vector<double> differences;
  for (int y = 0; y < grey.rows; y += 2)
    for (int x = 1; x + 1 < grey.cols; x += 2)
      differences.push_back(
          std::abs(2.0 * grey.at<uint8_t>(y, x) - grey.at<uint8_t>(y, x - 1) - grey.at<uint8_t>(y, x + 1)));
  constexpr double sigma_of_mad = 1.4826;
  constexpr double quantisation = 0.3;
  return std::max(quantisation, sigma_of_mad * median(std::move(differences)) / std::sqrt(6.0));
}

double sample(const cv::Mat& grey, const Eigen::Vector2d& p) {
  const int x = std::clamp(static_cast<int>(std::floor(p.x())), 0, grey.cols - 2);
  const int y = std::clamp(static_cast<int>(std::floor(p.y())), 0, grey.rows - 2);
  const double fx = std::clamp(p.x() - x, 0.0, 1.0), fy = std::clamp(p.y() - y, 0.0, 1.0);
  const auto at = [&](int i, int j) { return static_cast<double>(grey.at<uint8_t>(j, i)); };
  return (1 - fy) * ((1 - fx) * at(x, y) + fx * at(x + 1, y)) + fy * ((1 - fx) * at(x, y + 1) + fx * at(x + 1, y + 1));
}

/// The blur across an edge between a and b, as the standard deviation of the Gaussian that would make the steepest
/// slope found there; nothing where there is no edge.
std::optional<double> edge_blur(const cv::Mat& grey, const Eigen::Vector2d& a, const Eigen::Vector2d& b, double reach) {
  const Eigen::Vector2d along = b - a;
  if (along.norm() < 4) return std::nullopt;
  const Eigen::Vector2d normal = Eigen::Vector2d(-along.y(), along.x()).normalized();
  constexpr double step = 0.5;
  const int steps = static_cast<int>(reach / step);
  double lowest = 255, highest = 0, steepest = 0;
  for (int i = -steps; i <= steps; ++i) {
    // Averaged over the middle of the edge.
    const auto level = [&](double offset) {
      double sum = 0;
      for (const double t : {0.35, 0.45, 0.55, 0.65}) sum += sample(grey, a + t * along + offset * normal);
      return sum / 4;
    };
    const double here = level(i * step);
    lowest = std::min(lowest, here);
    highest = std::max(highest, here);
    steepest = std::max(steepest, std::abs(level(i * step + 0.5) - level(i * step - 0.5)));
  }
  constexpr double least_contrast = 12;
  if (highest - lowest < least_contrast || steepest <= 0) return std::nullopt;
  return (highest - lowest) / (steepest * std::sqrt(2 * std::numbers::pi));
}

/// The blur of the board's edges in its two directions; the larger, for motion blurs one only.
double blur_of(const cv::Mat& grey, const std::vector<FoundMarker>& markers) {
  std::array<std::vector<double>, 2> blur;
  for (const FoundMarker& marker : markers) {
    for (size_t i = 0; i < 4; ++i) {
      const auto point = [&](size_t k) {
        const cv::Point2f& p = marker.pixel[k % 4];
        return Eigen::Vector2d(p.x, p.y);
      };
      const double side = (point(i + 1) - point(i + 2)).norm();
      if (const auto found = edge_blur(grey, point(i), point(i + 1), std::max(3.0, 0.15 * side)))
        blur[i % 2].push_back(*found);
    }
  }
  return std::max(median(blur[0]), median(blur[1]));
}

/// Says why a picture that shows something like markers, but none that can be read, is of no use.
void explain_unread(const cv::Mat& grey, const std::vector<std::vector<cv::Point2f>>& squares, double most_blur_px,
                    BoardView& view) {
  constexpr size_t fewest_squares = 8;
  std::vector<FoundMarker> candidates;
  for (const auto& square : squares) {
    if (square.size() != 4) continue;
    FoundMarker candidate;
    std::copy_n(square.begin(), 4, candidate.pixel.begin());
    candidates.push_back(candidate);
  }
  if (candidates.size() < fewest_squares) {
    view.message = view.camera + ": does not see the front of the board";
    return;
  }
  view.blur_px = blur_of(grey, candidates);
  // Markers become unreadable well before the limit where their cells are small.
  view.blurred = view.blur_px > 0.6 * most_blur_px;
  view.message =
      view.blurred
          ? view.camera + ": the picture of the board is blurred; hold the board still, and check the focus"
          : view.camera + ": sees squares but cannot read their markers; is it this board, near enough, and well lit?";
}

/// One saddle point: refined where it converges near its prediction.
bool refine_saddle(const cv::Mat& grey, double square_px, double noise, TargetCorner& corner) {
  // The margin between a marker and its square is at least an eighth of it in the usual boards.
  const int half = std::clamp(static_cast<int>(std::lround(0.12 * square_px)), 2, 7);
  const Eigen::Vector2d predicted = corner.pixel;
  if (predicted.x() < half + 2 || predicted.y() < half + 2 || predicted.x() > grey.cols - half - 3 ||
      predicted.y() > grey.rows - half - 3)
    return false;
  std::vector<cv::Point2f> point{cv::Point2f(static_cast<float>(predicted.x()), static_cast<float>(predicted.y()))};
  cv::cornerSubPix(grey, point, {half, half}, {-1, -1}, {cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 50, 1e-3});
  corner.pixel = {point[0].x, point[0].y};
  if ((corner.pixel - predicted).norm() > std::max(1.5, 0.08 * square_px)) return false;

  Eigen::Matrix2d information = Eigen::Matrix2d::Zero();
  const int cx = static_cast<int>(std::lround(corner.pixel.x())), cy = static_cast<int>(std::lround(corner.pixel.y()));
  if (cx < half + 1 || cy < half + 1 || cx > grey.cols - half - 2 || cy > grey.rows - half - 2) return false;
  for (int y = cy - half; y <= cy + half; ++y)
    for (int x = cx - half; x <= cx + half; ++x) {
      const Eigen::Vector2d gradient(0.5 * (grey.at<uint8_t>(y, x + 1) - grey.at<uint8_t>(y, x - 1)),
                                     0.5 * (grey.at<uint8_t>(y + 1, x) - grey.at<uint8_t>(y - 1, x)));
      information += gradient * gradient.transpose();
    }
  const double determinant = information.determinant();
  // Both directions need an edge.
  if (determinant < 0.01 * information.trace() * information.trace()) return false;
  constexpr double model_error_px = 0.03;  // a window of pixels is no ideal saddle
  corner.covariance =
      noise * noise * information.inverse() + model_error_px * model_error_px * Eigen::Matrix2d::Identity();
  return true;
}

/// Drops corners that lie off the homography of their neighbours.
void drop_strays(std::vector<TargetCorner>& corners, const std::vector<Eigen::Vector3d>& on_board, int columns,
                 double square_px) {
  std::vector<TargetCorner> kept;
  for (const TargetCorner& corner : corners) {
    std::vector<cv::Point2f> board, pixel;
    for (const TargetCorner& other : corners) {
      const int dx = std::abs(other.id % columns - corner.id % columns);
      const int dy = std::abs(other.id / columns - corner.id / columns);
      if (other.id == corner.id || dx > 2 || dy > 2) continue;
      const Eigen::Vector3d& p = on_board[static_cast<size_t>(other.id)];
      board.emplace_back(static_cast<float>(p.x()), static_cast<float>(p.y()));
      pixel.emplace_back(static_cast<float>(other.pixel.x()), static_cast<float>(other.pixel.y()));
    }
    constexpr size_t enough = 6;
    if (board.size() >= enough) {
      const cv::Mat homography = cv::findHomography(board, pixel, cv::LMEDS);
      if (!homography.empty()) {
        const Eigen::Vector3d& p = on_board[static_cast<size_t>(corner.id)];
        const double off = (apply(homography, p.head<2>()) - corner.pixel).norm();
        if (off > std::max(0.5, 0.03 * square_px)) continue;
      }
    }
    kept.push_back(corner);
  }
  corners = std::move(kept);
}

/// The part of the picture that the whole board covers, for the homography H.
void keep_crop(const cv::Mat& grey, const BoardPattern& pattern, const cv::Mat& homography, BoardView& view) {
  constexpr double margin_px = 10;
  Eigen::AlignedBox2d box;
  for (const double x : {0.0, pattern.width_m()})
    for (const double y : {0.0, pattern.height_m()}) box.extend(apply(homography, {x, y}));
  const cv::Rect whole(0, 0, grey.cols, grey.rows);
  const auto low = [](double v) { return static_cast<int>(std::floor(std::clamp(v - margin_px, -1e6, 1e6))); };
  const auto high = [](double v) { return static_cast<int>(std::ceil(std::clamp(v + margin_px, -1e6, 1e6))); };
  const cv::Rect part =
      cv::Rect(cv::Point(low(box.min().x()), low(box.min().y())), cv::Point(high(box.max().x()), high(box.max().y()))) &
      whole;
  view.crop = Image(part.width, part.height, 1);
  view.crop_origin = {part.x, part.y};
  for (int y = 0; y < part.height; ++y)
    std::copy_n(grey.ptr<uint8_t>(part.y + y) + part.x, part.width, view.crop.pixel(0, y));
}

BoardView find(const std::string& camera, int pose, const Image& image, const CalibrationBoard& board,
               const BoardDetectionOptions& options) {
  BoardView view;
  view.camera = camera;
  view.pose = pose;
  const cv::Mat grey = grey_of(image);
  const BoardPattern pattern(board);
  MarkerSearch search = find_markers(grey, pattern);
  std::vector<FoundMarker>& markers = search.markers;
  cv::Mat homography;
  if (!markers.empty()) homography = keep_consistent(markers);
  view.markers = static_cast<int>(markers.size());
  if (markers.empty()) {
    explain_unread(grey, search.unread, options.most_blur_px, view);
    return view;
  }
  view.blur_px = blur_of(grey, markers);
  if (view.blur_px > options.most_blur_px) {
    view.blurred = true;
    view.message = camera + ": the picture of the board is blurred; hold the board still, and check the focus";
    return view;
  }

  const double noise = noise_of(grey);
  const auto on_board = board_corners(board);
  double largest_square_px = 0;
  for (size_t id = 0; id < on_board.size(); ++id) {
    const Eigen::Vector2d p = on_board[id].head<2>();
    // The markers in the white squares that meet in this corner.
    std::vector<const FoundMarker*> beside;
    for (const FoundMarker& marker : markers) {
      const BoardPattern::Marker& printed = pattern.markers()[static_cast<size_t>(marker.id)];
      const Eigen::Vector2d centre = printed.corner + Eigen::Vector2d::Constant(board.marker_m / 2);
      if ((centre - p).cwiseAbs().maxCoeff() < board.square_m) beside.push_back(&marker);
    }
    if (beside.empty()) continue;
    const cv::Mat local = homography_of(beside);
    if (local.empty()) continue;
    TargetCorner corner;
    corner.id = static_cast<int>(id);
    corner.pixel = apply(local, p);
    // The shorter of the square's sides there: a window must not reach into the markers.
    const double square_px = std::min((apply(local, p + Eigen::Vector2d(board.square_m / 2, 0)) -
                                       apply(local, p - Eigen::Vector2d(board.square_m / 2, 0)))
                                          .norm(),
                                      (apply(local, p + Eigen::Vector2d(0, board.square_m / 2)) -
                                       apply(local, p - Eigen::Vector2d(0, board.square_m / 2)))
                                          .norm());
    largest_square_px = std::max(largest_square_px, square_px);
    if (refine_saddle(grey, square_px, noise, corner)) view.corners.push_back(corner);
  }
  drop_strays(view.corners, on_board, board.squares_x - 1, largest_square_px);
  if (view.corners.size() < static_cast<size_t>(options.fewest_corners)) {
    view.message = camera + ": sees only " + std::to_string(view.corners.size()) +
                   " corners of the board; turn it more towards the camera, or bring it nearer";
    view.corners.clear();
    return view;
  }
  keep_crop(grey, pattern, homography, view);
  return view;
}

}  // namespace

Result<BoardView> find_board(const std::string& camera, int pose, const Image& image, const CalibrationBoard& board,
                             const BoardDetectionOptions& options) {
  if (const auto valid = check(board); !valid) return valid.error();
  constexpr int smallest_side = 32;
  if (image.width < smallest_side || image.height < smallest_side)
    return Error{ErrorCode::invalid_argument, camera + ": a picture of " + std::to_string(image.width) + " × " +
                                                  std::to_string(image.height) + " is too small to find a board in"};
  try {
    return find(camera, pose, image, board, options);
  } catch (const cv::Exception& fault) {
    return Error{ErrorCode::internal, camera + ": OpenCV: " + fault.what()};
  }
}

Result<BoardView> projector_view(const BoardView& camera, const FloatImage& position, const FloatImage& sigma,
                                 const std::string& projector) {
  if (position.channels != 2 || sigma.channels != 1 || position.width != sigma.width ||
      position.height != sigma.height || position.empty())
    return Error{
        ErrorCode::invalid_argument,
        camera.camera + ": projector positions need two channels, their deviations one, and both the same size"};
  // Around a corner the projector's coordinates are a smooth function of the camera's; a plane is enough for a window
  // of a few pixels, and weighs down single wrong ones.
  constexpr int half = 4;
  constexpr int fewest_pixels = 24;
  constexpr double most_residual_px = 1.0;
  BoardView view;
  view.camera = projector;
  view.pose = camera.pose;
  for (const TargetCorner& corner : camera.corners) {
    const int cx = static_cast<int>(std::lround(corner.pixel.x()));
    const int cy = static_cast<int>(std::lround(corner.pixel.y()));
    struct Sample {
      Eigen::Vector3d basis;
      Eigen::Vector2d value;
      double weight;
    };
    std::vector<Sample> samples;
    for (int y = cy - half; y <= cy + half; ++y)
      for (int x = cx - half; x <= cx + half; ++x) {
        if (!position.contains(x, y)) continue;
        const Eigen::Vector2d value(position.at(x, y, 0), position.at(x, y, 1));
        const double deviation = sigma.at(x, y);
        if (!value.allFinite() || !(deviation > 0) || !std::isfinite(deviation)) continue;
        samples.push_back({{1.0, x - corner.pixel.x(), y - corner.pixel.y()}, value, 1 / (deviation * deviation)});
      }
    Eigen::Vector2d centre;
    Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();
    Eigen::Matrix2d gradient;
    bool fits = true;
    for (int axis = 0; axis < 2 && fits; ++axis) {
      Eigen::Vector3d fit = Eigen::Vector3d::Zero();
      Eigen::Matrix3d inverse;
      double residual = 0;
      size_t used = 0;
      for (int pass = 0; pass < 3 && fits; ++pass) {
        Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
        Eigen::Vector3d right = Eigen::Vector3d::Zero();
        used = 0;
        for (const Sample& s : samples) {
          if (pass > 0 && std::abs(s.basis.dot(fit) - s.value[axis]) > most_residual_px) continue;
          normal += s.weight * s.basis * s.basis.transpose();
          right += s.weight * s.value[axis] * s.basis;
          ++used;
        }
        fits = used >= fewest_pixels && normal.determinant() > 0;
        if (!fits) break;
        inverse = normal.inverse();
        fit = inverse * right;
      }
      if (!fits) break;
      for (const Sample& s : samples) {
        const double off = s.basis.dot(fit) - s.value[axis];
        if (std::abs(off) <= most_residual_px) residual += s.weight * off * off;
      }
      centre[axis] = fit[0];
      gradient.row(axis) = fit.tail<2>().transpose();
      covariance(axis, axis) = inverse(0, 0) * std::max(1.0, residual / static_cast<double>(used - 3));
    }
    if (!fits) continue;
    // The corner's own uncertainty goes along.
    TargetCorner lit;
    lit.id = corner.id;
    lit.pixel = centre;
    lit.covariance = covariance + gradient * corner.covariance * gradient.transpose();
    view.corners.push_back(lit);
  }
  return view;
}

}  // namespace booth
