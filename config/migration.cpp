#include "config/migration.h"

#include <sys/stat.h>
#include <unistd.h>

#include <toml++/toml.h>
#include <cerrno>
#include <regex>
#include <sstream>
#include <system_error>
#include <vector>

#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

constexpr size_t largest_bytes = size_t{1} << 20;
constexpr int most_backups = 1000;

std::vector<std::string> lines_of(std::string_view text) {
  std::vector<std::string> lines;
  std::istringstream stream{std::string(text)};
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

/// Without [drivers]; comments and blank lines stay, as they may belong to what follows.
std::vector<std::string> without_drivers(const std::vector<std::string>& lines) {
  static const std::regex header(R"(^\s*\[\s*drivers\s*\]\s*(#.*)?$)"), any_header(R"(^\s*\[.*)"),
      kept_inside(R"(^\s*(#.*)?$)"), at_the_top(R"(^\s*drivers\s*[.=].*)");
  std::vector<std::string> kept;
  bool inside = false, at_top = true;
  for (const std::string& line : lines) {
    const bool begins = std::regex_match(line, header);
    if (std::regex_match(line, any_header)) inside = begins, at_top = false;
    if (begins || (inside && !std::regex_match(line, kept_inside))) continue;
    if (at_top && std::regex_match(line, at_the_top)) continue;
    kept.push_back(line);
  }
  return kept;
}

/// Version 1: its only driver was the one that is the default now.
bool is_version_1(const toml::table& table) {
  const toml::table* drivers = table["drivers"].as_table();
  return !table.contains("version") && drivers != nullptr && drivers->size() <= 1 &&
         drivers->contains("camera") == !drivers->empty() &&
         (*drivers)["camera"].value_or<std::string>("replay") == "replay";
}

/// The names of the file's copies, in their order.
fs::path backup_name(const fs::path& file, int number) { return file.string() + ".bak-" + std::to_string(number); }

/// Keeps `bytes` beside the file, once. @return where
Result<fs::path> keep_original(const fs::path& file, const std::vector<uint8_t>& bytes) {
  for (int number = 1; number <= most_backups; ++number) {
    const fs::path backup = backup_name(file, number);
    const auto there = read_file(backup, largest_bytes);
    if (there && *there == bytes) return backup;  // of a migration that was interrupted
    if (there || there.error().code != ErrorCode::not_found) continue;
    if (const auto written = write_file_atomically(backup, bytes); !written) return written.error();
    return backup;
  }
  return Error{ErrorCode::io, file.string() + ": there are " + std::to_string(most_backups) + " copies already"};
}

Result<void> give_to(const fs::path& file, const struct stat& owner) {
  if (::chown(file.c_str(), owner.st_uid, owner.st_gid) != 0 || ::chmod(file.c_str(), owner.st_mode & 07777) != 0)
    return Error{ErrorCode::io,
                 file.string() + ": its owner or permissions cannot be set: " + std::generic_category().message(errno)};
  return {};
}

}  // namespace

Result<std::optional<MigratedConfig>> migrate_config(std::string_view text) {
  try {
    toml::table before = toml::parse(text);
    if (const auto version = before["version"].value_exact<int64_t>(); version && *version > config_version)
      return Error{
          ErrorCode::unsupported,
          std::to_string(*version) + ", expected at most " + std::to_string(config_version) +
              ": it was written for a newer program; install that one, or put back the copy (.bak-…) that it left"};
    if (!is_version_1(before)) return std::optional<MigratedConfig>();
    MigratedConfig migrated{.from = 1, .text = "version = " + std::to_string(config_version) + "\n"};
    for (const std::string& line : without_drivers(lines_of(text))) migrated.text += line + "\n";
    // Lines were taken for what they look like: only if nothing else changed, that was right.
    toml::table after = toml::parse(migrated.text);
    before.erase("drivers");
    before.insert("version", config_version);
    if (after != before) return std::optional<MigratedConfig>();
    return std::optional<MigratedConfig>(std::move(migrated));
  } catch (const toml::parse_error&) {
    return std::optional<MigratedConfig>();
  }
}

Result<std::string> migrate_config_file(const fs::path& given) {
  std::error_code code;
  const fs::path file = fs::canonical(given, code);  // a link stays one
  if (code) return Error{ErrorCode::not_found, given.string() + ": " + code.message()};
  const auto bytes = read_file(file, largest_bytes);
  if (!bytes) return bytes.error();
  const auto migrated = migrate_config({reinterpret_cast<const char*>(bytes->data()), bytes->size()});
  if (!migrated) return Error{migrated.error().code, file.string() + ": version: " + migrated.error().message};
  if (!*migrated) return std::string();

  struct stat owner {};
  if (::stat(file.c_str(), &owner) != 0)
    return Error{ErrorCode::io, file.string() + ": " + std::generic_category().message(errno)};
  const auto backup = keep_original(file, *bytes);
  if (!backup) return backup.error();
  if (const auto given_back = give_to(*backup, owner); !given_back) return given_back.error();
  if (const auto written = write_file_atomically(file, (*migrated)->text); !written) return written.error();
  if (const auto given_back = give_to(file, owner); !given_back) return given_back.error();
  return file.string() + ": migrated from version " + std::to_string((*migrated)->from) + " to " +
         std::to_string(config_version) + "; the original is kept as " + backup->string();
}

}  // namespace booth
