#pragma once

#include <filesystem>
#include <vector>

#include "pipeline/types/image.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"

namespace booth::synthetic {

/// A small board, cheap to render.
CalibrationBoard small_board();

/// Four body cameras "b0" … "b3" beside each other before the subject's place, which look down on it a little.
Rig arc_rig();

/// Places of the board about the subject's place, in front of all cameras, tilted differently.
std::vector<Eigen::Isometry3d> tilted_places(const CalibrationBoard& board, int count);
/// The same, but all in one plane.
std::vector<Eigen::Isometry3d> coplanar_places(const CalibrationBoard& board, int count);
/// Face up on the floor at the origin of the world, its lower edge towards +Z.
Eigen::Isometry3d place_on_floor(const CalibrationBoard& board);

/// A photograph of the board before a grey wall: the pattern averaged over each pixel, then blurred, with noise.
Image photograph_board(const CalibratedView& camera, const CalibrationBoard& board,
                       const Eigen::Isometry3d& world_from_board, double blur_px, uint32_t seed);

struct BoardRecordingOptions {
  Rig rig;
  CalibrationBoard board;                 ///< as it is
  CalibrationBoard told;                  ///< as the recording says that it is
  std::vector<Eigen::Isometry3d> places;  ///< of the board, one an index of the shot
  std::vector<std::string> blind;         ///< cameras that see nothing but the wall
  double blur_px = 0.5;
};

/// A recording with a background, a body and a board shot of these places, PARENT/NAME; the first two show grey walls.
/// @return its folder
std::filesystem::path write_board_recording(const std::filesystem::path& parent, const std::string& name,
                                            const BoardRecordingOptions& options);

}  // namespace booth::synthetic
