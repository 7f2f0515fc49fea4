#include "daemon/avatar_store.h"

#include <fcntl.h>
#include <openssl/evp.h>
#include <spdlog/spdlog.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <nlohmann/json.hpp>
#include <system_error>
#include <tuple>
#include <utility>

#include "pipeline/types/rig.h"
#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

constexpr const char* metadata_name = "metadata.json";
constexpr size_t most_metadata_bytes = 4 * 1024 * 1024;

Error no_avatar(const std::string& id) { return {ErrorCode::not_found, "there is no avatar " + id}; }

Error io_error(const fs::path& file, int number) {
  return {ErrorCode::io, file.string() + ": cannot be read: " + std::generic_category().message(number)};
}

std::string text_of(const Json& json, const char* key) {
  const auto found = json.find(key);
  return found != json.end() && found->is_string() ? found->get<std::string>() : std::string();
}

class OpenFile {
 public:
  explicit OpenFile(const fs::path& path) : descriptor_(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NOFOLLOW)) {}
  ~OpenFile() {
    if (descriptor_ >= 0) ::close(descriptor_);
  }
  OpenFile(const OpenFile&) = delete;
  OpenFile& operator=(const OpenFile&) = delete;
  bool ok() const { return descriptor_ >= 0; }

  /// Up to bytes.size() bytes from `offset`; fewer only at the end. Nothing: an error, in errno.
  std::optional<size_t> read(uint8_t* bytes, size_t count, uint64_t offset) const {
    size_t done = 0;
    while (done < count) {
      const ssize_t got = ::pread(descriptor_, bytes + done, count - done, static_cast<off_t>(offset + done));
      if (got < 0 && errno == EINTR) continue;
      if (got < 0) return std::nullopt;
      if (got == 0) break;
      done += static_cast<size_t>(got);
    }
    return done;
  }

 private:
  int descriptor_;
};

/// In pieces: a file need not fit into memory. Empty on an error, in errno.
std::string sha256_of(const OpenFile& file) {
  constexpr size_t piece = 1024 * 1024;
  const std::unique_ptr<EVP_MD_CTX, decltype(&EVP_MD_CTX_free)> context(EVP_MD_CTX_new(), &EVP_MD_CTX_free);
  EVP_DigestInit_ex(context.get(), EVP_sha256(), nullptr);
  std::vector<uint8_t> bytes(piece);
  for (uint64_t offset = 0;;) {
    const auto got = file.read(bytes.data(), bytes.size(), offset);
    if (!got) return {};
    EVP_DigestUpdate(context.get(), bytes.data(), *got);
    offset += *got;
    if (*got < bytes.size()) break;
  }
  std::array<unsigned char, EVP_MAX_MD_SIZE> digest{};
  unsigned length = 0;
  EVP_DigestFinal_ex(context.get(), digest.data(), &length);
  constexpr std::string_view alphabet = "0123456789abcdef";
  std::string hex;
  for (unsigned i = 0; i < length; ++i) {
    hex += alphabet[digest[i] >> 4];
    hex += alphabet[digest[i] & 15];
  }
  return hex;
}

}  // namespace

Result<std::unique_ptr<AvatarStore>> AvatarStore::open(const fs::path& folder) {
  std::error_code code;
  fs::create_directories(folder, code);
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be made: " + code.message()};
  if (const auto removed = remove_partial_folders(folder); !removed) return removed.error();

  std::unique_ptr<AvatarStore> store(new AvatarStore(folder));
  for (fs::directory_iterator entry(folder, code), end; !code && entry != end; entry.increment(code)) {
    const std::string id = entry->path().filename().string();
    if (!is_safe_id(id)) continue;
    if (const auto listed = store->publish(id); !listed) spdlog::warn("{}", listed.error().message);
  }
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be listed: " + code.message()};
  return store;
}

Result<AvatarStore::Entry> AvatarStore::read(const std::string& id) const {
  const fs::path folder = folder_ / id;
  const auto text = read_file(folder / metadata_name, most_metadata_bytes);
  if (!text) return text.error();
  const Json json = Json::parse(*text, nullptr, false);
  if (!json.is_object())
    return Error{ErrorCode::invalid_file, (folder / metadata_name).string() + ": not a JSON object"};

  Entry entry;
  AvatarSummary& summary = entry.summary;
  summary.id = id;
  summary.created = text_of(json, "created");
  summary.label = text_of(json, "label");
  summary.capture = text_of(json, "recording");
  if (!is_safe_id(summary.capture)) summary.capture.clear();
  if (const auto found = json.find("triangles"); found != json.end() && found->is_number_unsigned())
    summary.triangles = found->get<uint64_t>();
  if (const auto found = json.find("warnings"); found != json.end() && found->is_array())
    for (const Json& warning : *found)
      if (warning.is_string()) summary.warnings.push_back(warning.get<std::string>());

  std::error_code code;
  for (fs::directory_iterator file(folder, code), end; !code && file != end; file.increment(code)) {
    const std::string name = file->path().filename().string();
    struct stat status {};
    if (name.front() == '.' || ::lstat(file->path().c_str(), &status) != 0 || !S_ISREG(status.st_mode)) continue;
    entry.files[name].size = static_cast<uint64_t>(status.st_size);
    summary.files.push_back(name);
  }
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be listed: " + code.message()};
  std::sort(summary.files.begin(), summary.files.end());
  return entry;
}

