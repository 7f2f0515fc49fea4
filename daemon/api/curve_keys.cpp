#include "daemon/api/curve_keys.h"

#include <spdlog/spdlog.h>
#include <sys/stat.h>
#include <zmq.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <nlohmann/json.hpp>
#include <system_error>
#include <utility>

#include "daemon/identifier.h"
#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth::api {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

constexpr size_t z85_characters = 40;
constexpr size_t key_bytes = 32;
constexpr size_t most_file_bytes = 4096;
constexpr const char* extension = ".json";

/// Files that this program makes from now on can be read by nobody else.
class PrivateFiles {
 public:
  PrivateFiles() : before_(::umask(0077)) {}
  ~PrivateFiles() { ::umask(before_); }
  PrivateFiles(const PrivateFiles&) = delete;
  PrivateFiles& operator=(const PrivateFiles&) = delete;

 private:
  const mode_t before_;
};

Result<Json> read_json(const fs::path& file) {
  const auto bytes = read_file(file, most_file_bytes);
  if (!bytes) return bytes.error();
  Json json = Json::parse(bytes->begin(), bytes->end(), nullptr, false);
  if (!json.is_object()) return Error{ErrorCode::invalid_file, file.string() + ": is not a JSON object"};
  return json;
}

Result<std::string> read_key(const Json& json, const char* member, const fs::path& file) {
  const auto found = json.find(member);
  if (found == json.end() || !found->is_string() || !is_curve_key(found->get<std::string>()))
    return Error{ErrorCode::invalid_file, file.string() + ": " + member + ": expected a key of 40 characters in Z85"};
  return found->get<std::string>();
}

Result<CurveKeyPair> read_key_pair(const Json& json, const fs::path& file) {
  auto public_key = read_key(json, "public_key", file);
  if (!public_key) return public_key.error();
  auto secret_key = read_key(json, "secret_key", file);
  if (!secret_key) return secret_key.error();
  std::array<char, z85_characters + 1> derived{};
  if (zmq_curve_public(derived.data(), secret_key->c_str()) != 0 || *public_key != derived.data())
    return Error{ErrorCode::invalid_file, file.string() + ": its public key is not that of its secret key"};
  return CurveKeyPair{std::move(*public_key), std::move(*secret_key)};
}

/// A secret that others have read is none.
Result<Json> read_secret(const fs::path& file) {
  struct stat status {};
  if (::stat(file.c_str(), &status) != 0)
    return Error{errno == ENOENT ? ErrorCode::not_found : ErrorCode::io,
                 file.string() + ": " + std::generic_category().message(errno)};
  if ((status.st_mode & 077U) != 0)
    return Error{ErrorCode::invalid_file,
                 file.string() + ": others than its owner may read this secret key: chmod 600 it, or make a new one"};
  return read_json(file);
}

Result<AllowedClient> read_client(const fs::path& file) {
  const auto json = read_json(file);
  if (!json) return json.error();
  AllowedClient client;
  client.name = file.stem().string();
  if (!is_safe_id(client.name)) return Error{ErrorCode::invalid_file, file.string() + ": not the name of a client"};
  auto key = read_key(*json, "public_key", file);
  if (!key) return key.error();
  client.public_key = std::move(*key);
  const auto role = json->find("role");
  const auto known = role != json->end() && role->is_string() ? role_from(role->get<std::string>()) : std::nullopt;
  if (!known)
    return Error{ErrorCode::invalid_file, file.string() + ": role: expected \"viewer\", \"kiosk\" or \"operator\""};
  client.role = *known;
  if (const auto created = json->find("created"); created != json->end() && created->is_string())
    client.created = created->get<std::string>();
  return client;
}

}  // namespace

bool is_curve_key(const std::string& text) {
  std::array<uint8_t, key_bytes> decoded{};
  // zmq_z85_decode reads whole groups of five without looking at characters beyond ASCII first.
  return text.size() == z85_characters &&
         std::all_of(text.begin(), text.end(), [](char c) { return c > ' ' && c < '\x7f'; }) &&
         zmq_z85_decode(decoded.data(), text.c_str()) != nullptr;
}

Result<CurveKeyPair> make_key_pair() {
  std::array<char, z85_characters + 1> public_key{}, secret_key{};
  if (zmq_curve_keypair(public_key.data(), secret_key.data()) != 0)
    return Error{ErrorCode::unsupported, "this build of ZeroMQ has no CURVE: keys cannot be made"};
  return CurveKeyPair{public_key.data(), secret_key.data()};
}

Result<CurveKeyPair> read_server_keys(const fs::path& file) {
  const auto json = read_secret(file);
  if (!json) return json.error();
  return read_key_pair(*json, file);
}

Result<void> save_server_keys(const fs::path& file, const CurveKeyPair& keys) {
  const PrivateFiles only_mine;
  return write_file_atomically(file,
                               Json{{"public_key", keys.public_key}, {"secret_key", keys.secret_key}}.dump(2) + "\n");
}

