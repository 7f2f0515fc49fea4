#include "daemon/health_history.h"

#include <spdlog/spdlog.h>

#include <algorithm>
#include <nlohmann/json.hpp>
#include <utility>

#include "daemon/identifier.h"
#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

using Json = nlohmann::json;

constexpr double sample_s = 300;
constexpr size_t most_fine = 288;   ///< a day
constexpr size_t most_hours = 336;  ///< two weeks
constexpr size_t most_days = 400;
constexpr size_t most_file_bytes = size_t{32} << 20;  ///< some hundred cameras' share of all that is kept
constexpr size_t most_cameras = 256;                  ///< of a sample that is read
constexpr double most_amount = 1e15;                  ///< of anything in a sample that is read: sums of them are exact
constexpr int version = 1;

/// Numbers of a sample under their names, for reading and writing alike.
constexpr std::pair<const char*, double HealthSample::*> durations[] = {{"observed_s", &HealthSample::observed_s},
                                                                        {"ready_s", &HealthSample::ready_s}};
constexpr std::pair<const char*, double HealthTotals::*> sums[] = {{"captures_done", &HealthTotals::captures_done},
                                                                   {"captures_failed", &HealthTotals::captures_failed},
                                                                   {"jobs_done", &HealthTotals::jobs_done},
                                                                   {"jobs_failed", &HealthTotals::jobs_failed},
                                                                   {"job_s", &HealthTotals::job_seconds}};
constexpr std::pair<const char*, uint64_t HealthSample::*> most[] = {
    {"most_queued", &HealthSample::most_queued},
    {"most_used_bytes", &HealthSample::most_used_bytes},
    {"most_resident_bytes", &HealthSample::most_resident_bytes},
    {"most_descriptors", &HealthSample::most_descriptors},
    {"most_threads", &HealthSample::most_threads}};
constexpr std::pair<const char*, uint64_t HealthSample::*> others[] = {
    {"starts", &HealthSample::starts}, {"least_free_bytes", &HealthSample::least_free_bytes}};

std::optional<double> amount(const Json& json, const char* name) {
  const auto found = json.find(name);
  if (found == json.end() || !found->is_number()) return std::nullopt;
  const auto value = found->get<double>();
  if (!(value >= 0 && value <= most_amount)) return std::nullopt;  // a NaN is none of these
  return value;
}

std::optional<uint64_t> count(const Json& json, const char* name) {
  const auto found = json.find(name);
  if (found == json.end() || !found->is_number_unsigned()) return std::nullopt;
  const auto value = found->get<uint64_t>();
  if (value > static_cast<uint64_t>(most_amount)) return std::nullopt;
  return value;
}

std::optional<std::chrono::sys_seconds> instant(const Json& json, const char* name) {
  const auto found = json.find(name);
  if (found == json.end() || !found->is_string()) return std::nullopt;
  const auto time = parse_iso8601(found->get_ref<const std::string&>());
  if (!time) return std::nullopt;
  return std::chrono::floor<std::chrono::seconds>(*time);
}

/// `later` follows `sample`, which becomes both.
void append(HealthSample& sample, const HealthSample& later) {
  sample.end = later.end;
  for (const auto& [name, member] : durations) sample.*member += later.*member;
  for (const auto& [name, member] : sums) sample.totals.*member += later.totals.*member;
  for (const auto& [name, member] : most) sample.*member = std::max(sample.*member, later.*member);
  sample.starts += later.starts;
  sample.least_free_bytes = std::min(sample.least_free_bytes, later.least_free_bytes);
  for (const auto& [id, camera] : later.cameras) {
    HealthSample::Camera& sum = sample.cameras[id];
    sum.offline_s += camera.offline_s;
    sum.frames += camera.frames;
    sum.dropped += camera.dropped;
  }
}

