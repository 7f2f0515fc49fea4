#pragma once

#include <algorithm>
#include <chrono>
#include <list>
#include <string>
#include <unordered_map>
#include <utility>

namespace booth::api {

/// How fast each client may go: a token bucket each. Remembers only so many clients, those that came last.
class RateLimiter {
 public:
  using TimePoint = std::chrono::steady_clock::time_point;
  struct Options {
    double per_second = 500;  ///< in the long run
    double burst = 2000;      ///< at once
    size_t most_clients = 4096;
  };
  explicit RateLimiter(Options options) : options_(options) {}

  /// @return whether the client has not used up what it may
  bool take(const std::string& client, TimePoint now) {
    const auto found = places_.find(client);
    if (found == places_.end()) {
      if (buckets_.size() >= options_.most_clients) {
        places_.erase(buckets_.back().client);
        buckets_.pop_back();
      }
      buckets_.push_front({client, options_.burst, now});
      places_[client] = buckets_.begin();
    } else {
      buckets_.splice(buckets_.begin(), buckets_, found->second);
    }
    Bucket& bucket = buckets_.front();
    const double elapsed_s = std::chrono::duration<double>(now - bucket.filled).count();
    bucket.tokens = std::min(options_.burst, bucket.tokens + elapsed_s * options_.per_second);
    bucket.filled = now;
    if (bucket.tokens < 1) return false;
    bucket.tokens -= 1;
    return true;
  }
  size_t clients() const { return buckets_.size(); }

 private:
  struct Bucket {
    std::string client;
    double tokens;
    TimePoint filled;
  };
  const Options options_;
  std::list<Bucket> buckets_;  ///< the one that came last first
  std::unordered_map<std::string, std::list<Bucket>::iterator> places_;
};

}  // namespace booth::api
