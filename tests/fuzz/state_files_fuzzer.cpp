#include <spdlog/spdlog.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>
#include <string>

#include "daemon/api/curve_keys.h"
#include "daemon/api/key_store.h"
#include "daemon/avatar_store.h"
#include "daemon/background_store.h"
#include "daemon/health_history.h"
#include "daemon/job_queue.h"
#include "daemon/projector_delay.h"

namespace {

namespace fs = std::filesystem;

/// Files that the booth keeps for itself, or that an operator hands it: jobs, answers, avatars, backgrounds, keys, its
/// history. Every name that is read from the disk at the start.
constexpr const char* files[] = {
    "jobs/2026.json",   "keys.jsonl", "avatars/2026/metadata.json", "backgrounds/2026/recording.json",
    "clients/one.json", "secret.key", "projector-delay.json",       "history.json"};

/// In memory: nothing waits for a disk.
const fs::path& folder() {
  static const fs::path made = [] {
    spdlog::set_level(spdlog::level::off);
    std::string name = "/dev/shm/booth-state-fuzzer-XXXXXX";
    if (::mkdtemp(name.data()) == nullptr) std::abort();
    static const struct Removed {
      fs::path path;
      ~Removed() { fs::remove_all(path); }
    } removed{name};
    return fs::path(name);
  }();
  return made;
}

void require(bool holds) {
  if (!holds) std::abort();
}

}  // namespace

/// Whatever is in one of its files, the booth opens its stores: a file that is none is left out, or refused in a
/// sentence.
extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  for (const char* name : files) {
    const fs::path file = folder() / name;
    fs::create_directories(file.parent_path());
    std::ofstream(file, std::ios::binary)
        .write(reinterpret_cast<const char*>(data), static_cast<std::streamsize>(size));
  }
  ::chmod((folder() / "secret.key").c_str(), 0600);

  booth::EventBus events;
  const auto jobs = booth::JobQueue::open(folder() / "jobs", events);
  require(jobs.ok());
  for (const booth::Job& job : (*jobs)->list()) require(job.id == "2026");
  require(booth::api::KeyStore::open(folder() / "keys.jsonl", std::chrono::system_clock::now()).ok());
  const auto avatars = booth::AvatarStore::open(folder() / "avatars");
  require(avatars.ok());
  if (const auto listed = (*avatars)->list(10, "")) require(listed->size() <= 1);
  require(booth::BackgroundStore::open(folder() / "backgrounds").ok());
  for (const auto& client : booth::api::read_allowed_clients(folder() / "clients").clients)
    require(booth::api::is_curve_key(client.public_key));
  if (const auto keys = booth::api::read_server_keys(folder() / "secret.key"))
    require(booth::api::is_curve_key(keys->secret_key));
  if (const auto keys = booth::api::read_client_credentials(folder() / "secret.key"))
    require(keys->server_key.empty() || booth::api::is_curve_key(keys->server_key));
  if (const auto delay = booth::read_projector_delay(folder() / "projector-delay.json"))
    require(delay->delay_us >= 0 && delay->delay_us <= 1'000'000);
  const booth::HealthHistory history(folder() / "history.json");
  for (const booth::HealthSample& sample : history.samples({}, 10))
    require(booth::health_sample_from(booth::to_json(sample)).has_value());
  return 0;
}