/// The oldest of `from` that are too many go to `to`, where those of one hour or day, `Span`, become one.
template <class Span>
void move_oldest(std::deque<HealthSample>& from, size_t most_kept, std::deque<HealthSample>& to) {
  while (from.size() > most_kept) {
    HealthSample sample = std::move(from.front());
    from.pop_front();
    if (!to.empty() && std::chrono::floor<Span>(to.back().begin) == std::chrono::floor<Span>(sample.begin))
      append(to.back(), sample);
    else
      to.push_back(std::move(sample));
  }
}

/// What two counters of one process differ by; one of them may have been begun anew.
template <class Number>
Number grown(Number before, Number now) {
  return now >= before ? now - before : now;
}

HealthSample sample_of(const HealthObservation& now, const std::optional<HealthObservation>& before) {
  HealthSample sample;
  const auto time = std::chrono::floor<std::chrono::seconds>(now.time);
  sample.begin = before ? std::chrono::floor<std::chrono::seconds>(before->time) : time;
  sample.end = time;
  sample.starts = before ? 0 : 1;
  sample.observed_s = before ? std::chrono::duration<double>(now.steady - before->steady).count() : 0;
  sample.ready_s = now.ready ? sample.observed_s : 0;
  for (const auto& [name, member] : sums)
    sample.totals.*member = grown(before ? before->totals.*member : 0, now.totals.*member);
  sample.most_queued = now.queued;
  sample.least_free_bytes = now.free_bytes;
  sample.most_used_bytes = now.used_bytes;
  sample.most_resident_bytes = now.resident_bytes;
  sample.most_descriptors = now.descriptors;
  sample.most_threads = now.threads;
  for (const CameraObservation& camera : now.cameras) {
    CameraObservation earlier;
    if (before)
      for (const CameraObservation& known : before->cameras)
        if (known.id == camera.id) earlier = known;
    sample.cameras[camera.id] = {.offline_s = camera.offline ? sample.observed_s : 0,
                                 .frames = grown(earlier.frames, camera.frames),
                                 .dropped = grown(earlier.dropped, camera.dropped)};
  }
  return sample;
}

void read_samples(const Json& file, const char* name, size_t most_kept, std::deque<HealthSample>& into) {
  const auto list = file.find(name);
  if (list == file.end() || !list->is_array()) return;
  for (const Json& entry : *list)
    if (auto sample = health_sample_from(entry)) into.push_back(std::move(*sample));
  while (into.size() > most_kept) into.pop_front();
}

template <class Samples>
Json list_of(const Samples& samples) {
  Json list = Json::array();
  for (const HealthSample& sample : samples) list.push_back(to_json(sample));
  return list;
}

}  // namespace

Json to_json(const HealthSample& sample) {
  Json json{{"begin", iso8601(sample.begin)}, {"end", iso8601(sample.end)}};
  for (const auto& [name, member] : durations) json[name] = sample.*member;
  for (const auto& [name, member] : sums) json[name] = sample.totals.*member;
  for (const auto& [name, member] : most) json[name] = sample.*member;
  for (const auto& [name, member] : others) json[name] = sample.*member;
  Json cameras = Json::array();
  for (const auto& [id, camera] : sample.cameras)
    cameras.push_back(
        {{"id", id}, {"offline_s", camera.offline_s}, {"frames", camera.frames}, {"dropped", camera.dropped}});
  json["cameras"] = std::move(cameras);
  return json;
}

std::optional<HealthSample> health_sample_from(const Json& json) {
  if (!json.is_object()) return std::nullopt;
  HealthSample sample;
  const auto begin = instant(json, "begin"), end = instant(json, "end");
  const auto cameras = json.find("cameras");
  if (!begin || !end || cameras == json.end() || !cameras->is_array() || cameras->size() > most_cameras)
    return std::nullopt;
  sample.begin = *begin;
  sample.end = *end;
  bool whole = true;
  const auto take = [&whole](auto& member, const auto& value) {
    whole = whole && value;
    if (value) member = *value;
  };
  for (const auto& [name, member] : durations) take(sample.*member, amount(json, name));
  for (const auto& [name, member] : sums) take(sample.totals.*member, amount(json, name));
  for (const auto& [name, member] : most) take(sample.*member, count(json, name));
  for (const auto& [name, member] : others) take(sample.*member, count(json, name));
  for (const Json& entry : *cameras) {
    const auto id = entry.is_object() ? entry.find("id") : entry.end();
    if (id == entry.end() || !id->is_string() || !is_safe_id(id->get_ref<const std::string&>())) return std::nullopt;
    HealthSample::Camera& camera = sample.cameras[id->get<std::string>()];
    take(camera.offline_s, amount(entry, "offline_s"));
    take(camera.frames, count(entry, "frames"));
    take(camera.dropped, count(entry, "dropped"));
  }
  if (!whole) return std::nullopt;
  return sample;
}

