#include "daemon/frame_collector.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <utility>

namespace booth {
namespace {

constexpr int most_misses = 2;                  ///< in a row, after which a camera is not waited for
constexpr std::chrono::milliseconds slice{20};  ///< how soon a cancelled capture is noticed

}  // namespace

FrameCollector::FrameCollector(CameraSupervisor& cameras, std::vector<std::string> ids, ShotRole role, int count,
                               Timestamp most_skew, const Clock& clock)
    : cameras_(cameras),
      ids_(std::move(ids)),
      most_skew_(most_skew),
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
    if (auto news = inbox_->pop(slice)) note(std::move(*news));
  for (const std::string& id : silent_) spdlog::warn("camera {}: not armed in time", id);
  gone_.insert(silent_.begin(), silent_.end());
}

void FrameCollector::note(CameraNews news) {
  switch (news.kind) {
    case CameraNews::Kind::armed: silent_.erase(news.camera); break;
    case CameraNews::Kind::fault:
      if (silent_.erase(news.camera) > 0 || news.error.code == ErrorCode::device_lost)
        gone_.insert(news.camera);
      else
        damaged_.insert(news.camera);
      break;
    case CameraNews::Kind::frame: note_frame(news.camera, std::move(*news.frame)); break;
  }
}

void FrameCollector::note_frame(const std::string& camera, Frame frame) {
  const auto trigger = trigger_of(frame);
  const auto counted = static_cast<size_t>(frame.index);
  if (trigger != counted) {
    const std::string what = camera + ": its frame " + std::to_string(counted) +
                             (trigger ? " was exposed at trigger " + std::to_string(*trigger) +
                                            ": the camera missed a trigger, or saw one "
                                            "that was none; check its trigger line"
                                      : " was not exposed at any trigger: check its trigger line");
    remarks_.push_back(what);
    if (!trigger) return cameras_.camera(camera).note_missing(what);
  }
  if (*trigger < latest())
    spdlog::warn("camera {}: a frame came too late", camera);
  else
    frames_[*trigger].try_emplace(camera, std::move(frame));
}

/// Nothing: it answers no trigger.
std::optional<size_t> FrameCollector::trigger_of(const Frame& frame) const {
  const auto confirmed = [&](size_t trigger) {
    return trigger < fired_.size() && std::abs(frame.timestamp_ns - fired_[trigger]) <= most_skew_;
  };
  const auto counted = static_cast<size_t>(frame.index);
  if (confirmed(counted)) return counted;
  for (size_t trigger = 0; trigger < fired_.size(); ++trigger)
    if (confirmed(trigger)) return trigger;
  // Late, but nobody else's: the skew will tell.
  if (counted < fired_.size() && frame.timestamp_ns > fired_[counted]) return counted;
  return std::nullopt;
}

bool FrameCollector::is_reachable(const std::string& id) const {
  const auto misses = misses_.find(id);
  return !gone_.contains(id) && (misses == misses_.end() || misses->second < most_misses);
}

size_t FrameCollector::reachable() const {
  return static_cast<size_t>(
      std::count_if(ids_.begin(), ids_.end(), [this](const std::string& id) { return is_reachable(id); }));
}

CollectedShot FrameCollector::collect(Timestamp when, Timestamp deadline, const std::stop_token& stop) {
  fired_.push_back(when);
  // Of those that are given up too: one that was armed late would take this trigger's frame for the next one's.
  for (const std::string& id : ids_) cameras_.camera(id).note_trigger(static_cast<int>(latest()), when);
  damaged_.clear();
  remarks_.clear();
  frames_.erase(frames_.begin(), frames_.lower_bound(latest()));
  const auto awaited = [&] {
    return std::any_of(ids_.begin(), ids_.end(), [&](const std::string& id) {
      return is_reachable(id) && !damaged_.contains(id) && !frames_[latest()].contains(id);
    });
  };
  while (awaited() && !stop.stop_requested() && clock_.now() < deadline)
    if (auto news = inbox_->pop(slice)) note(std::move(*news));
  return gather(stop);
}

CollectedShot FrameCollector::gather(const std::stop_token& stop) {
  CollectedShot shot;
  shot.set.index = static_cast<int>(latest());
  shot.remarks = std::move(remarks_);
  std::map<std::string, Frame> frames = std::move(frames_[latest()]);
  frames_.erase(latest());
  for (const std::string& id : ids_) {
    if (const auto found = frames.find(id); found != frames.end()) {
      shot.offsets_us[id] = static_cast<double>(found->second.timestamp_ns - fired_.back()) / 1e3;
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
  if (first != shot.set.frames.end()) {
    const Timestamp skew = last->timestamp_ns - first->timestamp_ns;
    shot.skew_us = static_cast<double>(skew) / 1e3;
    if (skew > most_skew_)
      shot.remarks.push_back("the cameras exposed " + std::to_string(skew / milliseconds(1)) + " ms apart, from " +
                             first->camera + " to " + last->camera + "; at most " +
                             std::to_string(most_skew_ / milliseconds(1)) + " ms are allowed (capture.max_skew_ms)");
  }
  return shot;
}

}  // namespace booth