Result<AvatarSummary> AvatarStore::publish(const std::string& id) {
  auto entry = read(id);
  if (!entry) return entry.error();
  const std::lock_guard lock(mutex_);
  const AvatarSummary summary = entry->summary;
  entries_[id] = std::move(*entry);
  return summary;
}

Result<std::vector<AvatarSummary>> AvatarStore::list(size_t limit, const std::string& before) const {
  using Key = std::tuple<std::string, std::string>;
  const std::lock_guard lock(mutex_);
  const auto key_of = [](const Entry& entry) { return Key(entry.summary.created, entry.summary.id); };
  std::optional<Key> bound;
  if (!before.empty()) {
    const auto found = entries_.find(before);
    if (found == entries_.end()) return no_avatar(before);
    bound = key_of(found->second);
  }
  std::vector<std::pair<Key, const Entry*>> found;
  for (const auto& [id, entry] : entries_)
    if (Key key = key_of(entry); !bound || key < *bound) found.emplace_back(std::move(key), &entry);
  const size_t count = std::min(limit, found.size());
  std::partial_sort(found.begin(), found.begin() + static_cast<std::ptrdiff_t>(count), found.end(),
                    [](const auto& a, const auto& b) { return a.first > b.first; });
  std::vector<AvatarSummary> summaries;
  for (size_t i = 0; i < count; ++i) summaries.push_back(found[i].second->summary);
  return summaries;
}

std::optional<AvatarSummary> AvatarStore::find(const std::string& id) const {
  const std::lock_guard lock(mutex_);
  const auto found = entries_.find(id);
  if (found == entries_.end()) return std::nullopt;
  return found->second.summary;
}

std::vector<std::string> AvatarStore::of_capture(const std::string& capture) const {
  const std::lock_guard lock(mutex_);
  std::vector<std::string> ids;
  for (const auto& [id, entry] : entries_)
    if (entry.summary.capture == capture) ids.push_back(id);
  return ids;
}

void AvatarStore::forget(const std::string& id) {
  const std::lock_guard lock(mutex_);
  entries_.erase(id);
}

Result<std::string> AvatarStore::metadata(const std::string& id) const {
  if (!find(id)) return no_avatar(id);
  const auto text = read_file(folder_ / id / metadata_name, most_metadata_bytes);
  if (!text) return text.error();
  return std::string(text->begin(), text->end());
}

Result<FilePiece> AvatarStore::fetch(const std::string& id, const std::string& file, uint64_t offset, uint64_t length) {
  FilePiece piece;
  {
    const std::lock_guard lock(mutex_);
    const auto entry = entries_.find(id);
    if (entry == entries_.end()) return no_avatar(id);
    const auto found = entry->second.files.find(file);
    if (found == entry->second.files.end()) return Error{ErrorCode::not_found, "avatar " + id + " has no file " + file};
    piece.size = found->second.size;
    piece.sha256 = found->second.sha256;
  }
  if (offset > piece.size)
    return Error{ErrorCode::invalid_argument, "offset: " + std::to_string(offset) + ", expected at most the file's " +
                                                  std::to_string(piece.size) + " bytes"};
  const fs::path path = folder_ / id / file;
  const OpenFile opened(path);
  if (!opened.ok()) return errno == ENOENT ? no_avatar(id) : io_error(path, errno);
  if (piece.sha256.empty()) {
    piece.sha256 = sha256_of(opened);
    if (piece.sha256.empty()) return io_error(path, errno);
    const std::lock_guard lock(mutex_);
    if (const auto entry = entries_.find(id); entry != entries_.end()) entry->second.files[file].sha256 = piece.sha256;
  }
  piece.bytes.resize(static_cast<size_t>(std::min(length, piece.size - offset)));
  const auto got = opened.read(piece.bytes.data(), piece.bytes.size(), offset);
  if (!got) return io_error(path, errno);
  if (*got < piece.bytes.size()) return Error{ErrorCode::io, path.string() + ": shorter than when it was published"};
  return piece;
}

Result<void> AvatarStore::remove(const std::string& id) {
  forget(id);
  return remove_folder(folder_, id);
}

}  // namespace booth