HealthHistory::HealthHistory(std::filesystem::path file) : file_(std::move(file)) { load(); }

void HealthHistory::load() {
  const auto bytes = read_file(file_, most_file_bytes);
  if (!bytes) {
    if (bytes.error().code == ErrorCode::not_found) return;
    writable_ = bytes.error().code == ErrorCode::invalid_file;
    return spdlog::warn("the health history is begun anew: {}", bytes.error().message);
  }
  const Json json = Json::parse(*bytes, nullptr, false);
  if (!json.is_object() || json.value("version", Json()) != version)
    return spdlog::warn("{}: not a health history, it is begun anew", file_.string());
  read_samples(json, "days", most_days, days_);
  read_samples(json, "hours", most_hours, hours_);
  read_samples(json, "fine", most_fine, fine_);
}

bool HealthHistory::observe(const HealthObservation& now) {
  const std::lock_guard lock(mutex_);
  const bool first = !last_;
  HealthSample sample = sample_of(now, last_);
  last_ = now;
  // A short one that the program's last run ended with is gone on with.
  if (first && !fine_.empty() && fine_.back().observed_s < sample_s && fine_.back().begin <= sample.begin &&
      sample.begin - fine_.back().begin < std::chrono::hours(1)) {
    current_ = std::move(fine_.back());
    fine_.pop_back();
  }
  if (current_)
    append(*current_, sample);
  else
    current_ = std::move(sample);
  const bool complete = current_->observed_s >= sample_s;
  if (complete) {
    keep(std::move(*current_));
    current_.reset();
  }
  return first || complete;
}

void HealthHistory::keep(HealthSample sample) {
  fine_.push_back(std::move(sample));
  move_oldest<std::chrono::hours>(fine_, most_fine, hours_);
  move_oldest<std::chrono::days>(hours_, most_hours, days_);
  while (days_.size() > most_days) days_.pop_front();
}

Result<void> HealthHistory::save() const {
  if (!writable_) return {};
  Json json{{"version", version}};
  {
    const std::lock_guard lock(mutex_);
    json["days"] = list_of(days_);
    json["hours"] = list_of(hours_);
    json["fine"] = list_of(fine_);
    if (current_) json["fine"].push_back(to_json(*current_));
  }
  return write_file_atomically(file_, json.dump() + "\n");
}

std::vector<HealthSample> HealthHistory::all() const {
  const std::lock_guard lock(mutex_);
  std::vector<HealthSample> all(days_.begin(), days_.end());
  all.insert(all.end(), hours_.begin(), hours_.end());
  all.insert(all.end(), fine_.begin(), fine_.end());
  if (current_) all.push_back(*current_);
  return all;
}

std::vector<HealthSample> HealthHistory::samples(std::chrono::system_clock::time_point since, size_t limit) const {
  std::vector<HealthSample> wanted = all();
  std::erase_if(wanted, [since](const HealthSample& sample) { return sample.end < since; });
  if (limit == 0) return {};
  const size_t each = (wanted.size() + limit - 1) / limit;
  std::vector<HealthSample> summed;
  for (size_t i = 0; i < wanted.size(); ++i)
    if (i % each == 0)
      summed.push_back(std::move(wanted[i]));
    else
      append(summed.back(), wanted[i]);
  return summed;
}

std::filesystem::path health_history_file(const std::filesystem::path& state_directory) {
  return state_directory / "history.json";
}

}  // namespace booth
