#pragma once

#include <filesystem>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>

#include "pipeline/reconstruct.h"

namespace booth {

/// Loads what the passive face needs, once. Safe for several threads.
class FaceModelLoader {
 public:
  /// @param landmark_model  a file as read_dlib_landmarks wants it
  explicit FaceModelLoader(std::filesystem::path landmark_model);

  /// Begins to load on a thread of its own, so that who needs the model later waits less or not at all.
  void start();

  /// The model, loaded by the first call where start() was not called; waits until it is there.
  /// @error not_found, invalid_file  naming the file
  Result<FaceModel> get();

 private:
  const std::filesystem::path landmark_model_;
  std::mutex mutex_;  ///< held while loading
  std::optional<Result<FaceModel>> loaded_;
  std::jthread loading_;
};

/// Loads what looks for the face that was scanned: some hundredths of a second.
///
/// @param cascade  a file as read_face_cascade wants it
/// @error not_found, invalid_file  naming the file
Result<std::shared_ptr<const FaceDetector>> load_face_detector(const std::filesystem::path& cascade);

}  // namespace booth
