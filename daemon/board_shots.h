#pragma once

#include <string>
#include <vector>

#include "pipeline/calibration/board_view.h"
#include "pipeline/calibration/colour_response.h"
#include "pipeline/types/result.h"
#include "pipeline/types/work.h"
#include "replay/recording.h"

namespace booth {

/// The boards that the cameras see in one shot, a view for each of its pictures.
///
/// @param first_pose  the pose of the shot's index 0; the others count on
/// @param messages    is added a sentence for each picture that cannot be used
/// @param whites      is added what the pictures show of the board's white; null: nobody asks
/// @error as find_board; cancelled
/// @pre shot.board is there
Result<std::vector<BoardView>> find_boards(const Recording& recording, const Shot& shot, int first_pose,
                                           std::vector<std::string>& messages, const Work& work,
                                           std::vector<WhiteSample>* whites = nullptr);

/// What the projector lit of the boards: of each Gray-code shot named "board-N", taken of the board resting as in index
/// N, the projector's view by the camera that decoded most corners.
///
/// @param views       of the cameras, as find_boards gave them for the recording's first board shot
/// @param first_pose  as find_boards had it
/// @param messages    is added a sentence for each camera whose pictures of the patterns cannot be decoded
/// @error as projector_view
/// @pre the recording's rig has a projector
Result<std::vector<BoardView>> projector_views(const Recording& recording, const std::vector<BoardView>& views,
                                               int first_pose, std::vector<std::string>& messages, const Work& work);

}  // namespace booth
