#include "daemon/face_model_loader.h"

#include <fstream>
#include <utility>

#include "pipeline/face/landmark_predictor.h"
#include "pipeline/face/neutral_head.h"

namespace booth {
namespace {

Result<FaceModel> load(const std::filesystem::path& landmark_model) {
  std::ifstream file(landmark_model, std::ios::binary);
  if (!file) return Error{ErrorCode::not_found, landmark_model.string() + ": the model of landmarks cannot be opened"};
  auto landmarks = read_dlib_landmarks(file);
  if (!landmarks) return Error{landmarks.error().code, landmark_model.string() + ": " + landmarks.error().message};
  auto neutral = parse_neutral_head(built_in_neutral_head());
  if (!neutral) return neutral.error();
  return FaceModel{std::move(*landmarks), std::make_shared<const NeutralHead>(std::move(*neutral))};
}

}  // namespace

FaceModelLoader::FaceModelLoader(std::filesystem::path landmark_model) : landmark_model_(std::move(landmark_model)) {}

void FaceModelLoader::start() {
  if (!loading_.joinable()) loading_ = std::jthread([this] { static_cast<void>(get()); });
}

Result<FaceModel> FaceModelLoader::get() {
  const std::lock_guard lock(mutex_);
  if (!loaded_) loaded_ = load(landmark_model_);
  return *loaded_;
}

Result<std::shared_ptr<const FaceDetector>> load_face_detector(const std::filesystem::path& cascade) {
  std::ifstream file(cascade, std::ios::binary);
  if (!file) return Error{ErrorCode::not_found, cascade.string() + ": the cascade that finds faces cannot be opened"};
  auto detector = read_face_cascade(file);
  if (!detector) return Error{detector.error().code, cascade.string() + ": " + detector.error().message};
  return std::shared_ptr<const FaceDetector>(std::move(*detector));
}

}  // namespace booth