Result<ClientCredentials> read_client_credentials(const fs::path& file) {
  const auto json = read_secret(file);
  if (!json) return json.error();
  auto keys = read_key_pair(*json, file);
  if (!keys) return keys.error();
  ClientCredentials credentials{std::move(*keys), ""};
  if (json->contains("server_key")) {
    auto server = read_key(*json, "server_key", file);
    if (!server) return server.error();
    credentials.server_key = std::move(*server);
  }
  return credentials;
}

Result<void> save_client_credentials(const fs::path& file, const ClientCredentials& credentials) {
  const PrivateFiles only_mine;
  return write_file_atomically(file, Json{{"public_key", credentials.keys.public_key},
                                          {"secret_key", credentials.keys.secret_key},
                                          {"server_key", credentials.server_key}}
                                             .dump(2) +
                                         "\n");
}

Result<void> allow_client(const fs::path& folder, const AllowedClient& client) {
  if (!is_safe_id(client.name))
    return Error{ErrorCode::invalid_argument, "\"" + client.name +
                                                  "\" is no name for a client: use letters, digits, "
                                                  "'.', '_' and '-'"};
  if (!is_curve_key(client.public_key))
    return Error{ErrorCode::invalid_argument, "\"" + client.public_key +
                                                  "\" is no public key: expected 40 characters "
                                                  "in Z85"};
  for (const AllowedClient& other : read_allowed_clients(folder).clients)
    if (other.name == client.name || other.public_key == client.public_key)
      return Error{ErrorCode::invalid_state, "there is a client " + other.name + " already" +
                                                 (other.name == client.name ? "" : ", with the same key") +
                                                 ": revoke it first"};
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be made: " + code.message()};
  const Json json{{"public_key", client.public_key},
                  {"role", to_string(client.role)},
                  {"created", client.created.empty() ? iso8601(std::chrono::system_clock::now()) : client.created}};
  const fs::path file = folder / (client.name + extension);
  if (const auto written = write_file_atomically(file, json.dump(2) + "\n"); !written) return written;
  // The booth reads it as another user than the operator who made it, and nothing in it is secret.
  constexpr auto everybody_reads = fs::perms(0644);
  fs::permissions(file, everybody_reads, code);
  if (code) return Error{ErrorCode::io, file.string() + ": its permissions cannot be set: " + code.message()};
  return {};
}

Result<void> revoke_client(const fs::path& folder, const std::string& name) {
  const fs::path file = folder / (name + extension);
  std::error_code code;
  if (!is_safe_id(name) || !fs::remove(file, code)) {
    if (code) return Error{ErrorCode::io, file.string() + ": cannot be removed: " + code.message()};
    return Error{ErrorCode::not_found, "there is no client " + name};
  }
  return {};
}

AllowedClients read_allowed_clients(const fs::path& folder) {
  AllowedClients found;
  std::error_code code;
  std::vector<fs::path> files;
  for (fs::directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code))
    if (entry->path().extension() == extension && !entry->path().filename().string().starts_with("."))
      files.push_back(entry->path());
  if (code && code != std::errc::no_such_file_or_directory)
    found.faults.push_back(folder.string() + ": cannot be read, so nobody is let in: " + code.message());
  std::sort(files.begin(), files.end());
  for (const fs::path& file : files) {
    auto client = read_client(file);
    if (client)
      found.clients.push_back(std::move(*client));
    else
      found.faults.push_back(client.error().message);
  }
  return found;
}

ClientDirectory::ClientDirectory(fs::path folder) : folder_(std::move(folder)) { refresh(); }

std::optional<AllowedClient> ClientDirectory::find(const std::string& public_key) const {
  const std::lock_guard lock(mutex_);
  const auto found = clients_.find(public_key);
  if (found == clients_.end()) return std::nullopt;
  return found->second;
}

void ClientDirectory::refresh() {
  AllowedClients read = read_allowed_clients(folder_);
  std::map<std::string, AllowedClient> clients;
  for (AllowedClient& client : read.clients) {
    const std::string key = client.public_key;
    // Two files with one key: the role that may less counts.
    const auto [entry, added] = clients.try_emplace(key, client);
    if (!added && client.role < entry->second.role) entry->second = std::move(client);
  }
  const std::lock_guard lock(mutex_);
  if (read.faults != faults_)
    for (const std::string& fault : read.faults) spdlog::warn("{}", fault);
  faults_ = std::move(read.faults);
  for (const auto& [key, client] : clients_)
    if (!clients.contains(key)) {
      ++revocations_;
      spdlog::info("the client {} is no longer let in", client.name);
    }
  clients_ = std::move(clients);
}

uint64_t ClientDirectory::revocations() const {
  const std::lock_guard lock(mutex_);
  return revocations_;
}

}  // namespace booth::api
