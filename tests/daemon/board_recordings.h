#pragma once

#include <filesystem>
#include <map>
#include <string>

#include "tests/replay/scratch_folder.h"
#include "tests/synthetic/board_recording.h"

namespace booth::test {

namespace fs = std::filesystem;

inline constexpr int tilted = 6;  ///< places of the board, the one on the floor aside

/// The recordings that the tests play, each rendered once.
class BoardRecordings {
 public:
  static BoardRecordings& get() {
    static BoardRecordings recordings;
    return recordings;
  }
  /// Boards tilted, then one on the floor.
  fs::path good() {
    auto options = usual();
    options.places.push_back(synthetic::place_on_floor(options.board));
    return made("good", options);
  }
  fs::path coplanar() {
    auto options = usual();
    options.places = synthetic::coplanar_places(options.board, 4);
    return made("coplanar", options);
  }
  fs::path blind() {
    auto options = usual();
    options.blind = {"b3"};
    return made("blind", options);
  }
  fs::path blurred() {
    auto options = usual();
    options.places.resize(3);
    // So near that the markers can be read all the same.
    for (Eigen::Isometry3d& place : options.places) place = Eigen::Translation3d(0, 0.4, 0.7) * place;
    options.blur_px = 2.8;
    return made("blurred", options);
  }
  fs::path enlarged() {
    auto options = usual();
    options.told.square_m *= 1.1;
    options.told.marker_m *= 1.1;
    return made("enlarged", options);
  }

 private:
  static synthetic::BoardRecordingOptions usual() {
    synthetic::BoardRecordingOptions options;
    options.rig = synthetic::arc_rig();
    options.board = options.told = synthetic::small_board();
    options.places = synthetic::tilted_places(options.board, tilted);
    return options;
  }
  fs::path made(const std::string& name, const synthetic::BoardRecordingOptions& options) {
    if (!made_.contains(name)) made_[name] = synthetic::write_board_recording(folder_.path(), name, options);
    return made_[name];
  }

  const ScratchFolder folder_;
  std::map<std::string, fs::path> made_;
};

}  // namespace booth::test
