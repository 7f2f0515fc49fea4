#pragma once

#include <chrono>
#include <deque>
#include <filesystem>
#include <memory>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <unordered_map>
#include <variant>

#include "pipeline/types/result.h"

namespace booth::api {

/// The answers that were given to requests with a `key`, kept for a day, across restarts: a request repeated gets the
/// same answer and changes nothing. Of a request's parameters only a digest is kept. One thread at a time.
class KeyStore {
 public:
  using Clock = std::chrono::system_clock;

  /// Reads the journal; lines that cannot be read, as a crash may leave one, are dropped.
  /// @error io, disk_full
  static Result<std::unique_ptr<KeyStore>> open(const std::filesystem::path& journal, Clock::time_point now);
  ~KeyStore();

  struct Unknown {};                                               ///< a new key
  struct OtherRequest {};                                          ///< the key was used for something else
  using Found = std::variant<Unknown, OtherRequest, std::string>;  ///< or the first answer's result, as JSON text
  Found find(const std::string& key, const std::string& method, const nlohmann::json& params, Clock::time_point now);

  /// Writes it down where it outlives this process; sync() brings it to the disk.
  void remember(const std::string& key, const std::string& method, const nlohmann::json& params,
                const std::string& result, Clock::time_point now);

  /// Waits for the disk; any thread, until the store is destroyed.
  void sync() const;

 private:
  struct Entry {
    std::string digest, result;
    Clock::time_point until;
  };
  KeyStore() = default;
  void expire(Clock::time_point now);

  int journal_ = -1;
  std::unordered_map<std::string, Entry> entries_;
  std::deque<std::pair<Clock::time_point, std::string>> order_;  ///< keys by the time they end
};

}  // namespace booth::api
