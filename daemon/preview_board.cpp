#include "daemon/preview_board.h"

#include <pthread.h>
#include <spdlog/spdlog.h>

#include <algorithm>
#include <exception>
#include <utility>

#include "daemon/preview_image.h"
#include "pipeline/image/codec.h"

namespace booth {
namespace {

constexpr Timestamp oldest = milliseconds(150);
constexpr int jpeg_quality = 80;
/// Frames do not come exactly when they are expected: one that is a little early is not left out.
constexpr double early_share = 0.8;

}  // namespace

PreviewBoard::PreviewBoard(CameraSupervisor& cameras, Metrics& metrics, const Clock& clock, Wakeup& ready)
    : cameras_(cameras), metrics_(metrics), clock_(clock), ready_(ready) {
  thread_ = std::jthread([this](const std::stop_token& stop) { run(stop); });
  pthread_setname_np(thread_.native_handle(), "preview");
}

void PreviewBoard::start(const std::string& camera, const PreviewSettings& settings) {
  {
    const std::lock_guard lock(mutex_);
    shows_[camera] = Show{settings, {}, 0};
  }
  cameras_.camera(camera).set_preview([this, camera](const Frame& frame) { put(camera, frame); });
}

void PreviewBoard::stop(const std::string& camera) {
  cameras_.camera(camera).set_preview({});
  const std::lock_guard lock(mutex_);
  shows_.erase(camera);
  pictures_.erase(camera);
}

void PreviewBoard::put(const std::string& camera, const Frame& frame) {
  {
    const std::lock_guard lock(mutex_);
    const auto show = shows_.find(camera);
    if (show == shows_.end() || clock_.now() < show->second.next) return;
    show->second.newest = frame;
    show->second.next = clock_.now() + static_cast<Timestamp>(early_share * static_cast<double>(seconds(1)) /
                                                              show->second.settings.fps);
  }
  changed_.notify_one();
}

std::vector<PreviewPicture> PreviewBoard::take() {
  const std::lock_guard lock(mutex_);
  std::vector<PreviewPicture> pictures;
  for (auto& [camera, picture] : pictures_) pictures.push_back(std::move(picture));
  pictures_.clear();
  std::sort(pictures.begin(), pictures.end(), [](const auto& a, const auto& b) { return a.sequence < b.sequence; });
  return pictures;
}

void PreviewBoard::run(const std::stop_token& stop) {
  std::unique_lock lock(mutex_);
  const auto next = [this] {
    return std::find_if(shows_.begin(), shows_.end(), [](const auto& show) { return show.second.newest.has_value(); });
  };
  while (changed_.wait(lock, stop, [&] { return next() != shows_.end(); })) {
    const auto show = next();
    const std::string camera = show->first;
    const PreviewSettings settings = show->second.settings;
    const Frame frame = *std::exchange(show->second.newest, std::nullopt);
    lock.unlock();
    std::optional<PreviewPicture> picture = make(camera, frame, settings);
    lock.lock();
    if (!picture || !shows_.contains(camera)) continue;
    picture->sequence = ++sequence_;
    pictures_[camera] = std::move(*picture);
    ready_.signal();
  }
}

std::optional<PreviewPicture> PreviewBoard::make(const std::string& camera, const Frame& frame,
                                                 const PreviewSettings& settings) {
  try {
    const Image image =
        frame.mosaic ? make_preview(bin_mosaic(*frame.pixels, *frame.mosaic), settings.rotation_deg, settings.max_width)
                     : make_preview(*frame.pixels, settings.rotation_deg, settings.max_width);
    PreviewPicture picture{.camera = camera,
                           .time = std::chrono::system_clock::now(),
                           .timestamp_ns = frame.timestamp_ns,
                           .width = image.width,
                           .height = image.height,
                           .jpeg = encode_jpeg(image, jpeg_quality)};
    if (clock_.now() - frame.timestamp_ns <= oldest) {
      metrics_.add("previews");
      return picture;
    }
    metrics_.add("previews_too_old");
  } catch (const std::exception& fault) {
    spdlog::error("camera {}: its preview failed: {}", camera, fault.what());
  }
  return std::nullopt;
}

}  // namespace booth
