#include "daemon/frame_collector.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <chrono>
#include <utility>

namespace booth {
namespace {

constexpr int most_misses = 2;                  ///< in a row, after which a camera is not waited for
constexpr std::chrono::milliseconds slice{20};  ///< how soon a cancelled capture is noticed

}  // namespace

FrameCollector::FrameCollector(CameraSupervisor& cameras, std::vector<std::string> ids, ShotRole role, int count,
                               const Clock& clock)
    : cameras_(cameras),
      ids_(std::move(ids)),
      clock_(clock),
      // Room for each frame and a fault for it, and for the answer to the order.
      inbox_(std::make_shared<CameraInbox>(ids_.size() * (2 * static_cast<size_t>(count) + 2))),
      silent_(ids_.begin(), ids_.end()) {
  for (const std::string& id : ids_) cameras_.camera(id).arm({.role = role}, count, inbox_);
}

FrameCollector::~FrameCollector() {
  for (const std::string& id : ids_) cameras_.camera(id).disarm();
}

void FrameCollector::wait_armed(Timestamp deadline, const std::stop_token& stop) {
  while (!silent_.empty() && !stop.stop_requested() && clock_.now() < deadline)
    if (auto news = inbox_->pop(slice)) note(std::move(*news), 0);
  for (const std::string& id : silent_) spdlog::warn("camera {}: not armed in time", id);
  gone_.insert(silent_.begin(), silent_.end());
}

void FrameCollector::note(CameraNews news, int trigger) {
  switch (news.kind) {
    case CameraNews::Kind::armed: silent_.erase(news.camera); break;
    case CameraNews::Kind::fault:
      if (silent_.erase(news.camera) > 0 || news.error.code == ErrorCode::device_lost)
        gone_.insert(news.camera);
      else
        damaged_.insert(news.camera);
      break;
    case CameraNews::Kind::frame:
      if (news.frame->index < trigger)
        spdlog::warn("camera {}: a frame came too late", news.camera);
      else
        frames_[news.frame->index].try_emplace(news.camera, std::move(*news.frame));
      break;
  }
}

bool FrameCollector::is_reachable(const std::string& id) const {
  const auto misses = misses_.find(id);
  return !gone_.contains(id) && (misses == misses_.end() || misses->second < most_misses);
}

size_t FrameCollector::reachable() const {
  return static_cast<size_t>(
      std::count_if(ids_.begin(), ids_.end(), [this](const std::string& id) { return is_reachable(id); }));
}

CollectedShot FrameCollector::collect(int trigger, Timestamp deadline, const std::stop_token& stop) {
  damaged_.clear();
  frames_.erase(frames_.begin(), frames_.lower_bound(trigger));
  const auto awaited = [&] {
    return std::any_of(ids_.begin(), ids_.end(), [&](const std::string& id) {
      return is_reachable(id) && !damaged_.contains(id) && !frames_[trigger].contains(id);
    });
  };
  while (awaited() && !stop.stop_requested() && clock_.now() < deadline)
    if (auto news = inbox_->pop(slice)) note(std::move(*news), trigger);

  CollectedShot shot;
  shot.set.index = trigger;
  std::map<std::string, Frame> frames = std::move(frames_[trigger]);
  frames_.erase(trigger);
  for (const std::string& id : ids_) {
    if (const auto found = frames.find(id); found != frames.end()) {
      shot.set.frames.push_back(std::move(found->second));
      misses_[id] = 0;
      continue;
    }
    ++misses_[id];
    shot.missing.push_back(id);
    // A damaged frame was counted when it came.
    if (!damaged_.contains(id) && !stop.stop_requested())
      cameras_.camera(id).note_missing("no frame came for a trigger within the time allowed");
  }
  const auto [first, last] =
      std::minmax_element(shot.set.frames.begin(), shot.set.frames.end(),
                          [](const Frame& a, const Frame& b) { return a.timestamp_ns < b.timestamp_ns; });
  if (first != shot.set.frames.end())
    shot.skew_us = static_cast<double>(last->timestamp_ns - first->timestamp_ns) / 1e3;
  return shot;
}

}  // namespace booth
