#pragma once

#include "daemon/board_session.h"
#include "pipeline/types/result.h"
#include "pipeline/types/work.h"

namespace booth {

/// Finds the board in the shots that were not looked at yet, draws each camera's coverage and judges whether the shots
/// are enough.
///
/// Writes views, pictures and look.json, an object with `shots` (how many), `floor` (whether one shows the board on the
/// floor), `cameras` [{`id`, `corners`, `markers`, `blur_px`, `blurred`, `message` (these of the latest shot), `views`,
/// `shared_views`, `covered`, `tilt_deg`, `enough`, `wants`, `picture`}], `projector` {`id`, `corners`, `views`} or
/// null, `enough`, `wants` (what to do next, or null) and `warnings` [sentences].
/// @error as read_recording, find_board; not_found  there is no shot; disk_full, io
Result<void> look_at_boards(const BoardSession& session, const Work& work = {});

}  // namespace booth
