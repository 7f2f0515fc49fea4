#include "daemon/trace_search.h"

#include <algorithm>
#include <array>
#include <cerrno>
#include <fstream>
#include <nlohmann/json.hpp>
#include <string_view>
#include <system_error>

namespace booth {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

bool has_word(std::string_view text, const std::vector<std::string>& words) {
  return std::any_of(words.begin(), words.end(), [&](const std::string& word) {
    return !word.empty() && text.find(word) != std::string_view::npos;
  });
}

/// The clients' own words in the journal of answers.
Result<bool> has_trace_of_keys(const fs::path& file, const std::vector<std::string>& words) {
  std::ifstream stream(file);
  if (!stream) return Error{ErrorCode::io, file.string() + ": cannot be read"};
  for (std::string line; std::getline(stream, line);) {
    const Json json = Json::parse(line, nullptr, false);
    const auto key = json.is_object() ? json.find("key") : json.end();
    if (!json.is_object() || key == json.end() || !key->is_string() ? has_word(line, words)
                                                                    : has_word(key->get<std::string>(), words))
      return true;
  }
  return false;
}

}  // namespace

Result<bool> has_trace(const fs::path& file, const std::vector<std::string>& words) {
  std::ifstream stream(file, std::ios::binary);
  if (!stream) return Error{errno == ENOENT ? ErrorCode::not_found : ErrorCode::io, file.string() + ": cannot be read"};
  size_t longest = 0;
  for (const std::string& word : words) longest = std::max(longest, word.size());
  if (longest == 0) return false;
  constexpr size_t piece_bytes = 1 << 20;
  std::string text;
  for (;;) {
    const size_t kept = std::min(text.size(), longest - 1);  // a word may lie across two pieces
    text.erase(0, text.size() - kept);
    text.resize(kept + piece_bytes);
    stream.read(text.data() + kept, piece_bytes);
    text.resize(kept + static_cast<size_t>(stream.gcount()));
    if (has_word(text, words)) return true;
    if (stream.bad()) return Error{ErrorCode::io, file.string() + ": cannot be read"};
    if (!stream) return false;
  }
}

Result<std::vector<fs::path>> find_traces(const fs::path& folder, const std::vector<std::string>& words) {
  std::vector<fs::path> found;
  std::error_code code;
  fs::recursive_directory_iterator entry(folder, code);
  for (const fs::recursive_directory_iterator end; !code && entry != end; entry.increment(code)) {
    const fs::path& path = entry->path();
    if (has_word(path.filename().string(), words)) {
      found.push_back(path);
      continue;
    }
    if (!entry->is_regular_file(code) || code) continue;
    const auto traced = path.filename() == "keys.jsonl" ? has_trace_of_keys(path, words) : has_trace(path, words);
    if (!traced && traced.error().code == ErrorCode::not_found) continue;  // removed a moment ago
    if (!traced) return traced.error();
    if (*traced) found.push_back(path);
  }
  if (code) return Error{ErrorCode::io, folder.string() + ": cannot be listed: " + code.message()};
  return found;
}

}  // namespace booth
