#include "daemon/face_model_loader.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <fstream>
#include <span>
#include <utility>

#include "pipeline/face/landmark_predictor.h"
#include "pipeline/face/neutral_head.h"

namespace booth {
namespace {

/// A file's bytes, mapped as long as it lives; without a copy of 100 MB.
class MappedFile {
 public:
  /// Maps nothing where the file cannot be opened, or is empty or no file.
  explicit MappedFile(const std::filesystem::path& path) {
    const int fd = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
    if (fd < 0) return;
    struct stat status {};
    if (::fstat(fd, &status) == 0 && S_ISREG(status.st_mode) && status.st_size > 0) {
      const auto size = static_cast<size_t>(status.st_size);
      void* const begin = ::mmap(nullptr, size, PROT_READ, MAP_PRIVATE | MAP_POPULATE, fd, 0);
      if (begin != MAP_FAILED) bytes_ = {static_cast<const uint8_t*>(begin), size};
    }
    ::close(fd);
  }
  ~MappedFile() {
    if (!bytes_.empty()) ::munmap(const_cast<uint8_t*>(bytes_.data()), bytes_.size());
  }
  MappedFile(const MappedFile&) = delete;
  MappedFile& operator=(const MappedFile&) = delete;

  std::span<const uint8_t> bytes() const { return bytes_; }

 private:
  std::span<const uint8_t> bytes_;
};

Result<FaceModel> load(const std::filesystem::path& landmark_model) {
  const MappedFile file(landmark_model);
  if (file.bytes().empty())
    return Error{ErrorCode::not_found, landmark_model.string() + ": the model of landmarks cannot be read"};
  auto landmarks = read_dlib_landmarks(file.bytes());
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
