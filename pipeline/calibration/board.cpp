#include "pipeline/calibration/board.h"

#include <algorithm>
#include <cmath>
#include <opencv2/aruco/charuco.hpp>
#include <optional>
#include <string>

#include "pipeline/calibration/marker_dictionary.h"

namespace booth {
namespace {

constexpr int fewest_squares = 3;
constexpr int most_squares = 100;
/// OpenCV's detector expects a border of one cell around a marker's bits.
constexpr int border_cells = 1;

Error refused(const std::string& field, const std::string& value, const std::string& expected) {
  return {ErrorCode::invalid_argument, "board." + field + ": " + value + ", expected " + expected};
}

}  // namespace

Result<void> check(const CalibrationBoard& board) {
  if (board.type != "charuco") return refused("type", "\"" + board.type + "\"", "\"charuco\"");
  for (const auto& [field, squares] : {std::pair{"squares_x", board.squares_x}, {"squares_y", board.squares_y}})
    if (squares < fewest_squares || squares > most_squares)
      return refused(field, std::to_string(squares),
                     std::to_string(fewest_squares) + " … " + std::to_string(most_squares));
  if (!(board.square_m > 0) || !std::isfinite(board.square_m))
    return refused("square_m", std::to_string(board.square_m), "a length in metres");
  if (!(board.marker_m > 0 && board.marker_m < board.square_m))
    return refused("marker_m", std::to_string(board.marker_m), "more than 0 and less than square_m");
  const auto dictionary = find_dictionary(board.dictionary);
  if (!dictionary) return refused("dictionary", "\"" + board.dictionary + "\"", "one of OpenCV's, as DICT_5X5_250");
  const int markers = board.squares_x * board.squares_y / 2;
  const int available = cv::aruco::getPredefinedDictionary(*dictionary)->bytesList.rows;
  if (markers > available)
    return refused("dictionary", board.dictionary,
                   "one with at least " + std::to_string(markers) + " markers; it has " + std::to_string(available));
  return {};
}

std::vector<Eigen::Vector3d> board_corners(const CalibrationBoard& board) {
  std::vector<Eigen::Vector3d> corners;
  for (int y = 1; y < board.squares_y; ++y)
    for (int x = 1; x < board.squares_x; ++x) corners.emplace_back(x * board.square_m, y * board.square_m, 0.0);
  return corners;
}

BoardPattern::BoardPattern(const CalibrationBoard& board)
    : board_(board), marker_of_square_(static_cast<size_t>(board.squares_x * board.squares_y), -1) {
  const auto dictionary = cv::aruco::getPredefinedDictionary(find_dictionary(board.dictionary).value());
  const int cells = dictionary->markerSize + 2 * border_cells;
  const double margin_m = (board.square_m - board.marker_m) / 2;
  // OpenCV 4.6 numbers the markers by rows from the top.
  for (int y = 0; y < board.squares_y; ++y) {
    for (int x = 0; x < board.squares_x; ++x) {
      if (black_square(x, y)) continue;
      Marker marker;
      marker.id = static_cast<int>(markers_.size());
      marker.corner = board.square_m * Eigen::Vector2d(x, y) + Eigen::Vector2d::Constant(margin_m);
      cv::Mat bits;
      dictionary->drawMarker(marker.id, cells, bits, border_cells);
      for (int row = 0; row < cells; ++row) {
        std::vector<bool> line;
        for (int column = 0; column < cells; ++column) line.push_back(bits.at<uint8_t>(row, column) > 127);
        marker.white.push_back(std::move(line));
      }
      marker_of_square_[static_cast<size_t>(y * board.squares_x + x)] = marker.id;
      markers_.push_back(std::move(marker));
    }
  }
}

bool BoardPattern::black_square(int x, int y) {
  // OpenCV 4.6's boards begin with a black square at the top left.
  return (x + y) % 2 == 0;
}

bool BoardPattern::white(double x, double y) const {
  const int column = static_cast<int>(std::floor(x / board_.square_m));
  const int row = static_cast<int>(std::floor(y / board_.square_m));
  if (column < 0 || row < 0 || column >= board_.squares_x || row >= board_.squares_y) return true;
  const int number = marker_of_square_[static_cast<size_t>(row * board_.squares_x + column)];
  if (number < 0) return false;
  const Marker& marker = markers_[static_cast<size_t>(number)];
  const Eigen::Vector2d inside = (Eigen::Vector2d(x, y) - marker.corner) / board_.marker_m;
  if (inside.x() < 0 || inside.y() < 0 || inside.x() >= 1 || inside.y() >= 1) return true;
  const size_t cells = marker.white.size();
  const size_t from_top = std::min(static_cast<size_t>(inside.y() * static_cast<double>(cells)), cells - 1);
  const size_t from_left = std::min(static_cast<size_t>(inside.x() * static_cast<double>(cells)), cells - 1);
  return marker.white[from_top][from_left];
}

Image draw_board(const CalibrationBoard& board, int square_px, int margin_px) {
  const BoardPattern pattern(board);
  const int width = board.squares_x * square_px, height = board.squares_y * square_px;
  Image image(width + 2 * margin_px, height + 2 * margin_px, 1, 255);
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      if (!pattern.white((x + 0.5) / square_px * board.square_m, (y + 0.5) / square_px * board.square_m))
        image.at(margin_px + x, margin_px + y) = 0;
  return image;
}

}  // namespace booth
