#pragma once

#include <chrono>
#include <filesystem>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "daemon/api/roles.h"
#include "pipeline/types/result.h"

namespace booth::api {

// The keys of CURVE, ZeroMQ's encryption (rfc.zeromq.org/spec/26): Curve25519 keys, in Z85, 40 characters.

struct CurveKeyPair {
  std::string public_key, secret_key;
};

/// What a client needs to reach a booth over tcp://.
struct ClientCredentials {
  CurveKeyPair keys;
  std::string server_key;  ///< the booth's public key
};

/// Somebody who may connect.
struct AllowedClient {
  std::string name;  ///< is_safe_id
  std::string public_key;
  Role role = Role::viewer;
  std::string created;  ///< ISO 8601, UTC; may be empty
};

bool is_curve_key(const std::string& text);

/// @error unsupported  libzmq was built without CURVE
Result<CurveKeyPair> make_key_pair();

/// Reads a file that save_server_keys wrote.
/// @error not_found, io; invalid_file  no key pair; others than its owner may read it
Result<CurveKeyPair> read_server_keys(const std::filesystem::path& file);
/// Only its owner may read it. @error disk_full, io
Result<void> save_server_keys(const std::filesystem::path& file, const CurveKeyPair& keys);

/// As read_server_keys and save_server_keys, of a client's side. The file may leave the server's key to others.
Result<ClientCredentials> read_client_credentials(const std::filesystem::path& file);
Result<void> save_client_credentials(const std::filesystem::path& file, const ClientCredentials& credentials);

/// Lets a client in: makes FOLDER/NAME.json, which holds nothing secret.
/// @error invalid_argument  its name or key; invalid_state  there is one of that name, or with that key
Result<void> allow_client(const std::filesystem::path& folder, const AllowedClient& client);
/// @error not_found
Result<void> revoke_client(const std::filesystem::path& folder, const std::string& name);
/// Every client that is let in, by name. A file that holds none is skipped and named in `faults`.
struct AllowedClients {
  std::vector<AllowedClient> clients;
  std::vector<std::string> faults;  ///< sentences
};
/// A folder that is missing holds none.
AllowedClients read_allowed_clients(const std::filesystem::path& folder);

/// Who is let in now: a folder that is looked at again, so that what is changed there holds at once. Any thread.
class ClientDirectory {
 public:
  explicit ClientDirectory(std::filesystem::path folder);

  std::optional<AllowedClient> find(const std::string& public_key) const;
  /// Reads the folder again. Sentences about new faults in it go to the log.
  void refresh();
  /// Grows when a key is no longer let in: its connections are to be closed.
  uint64_t revocations() const;

 private:
  const std::filesystem::path folder_;
  mutable std::mutex mutex_;
  std::map<std::string, AllowedClient> clients_;  ///< guarded by mutex_; by public key
  std::vector<std::string> faults_;               ///< guarded by mutex_
  uint64_t revocations_ = 0;                      ///< guarded by mutex_
};

}  // namespace booth::api
