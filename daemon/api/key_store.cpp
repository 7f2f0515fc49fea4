#include "daemon/api/key_store.h"

#include <fcntl.h>
#include <spdlog/spdlog.h>
#include <unistd.h>

#include <cerrno>
#include <nlohmann/json.hpp>
#include <span>
#include <sstream>
#include <system_error>
#include <utility>

#include "pipeline/export/sha256.h"
#include "replay/durable_folder.h"

namespace booth::api {
namespace {

using Json = nlohmann::json;

constexpr std::chrono::hours lifetime{24};
constexpr size_t most_keys = 100'000;      ///< the oldest go first, should somebody use up more in a day
constexpr size_t most_ended_lines = 1000;  ///< in the journal, besides as many as have not ended
constexpr size_t most_journal_bytes = 256UL * 1024 * 1024;
constexpr uint64_t latest_s = 9'000'000'000;  ///< that a time point, which counts nanoseconds, can hold

std::string digest_of(const std::string& key, const std::string& method, const Json& params) {
  const std::string text = Json{key, method, params}.dump();
  return sha256_hex({reinterpret_cast<const uint8_t*>(text.data()), text.size()});
}

int64_t to_seconds(KeyStore::Clock::time_point time) {
  return std::chrono::duration_cast<std::chrono::seconds>(time.time_since_epoch()).count();
}

/// What takes the journal's place when it is written anew.
std::filesystem::path successor(const std::filesystem::path& journal) { return journal.string() + ".next"; }

std::string line_of(const std::string& key, const std::string& digest, const std::string& result,
                    KeyStore::Clock::time_point until) {
  return Json{{"key", key}, {"digest", digest}, {"result", result}, {"until", to_seconds(until)}}.dump() + "\n";
}

}  // namespace

Result<std::unique_ptr<KeyStore>> KeyStore::open(const std::filesystem::path& journal, Clock::time_point now) {
  std::unique_ptr<KeyStore> store(new KeyStore(journal));
  ::unlink(successor(journal).c_str());  // of a process that was killed; everything is in the journal itself
  const auto bytes = read_file(journal, most_journal_bytes);
  if (!bytes && bytes.error().code != ErrorCode::not_found) spdlog::warn("{}", bytes.error().message);
  std::string kept;
  if (bytes) {
    std::istringstream lines(std::string(bytes->begin(), bytes->end()));
    for (std::string line; std::getline(lines, line);) {
      const Json json = Json::parse(line, nullptr, false);
      try {
        const Json& seconds = json.at("until");
        if (!seconds.is_number_unsigned() || seconds.get<uint64_t>() > latest_s) continue;
        const Clock::time_point until{std::chrono::seconds(seconds.get<int64_t>())};
        // A clock that was set back must not make a key live for years.
        if (until <= now || until > now + lifetime) continue;
        const auto key = json.at("key").get<std::string>();
        store->entries_[key] = {json.at("digest").get<std::string>(), json.at("result").get<std::string>(), until};
        store->order_.emplace_back(until, key);
        kept += line + "\n";
        ++store->lines_;
      } catch (const Json::exception&) {
        spdlog::warn("{}: a line that cannot be read is dropped", journal.string());
      }
    }
  }
  if (const auto written = write_file_atomically(journal, kept); !written) return written.error();
  store->journal_ = ::open(journal.c_str(), O_WRONLY | O_APPEND | O_CLOEXEC);
  if (store->journal_ < 0)
    return Error{ErrorCode::io, journal.string() + ": cannot be opened: " + std::generic_category().message(errno)};
  return store;
}

KeyStore::~KeyStore() {
  if (journal_ >= 0) ::close(journal_);
}

void KeyStore::expire(Clock::time_point now) {
  while (!order_.empty() && (order_.front().first <= now || order_.size() > most_keys)) {
    const auto& [until, key] = order_.front();
    if (const auto entry = entries_.find(key); entry != entries_.end() && entry->second.until <= until)
      entries_.erase(entry);
    order_.pop_front();
  }
}

KeyStore::Found KeyStore::find(const std::string& key, const std::string& method, const Json& params,
                               Clock::time_point now) {
  const std::lock_guard lock(mutex_);
  expire(now);
  const auto entry = entries_.find(key);
  if (entry == entries_.end()) return Unknown{};
  if (entry->second.digest != digest_of(key, method, params)) return OtherRequest{};
  return entry->second.result;
}

void KeyStore::remember(const std::string& key, const std::string& method, const Json& params,
                        const std::string& result, Clock::time_point now) {
  Entry entry{digest_of(key, method, params), result, now + lifetime};
  const std::string line = line_of(key, entry.digest, result, entry.until);
  const std::lock_guard lock(mutex_);
  append(line);
  ++lines_;
  if (appended_) *appended_ += line;
  order_.emplace_back(entry.until, key);
  entries_[key] = std::move(entry);
}

/// One write of one line: another process that appends, or a crash, leaves whole lines or none.
void KeyStore::append(const std::string& line) {
  ssize_t written = 0;
  do written = ::write(journal_, line.data(), line.size());
  while (written < 0 && errno == EINTR);
  if (written != static_cast<ssize_t>(line.size()))
    spdlog::error("a request's key cannot be written down: {}", std::generic_category().message(errno));
}

void KeyStore::sync() {
  const std::lock_guard disk_lock(disk_mutex_);  // the journal stays the same one
  bool mostly_ended = false;
  int journal = -1;
  {
    const std::lock_guard lock(mutex_);
    journal = journal_;
    mostly_ended = lines_ > 2 * entries_.size() + most_ended_lines;
  }
  if (mostly_ended)
    compact();
  else
    ::fdatasync(journal);
}

/// Writes the journal anew beside itself, adds what came meanwhile, and puts it in its place.
void KeyStore::compact() {
  std::string kept;
  {
    const std::lock_guard lock(mutex_);
    for (const auto& [until, key] : order_)
      if (const auto entry = entries_.find(key); entry != entries_.end() && entry->second.until == until)
        kept += line_of(key, entry->second.digest, entry->second.result, until);
    appended_ = "";
  }
  const std::filesystem::path next = successor(file_);
  const auto written = write_file_atomically(next, kept);
  int journal = -1;
  {
    const std::lock_guard lock(mutex_);
    const std::string since = *std::exchange(appended_, std::nullopt);
    const int opened = written ? ::open(next.c_str(), O_WRONLY | O_APPEND | O_CLOEXEC) : -1;
    if (opened < 0) return spdlog::warn("{}: cannot be written anew, it goes on growing", file_.string());
    const int before = std::exchange(journal_, opened);
    if (!since.empty()) append(since);
    if (::rename(next.c_str(), file_.c_str()) != 0) {
      spdlog::warn("{}: cannot be written anew, it goes on growing", file_.string());
      ::close(std::exchange(journal_, before));
      return;
    }
    ::close(before);
    lines_ = entries_.size();
    journal = opened;
  }
  ::fdatasync(journal);
  if (const auto flushed = flush_to_disk(file_.parent_path()); !flushed) spdlog::warn("{}", flushed.error().message);
}

}  // namespace booth::api
