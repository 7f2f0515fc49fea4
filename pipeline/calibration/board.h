#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/result.h"
#include "pipeline/types/shot.h"

namespace booth {

/// The board frame: metres, the printed face in the plane z = 0, seen from before it +x to the right, +y down and +z
/// away from the onlooker; the origin is the outer corner at the top left. OpenCV 4.6's CharucoBoard has the same.
///
/// @return whether the board can be made and found: a ChArUco board of a dictionary that OpenCV has and that holds
///         enough markers, 3 … 100 squares each way, 0 < marker_m < square_m
/// @error invalid_argument  names the field and its value
Result<void> check(const CalibrationBoard& board);

/// The corners between the squares, board frame: (squares_x − 1) × (squares_y − 1) of them, x fastest from the top
/// left. Their index is the corner's id everywhere.
/// @pre check(board) holds
std::vector<Eigen::Vector3d> board_corners(const CalibrationBoard& board);

/// What is printed on a board, as a function of the place.
class BoardPattern {
 public:
  /// @pre check(board) holds
  explicit BoardPattern(const CalibrationBoard& board);

  const CalibrationBoard& board() const { return board_; }
  double width_m() const { return board_.squares_x * board_.square_m; }
  double height_m() const { return board_.squares_y * board_.square_m; }
  /// Whether the paper is white at (x, y), metres in the board frame; beside the board it is.
  bool white(double x, double y) const;

  struct Marker {
    int id = 0;
    Eigen::Vector2d corner;  ///< its top left corner, metres in the board frame
    std::vector<std::vector<bool>>
        white;  ///< cells by row from the top, by column from the left, black border included
  };
  const std::vector<Marker>& markers() const { return markers_; }

  /// Whether a square is black; (0, 0) is at the top left.
  static bool black_square(int x, int y);

 private:
  CalibrationBoard board_;
  std::vector<Marker> markers_;
  std::vector<int> marker_of_square_;  ///< by x + y · squares_x; −1 in black squares
};

/// The board as seen from before it, grey, with a white margin around it.
/// @pre check(board) holds, square_px ≥ 1, margin_px ≥ 0
Image draw_board(const CalibrationBoard& board, int square_px, int margin_px);

}  // namespace booth
