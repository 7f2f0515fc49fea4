#pragma once

#include <chrono>
#include <condition_variable>
#include <filesystem>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <stop_token>
#include <string>
#include <vector>

#include "daemon/board_session.h"
#include "daemon/serial_executor.h"
#include "daemon/task_board.h"
#include "pipeline/types/frame.h"
#include "pipeline/types/result.h"
#include "pipeline/types/rig.h"
#include "pipeline/types/shot.h"
#include "replay/recording_writer.h"

namespace booth {

struct CalibrationDeskOptions {
  std::filesystem::path folder;   ///< holds rig.json, those before it, and the calibration under way
  std::filesystem::path command;  ///< the program that looks at shots and solves: see booth-calibrate
  CalibrationBoard board;
  SpoolOptions images;  ///< how shots of the board store them
  std::chrono::seconds timeout{3600};
};

/// What the booth is made of, as its configuration says, for cameras that have no calibration yet.
struct BoothDevice {
  std::string id;
  CameraRole role = CameraRole::body;
  int mount_rotation_deg = 0;
};

/// The pictures of one place of the board.
struct BoardPictures {
  std::vector<Frame> frames;               ///< of the cameras, at most one each
  std::vector<Frame> patterns;             ///< of the projected patterns, their index the pattern's; may be empty
  std::optional<GrayCodePattern> pattern;  ///< with patterns
  bool floor = false;                      ///< the board lies on the floor
};

/// A rig that was in force, or is.
struct RigInForce {
  std::shared_ptr<const Rig> rig;  ///< null: none
  std::string created;             ///< ISO 8601, UTC; may be empty
};

/// One that another has replaced.
struct ReplacedRig {
  std::string name;     ///< of its file
  std::string created;  ///< when it came into force, ISO 8601, UTC
};

struct CalibrationSessionStatus {
  int shots = 0;
  bool enough = false;
  std::string verdict;  ///< of the solution that waits to be applied; empty: there is none
};

/// Where a calibration is made: shots of the board, their solution, and the change of rig.json. All of it is on the
/// disk at any instant, so that a calibration goes on after a crash, and rig.json is always whole: the rig before or
/// the one after. Looking at pictures and solving happen in processes of their own. Any thread may call; what waits
/// for the disk or for a process says so.
class CalibrationDesk {
 public:
  /// @param in_force  the rig that is in force now
  /// @param put       puts a rig in force; called from the thread that applies or restores
  /// @error io  the folder cannot be used
  static Result<std::unique_ptr<CalibrationDesk>> open(CalibrationDeskOptions options, TaskBoard& tasks,
                                                       std::function<RigInForce()> in_force,
                                                       std::function<void(const RigInForce&)> put);
  ~CalibrationDesk();

  /// Whether a shot may be taken now. @error busy  the calibration is being solved; invalid_state  too many shots
  Result<void> check_free() const;
  /// Adds a shot and looks at it, waiting for both. A shot that cannot be looked at is not kept.
  ///
  /// @param devices  every camera of the booth
  /// @param projector  its id; empty: the booth has none
  /// @param missing  cameras that delivered no picture
  /// @param alive    called now and then meanwhile
  /// @return an object, as JSON text: what look_at_boards writes, and `missing`
  /// @error busy, disk_full, io, cancelled; internal  the process died
  Result<std::string> add(const BoardPictures& pictures, const std::vector<BoothDevice>& devices,
                          const std::string& projector, const std::vector<std::string>& missing,
                          const std::stop_token& stop, const std::function<void()>& alive);

  /// Begins to solve, as a task. What was solved before and not applied is dropped.
  /// @param keep_unseen  cameras that never saw the board keep the calibration that they have
  /// @return its id; it ends with an object of `verdict`, `reason`, `rms_px`, `cameras`, `projector`, `messages`,
  ///         `report` (the page's path), `rig` (the solved rig.json's)
  /// @error busy; invalid_state  there are no shots
  Result<std::string> solve(bool keep_unseen);

  /// Puts the solved rig in force and keeps the one before beside it. Waits for the disk.
  /// @param force  also one whose verdict is bad
  /// @error busy; invalid_state  nothing is solved, or its verdict is bad; disk_full, io  nothing has changed
  Result<void> apply(bool force);
  /// Drops what was solved; with `shots` these too, and a solution under way. Waits for the disk. @error busy, io
  Result<void> discard(bool shots);
  /// Puts a rig in force that was so before; the one in force is kept in its place. Waits for the disk.
  /// @param name  of `replaced()`; nothing: the one replaced last
  /// @error busy; not_found  there is none, or none of that name; invalid_file, disk_full, io
  Result<void> restore(const std::optional<std::string>& name);

  /// Nothing: no calibration is under way.
  std::optional<CalibrationSessionStatus> session() const;
  /// Those that were replaced, the latest first. Waits for the disk.
  std::vector<ReplacedRig> replaced() const;
  /// How things stand, as JSON text: `look` and `solution` as their tasks ended, or null, and `replaced` [{`name`,
  /// `created`}]. Waits for the disk.
  std::string report() const;

 private:
  /// What is solved and not applied.
  struct Solution {
    std::string verdict, reason;
    std::string json;  ///< as the task ended
  };
  CalibrationDesk(CalibrationDeskOptions options, TaskBoard& tasks, std::function<RigInForce()> in_force,
                  std::function<void(const RigInForce&)> put);
  Result<void> take_up();
  Result<void> run(const std::vector<std::string>& arguments, const std::stop_token& stop,
                   const std::function<void()>& alive, const std::function<void(double)>& progress) const;
  Result<std::string> store(const BoardPictures& pictures, const std::vector<BoothDevice>& devices,
                            const std::string& projector) const;
  Result<Solution> carry_out(const std::string& task, bool keep_unseen, const std::stop_token& stop);
  Result<Solution> read_solution() const;
  Result<void> drop_session();
  Result<void> replace(const Rig& rig, const std::string& created);
  std::filesystem::path rig_file() const { return options_.folder / "rig.json"; }
  void count_shots();

  /// What excludes the rest while it lasts.
  enum class Occupation { none, looking, solving, changing };
  Result<void> occupy(Occupation occupation);
  void release();
  class Occupied;

  const CalibrationDeskOptions options_;
  TaskBoard& tasks_;
  const std::function<RigInForce()> in_force_;
  const std::function<void(const RigInForce&)> put_;
  const BoardSession session_;

  mutable std::mutex mutex_;
  std::condition_variable released_;
  Occupation occupation_ = Occupation::none;  ///< guarded by mutex_
  std::stop_source solving_;                  ///< guarded by mutex_
  int shots_ = 0;                             ///< guarded by mutex_
  bool enough_ = false;                       ///< guarded by mutex_
  std::optional<Solution> solution_;          ///< guarded by mutex_
  std::unique_ptr<SerialExecutor> solver_;
};

}  // namespace booth
