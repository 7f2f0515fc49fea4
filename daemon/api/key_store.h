#pragma once

#include <chrono>
#include <deque>
#include <filesystem>
#include <memory>
#include <mutex>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <unordered_map>
#include <variant>

#include "pipeline/types/result.h"

namespace booth::api {

/// The answers that were given to requests with a `key`, kept for a day, across restarts: a request repeated gets the
/// same answer and changes nothing. Of a request's parameters only a digest is kept. Any thread.
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

  /// Waits for the disk. A journal of which most has ended is written anew, without holding up the others meanwhile.
  void sync();

 private:
  struct Entry {
    std::string digest, result;
    Clock::time_point until;
  };
  explicit KeyStore(std::filesystem::path journal) : file_(std::move(journal)) {}
  void expire(Clock::time_point now);
  void append(const std::string& line);
  void compact();

  const std::filesystem::path file_;
  std::mutex disk_mutex_;  ///< held while the disk is waited for; before mutex_
  std::mutex mutex_;
  int journal_ = -1;                                             ///< guarded by mutex_, and changes under both
  std::unordered_map<std::string, Entry> entries_;               ///< guarded by mutex_
  std::deque<std::pair<Clock::time_point, std::string>> order_;  ///< guarded by mutex_; keys by the time they end
  size_t lines_ = 0;                                             ///< guarded by mutex_; of the journal
  std::optional<std::string> appended_;                          ///< guarded by mutex_; lines since compact() began
};

}  // namespace booth::api
