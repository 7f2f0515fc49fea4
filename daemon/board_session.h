#pragma once

#include <filesystem>
#include <string>
#include <utility>
#include <vector>

namespace booth {

/// A calibration that is being made, shot by shot, in a folder:
///
///     shots/NNN/         a recording with one board shot, and where the projector lit the board its patterns "board-0"
///     views/NNN.json     what was found in it, so that nothing is looked for twice
///     pictures/ID.png    the picture of each camera of the latest shot, with all that this camera has seen so far
///     look.json          how it stands
///     solution/          rig.json, report.html and calibration.json, once it is solved
class BoardSession {
 public:
  explicit BoardSession(std::filesystem::path folder) : folder_(std::move(folder)) {}

  std::filesystem::path shots_folder() const { return folder_ / "shots"; }
  std::filesystem::path solution() const { return folder_ / "solution"; }
  std::filesystem::path look_file() const { return folder_ / "look.json"; }
  std::filesystem::path picture(const std::string& camera) const { return folder_ / "pictures" / (camera + ".png"); }
  std::filesystem::path views_file(const std::string& shot) const { return folder_ / "views" / (shot + ".json"); }
  const std::filesystem::path& folder() const { return folder_; }

  /// The names of its shots, the oldest first.
  std::vector<std::string> shots() const;

 private:
  std::filesystem::path folder_;
};

}  // namespace booth
