#include "daemon/recording_source.h"

#include <fcntl.h>
#include <poll.h>

#include <nlohmann/json.hpp>
#include <utility>

#include "pipeline/types/work.h"

namespace booth {
namespace {

constexpr int patience_ms = 50;  ///< how soon a request to stop is heard

}  // namespace

RecordingSource::RecordingSource(std::filesystem::path folder, int news) : folder_(std::move(folder)), news_(news) {
  ::fcntl(news, F_SETFL, ::fcntl(news, F_GETFL) | O_NONBLOCK);
}

Result<Recording> RecordingSource::with(ShotRole role, const std::stop_token& stop) {
  while (!is_complete()) {
    if (!so_far_.empty()) {
      // One that cannot be read may just have moved to its place, which is the next news.
      auto recording = read_recording(so_far_);
      if (recording && recording->find(role) != nullptr) return recording;
    }
    if (const auto heard = wait_for_news(stop); !heard) return heard.error();
  }
  return read_recording(folder_);
}

Result<Recording> RecordingSource::complete(const std::stop_token& stop) {
  while (!is_complete())
    if (const auto heard = wait_for_news(stop); !heard) return heard.error();
  return read_recording(folder_);
}

/// Returns when there is news, but also now and then without.
Result<void> RecordingSource::wait_for_news(const std::stop_token& stop) {
  if (stop.stop_requested()) return Work::cancelled();
  pollfd polled{news_, POLLIN, 0};
  ::poll(&polled, 1, patience_ms);
  bool complete = false;
  const bool open = lines_.read(news_, [&](const std::string& line) {
    const auto news = nlohmann::json::parse(line, nullptr, false);
    if (!news.is_object()) return;
    if (const auto folder = news.find("so_far"); folder != news.end() && folder->is_string())
      so_far_ = folder->get<std::string>();
    complete = complete || news.contains("complete");
  });
  if (complete)
    news_ = -1;
  else if (!open)
    return Error{ErrorCode::invalid_state, folder_.string() + ": the recording was not completed"};
  return {};
}

}  // namespace booth
