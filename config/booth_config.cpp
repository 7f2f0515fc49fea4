#include "config/booth_config.h"

#include <toml++/toml.h>
#include <algorithm>
#include <array>
#include <cmath>
#include <sstream>
#include <utility>

#include "replay/durable_folder.h"

namespace booth {
namespace {

namespace fs = std::filesystem;

template <class Value>
using Words = std::vector<std::pair<std::string_view, Value>>;

// What can be set, one function a section. A visitor reads it, writes it or lists it, so that the three agree.

template <class Visitor>
void visit_booth(Visitor& visitor, IdentityConfig& booth) {
  constexpr size_t longest_name = 64;
  visitor.text("name", booth.name, longest_name);
  visitor.path("state_directory", booth.state_directory);
}

template <class Visitor>
void visit_api(Visitor& visitor, ApiConfig& api) {
  visitor.endpoint("control", api.control);
  visitor.endpoint("events", api.events);
}

template <class Visitor>
void visit_capture(Visitor& visitor, CaptureConfig& capture) {
  using Format = SpoolOptions::Format;
  visitor.integer("frame_timeout_ms", capture.frame_timeout_ms, 50, 60000);
  visitor.integer("min_cameras", capture.min_cameras, 1, 256);
  visitor.integer("background_frames", capture.background_frames, 1, 100);
  visitor.choice("image_format", capture.images.format, Words<Format>{{"png", Format::png}, {"jpeg", Format::jpeg}});
  visitor.integer("png_level", capture.images.png_level, 0, 9);
  visitor.integer("jpeg_quality", capture.images.jpeg_quality, 1, 100);
  visitor.boolean("keep_encoded", capture.images.keep_encoded);
}

template <class Visitor>
void visit_disk(Visitor& visitor, DiskConfig& disk) {
  visitor.integer("reserve_mib", disk.reserve_mib, 0, 10'000'000);
  visitor.integer("limit_mib", disk.limit_mib, 0, 100'000'000);
}

template <class Visitor>
void visit_jobs(Visitor& visitor, JobsConfig& jobs) {
  visitor.integer("workers", jobs.workers, 1, 64);
  visitor.integer("threads", jobs.threads, 0, 256);
  visitor.integer("timeout_s", jobs.timeout_s, 1, 86400);
  visitor.integer("retries", jobs.retries, 0, 10);
}

template <class Visitor>
void visit_log(Visitor& visitor, LogConfig& log) {
  visitor.choice("level", log.level,
                 Words<LogLevel>{{"error", LogLevel::error},
                                 {"warning", LogLevel::warning},
                                 {"info", LogLevel::info},
                                 {"debug", LogLevel::debug}});
}

template <class Visitor>
void visit_drivers(Visitor& visitor, DriversConfig& drivers) {
  visitor.choice("camera", drivers.camera, Words<std::string>{{"replay", "replay"}});
}

template <class Visitor>
void visit_fault(Visitor& visitor, ReplayFault& fault) {
  using Kind = ReplayFault::Kind;
  constexpr int most = 1'000'000;
  visitor.choice(
      "kind", fault.kind,
      Words<Kind>{{"missing", Kind::missing}, {"late", Kind::late}, {"corrupt", Kind::corrupt}, {"lost", Kind::lost}});
  visitor.camera("camera", fault.camera);
  Words<std::optional<ShotRole>> roles{{"any", std::nullopt}};
  for (const ShotRole role : {ShotRole::background, ShotRole::body, ShotRole::gray_code, ShotRole::calibration_board})
    roles.emplace_back(to_string(role), role);
  visitor.choice("role", fault.role, roles);
  visitor.optional_integer("index", fault.index, 0, most);
  visitor.optional_integer("capture", fault.capture, 0, most);
  visitor.integer("delay_ms", fault.delay_ms, 0, most);
}

template <class Visitor>
void visit_replay(Visitor& visitor, ReplayOptions& replay) {
  using Pace = ReplayOptions::Pace;
  visitor.path("recording", replay.recording);
  visitor.choice("pace", replay.pace, Words<Pace>{{"real", Pace::real}, {"fast", Pace::fast}});
  visitor.integer("cache_mib", replay.cache_mib, 0, 65536);
  visitor.list("faults", replay.faults, [](auto& element, ReplayFault& fault) { visit_fault(element, fault); });
}

template <class Visitor>
void visit_reconstruct(Visitor& visitor, ReconstructionOptions& options) {
  Words<FaceMode> faces;
  for (const FaceMode mode : {FaceMode::automatic, FaceMode::active, FaceMode::passive, FaceMode::none})
    faces.emplace_back(to_string(mode), mode);
  visitor.choice("face", options.face, faces);
  visitor.integer("triangles", options.decimation.triangles, 500, 1'000'000);
  visitor.integer("atlas_size", options.atlas.size, 256, 8192);
  visitor.millimetres("voxel_mm", options.hull.voxel_m, 1, 50);
  visitor.integer("min_views", options.hull.min_views, 1, 256);
  visitor.choice("skeleton", options.skeleton.method,
                 Words<SkeletonMethod>{{"anatomy", SkeletonMethod::anatomy}, {"embedding", SkeletonMethod::embedding}});
}

template <class Visitor>
void visit_export(Visitor& visitor, AvatarFileOptions& files) {
  visitor.choice("texture", files.texture, Words<ImageFormat>{{"png", ImageFormat::png}, {"jpeg", ImageFormat::jpeg}});
  visitor.integer("jpeg_quality", files.jpeg_quality, 1, 100);
  visitor.boolean("animation", files.animation);
  visitor.boolean("turntable", files.turntable);
  visitor.choices("formats", files.formats,
                  Words<MeshFormat>{{"stl", MeshFormat::stl}, {"obj", MeshFormat::obj}, {"ply", MeshFormat::ply}});
}

template <class Visitor>
void visit_config(Visitor& visitor, BoothConfig& config) {
  visitor.section("booth", [&](auto& section) { visit_booth(section, config.booth); });
  visitor.section("api", [&](auto& section) { visit_api(section, config.api); });
  visitor.section("capture", [&](auto& section) { visit_capture(section, config.capture); });
  visitor.section("disk", [&](auto& section) { visit_disk(section, config.disk); });
  visitor.section("jobs", [&](auto& section) { visit_jobs(section, config.jobs); });
  visitor.section("log", [&](auto& section) { visit_log(section, config.log); });
  visitor.section("drivers", [&](auto& section) { visit_drivers(section, config.drivers); });
  visitor.section("replay", [&](auto& section) { visit_replay(section, config.replay); });
  visitor.section("reconstruct", [&](auto& section) { visit_reconstruct(section, config.reconstruct); });
  visitor.section("export", [&](auto& section) { visit_export(section, config.files); });
}

/// One short line without control characters.
std::string one_line(std::string text) {
  constexpr size_t longest = 100;
  std::replace_if(
      text.begin(), text.end(), [](unsigned char c) { return c < 0x20 || c == 0x7f; }, ' ');
  if (text.size() > longest) text = text.substr(0, longest) + "…";
  return text;
}

std::string quoted(const toml::node& node) {
  if (node.is_table()) return "a table";
  if (node.is_array()) return "an array";
  if (const auto* text = node.as_string()) return "\"" + one_line(text->get()) + "\"";
  std::ostringstream text;
  node.visit([&](const auto& value) { text << value; });
  return one_line(text.str());
}

template <class Value>
std::string listed(const Words<Value>& words) {
  std::string list;
  for (const auto& [word, value] : words) list += (list.empty() ? "\"" : ", \"") + std::string(word) + "\"";
  return words.size() == 1 ? list : "one of " + list;
}

std::string range(const std::string& lowest, const std::string& highest) { return lowest + " … " + highest; }

/// Takes what a table holds into the options and notes everything that is wrong.
class Reader {
 public:
  Reader(const toml::table& table, std::string path, const fs::path& folder, std::vector<ConfigFault>& faults)
      : table_(table), path_(std::move(path)), folder_(folder), faults_(faults) {}

  template <class Visit>
  void section(const char* key, const Visit& visit) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const toml::table* table = node->as_table();
    if (table == nullptr) return refuse(key, *node, "a table: [" + dotted(key) + "]");
    Reader reader(*table, dotted(key), folder_, faults_);
    visit(reader);
    reader.refuse_unknown();
  }

  template <class Element, class Visit>
  void list(const char* key, std::vector<Element>& elements, const Visit& visit) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const toml::array* array = node->as_array();
    constexpr size_t most = 1000;
    if (array == nullptr || array->size() > most)
      return refuse(key, *node, "an array of at most " + std::to_string(most) + " tables: [[" + dotted(key) + "]]");
    elements.clear();
    for (size_t i = 0; i < array->size(); ++i) {
      const std::string path = std::string(key) + "[" + std::to_string(i) + "]";
      const toml::table* table = (*array)[i].as_table();
      if (table == nullptr) {
        refuse(path.c_str(), (*array)[i], "a table");
        continue;
      }
      Reader reader(*table, dotted(path.c_str()), folder_, faults_);
      visit(reader, elements.emplace_back());
      reader.refuse_unknown();
    }
  }

  void text(const char* key, std::string& value, size_t longest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || text->empty() || text->size() > longest || has_control(*text))
      return refuse(key, *node, "a text of 1 … " + std::to_string(longest) + " bytes on one line");
    value = *text;
  }

  void path(const char* key, fs::path& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    constexpr size_t longest = 4000;
    if (!text || text->empty() || text->size() > longest || has_control(*text)) return refuse(key, *node, "a path");
    value = (folder_ / *text).lexically_normal();
  }

  void endpoint(const char* key, std::string& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    const std::string local = "ipc://";
    constexpr size_t longest = 107;  // of a Unix socket's path
    if (text && text->starts_with("tcp://"))
      return refuse(key, *node, "ipc:///PATH: this version offers no encryption, and without it tcp:// is refused");
    if (!text || !text->starts_with(local + "/") || text->size() > local.size() + longest || has_control(*text))
      return refuse(key, *node, "ipc:///PATH with a path of at most " + std::to_string(longest) + " bytes");
    value = *text;
  }

  void camera(const char* key, std::string& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    if (!text || (!text->empty() && !is_safe_id(*text)))
      return refuse(key, *node, "a camera's id, or \"\" for every camera");
    value = *text;
  }

  void boolean(const char* key, bool& value) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto truth = node->value_exact<bool>();
    if (!truth) return refuse(key, *node, "true or false");
    value = *truth;
  }

  template <class Integer>
  void integer(const char* key, Integer& value, int64_t lowest, int64_t highest) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto number = node->value_exact<int64_t>();
    if (!number || *number < lowest || *number > highest)
      return refuse(key, *node,
                    (number ? "" : "a whole number, ") + range(std::to_string(lowest), std::to_string(highest)));
    value = static_cast<Integer>(*number);
  }

  void optional_integer(const char* key, std::optional<int>& value, int64_t lowest, int64_t highest) {
    if (!table_.contains(key)) return known_.push_back(key);
    int number = 0;
    integer(key, number, lowest, highest);
    value = number;
  }

  void millimetres(const char* key, double& value_m, double lowest_mm, double highest_mm) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto number = node->value<double>();
    if (!node->is_number() || !number || !(*number >= lowest_mm && *number <= highest_mm))
      return refuse(key, *node, range(written(lowest_mm), written(highest_mm)));
    constexpr double mm_per_m = 1000;
    value_m = *number / mm_per_m;
  }

  template <class Value>
  void choice(const char* key, Value& value, const Words<Value>& words) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const auto text = node->value_exact<std::string>();
    const auto found = std::find_if(words.begin(), words.end(), [&](const auto& word) { return text == word.first; });
    if (found == words.end()) return refuse(key, *node, listed(words));
    value = found->second;
  }

  /// A list of words, each at most once.
  template <class Value>
  void choices(const char* key, std::vector<Value>& values, const Words<Value>& words) {
    const toml::node* node = take(key);
    if (node == nullptr) return;
    const toml::array* array = node->as_array();
    if (array == nullptr) return refuse(key, *node, "an array of words, each " + listed(words));
    values.clear();
    for (size_t i = 0; i < array->size(); ++i) {
      const std::string path = std::string(key) + "[" + std::to_string(i) + "]";
      const auto text = (*array)[i].value_exact<std::string>();
      const auto found = std::find_if(words.begin(), words.end(), [&](const auto& word) { return text == word.first; });
      if (found == words.end())
        refuse(path.c_str(), (*array)[i], listed(words));
      else if (std::find(values.begin(), values.end(), found->second) != values.end())
        refuse(path.c_str(), (*array)[i], "each word once");
      else
        values.push_back(found->second);
    }
  }

  /// Reports the keys that nobody asked for.
  void refuse_unknown() {
    std::string list;
    for (const std::string& key : known_) list += (list.empty() ? "" : ", ") + key;
    for (const auto& [key, node] : table_)
      if (std::find(known_.begin(), known_.end(), key.str()) == known_.end())
        refuse(one_line(std::string(key.str())).c_str(), node, "one of the keys " + list);
  }

 private:
  static bool has_control(const std::string& text) {
    return std::any_of(text.begin(), text.end(), [](unsigned char c) { return c < 0x20 || c == 0x7f; });
  }
  static std::string written(double number) {
    std::ostringstream text;
    text << number;
    return text.str();
  }

  const toml::node* take(const char* key) {
    known_.emplace_back(key);
    return table_.get(key);
  }
  std::string dotted(const char* key) const { return path_.empty() ? key : path_ + "." + key; }
  void refuse(const char* key, const toml::node& node, const std::string& expected) {
    faults_.push_back({dotted(key), quoted(node), expected});
  }

  const toml::table& table_;
  std::string path_;
  const fs::path& folder_;
  std::vector<ConfigFault>& faults_;
  std::vector<std::string> known_;
};

/// Writes the options as TOML.
class Writer {
 public:
  template <class Visit>
  void section(const char* key, const Visit& visit) {
    text_ << (path_.empty() && text_.tellp() > 0 ? "\n[" : "[") << key << "]\n";
    path_ = key;
    visit(*this);
    path_.clear();
  }
  template <class Element, class Visit>
  void list(const char* key, std::vector<Element>& elements, const Visit& visit) {
    for (Element& element : elements) {
      text_ << "\n[[" << path_ << "." << key << "]]\n";
      visit(*this, element);
    }
  }
  void text(const char* key, const std::string& value, size_t) { write_text(key, value); }
  void path(const char* key, const fs::path& value) { write_text(key, value.string()); }
  void endpoint(const char* key, const std::string& value) { write_text(key, value); }
  void camera(const char* key, const std::string& value) { write_text(key, value); }
  void boolean(const char* key, bool value) { text_ << key << " = " << (value ? "true" : "false") << "\n"; }
  template <class Integer>
  void integer(const char* key, Integer value, int64_t, int64_t) {
    text_ << key << " = " << value << "\n";
  }
  void optional_integer(const char* key, const std::optional<int>& value, int64_t, int64_t) {
    if (value) text_ << key << " = " << *value << "\n";
  }
  void millimetres(const char* key, double value_m, double, double) {
    text_ << key << " = " << toml::value<double>(value_m * 1000) << "\n";
  }
  template <class Value>
  void choice(const char* key, const Value& value, const Words<Value>& words) {
    for (const auto& [word, meaning] : words)
      if (meaning == value) write_text(key, std::string(word));
  }
  template <class Value>
  void choices(const char* key, const std::vector<Value>& values, const Words<Value>& words) {
    text_ << key << " = [";
    for (size_t i = 0; i < values.size(); ++i)
      for (const auto& [word, meaning] : words)
        if (meaning == values[i]) text_ << (i > 0 ? ", " : "") << toml::value<std::string>(std::string(word));
    text_ << "]\n";
  }

  std::string text() const { return text_.str(); }

 private:
  void write_text(const char* key, const std::string& value) {
    text_ << key << " = " << toml::value<std::string>(value) << "\n";
  }

  std::ostringstream text_;
  std::string path_;
};

/// Lists the keys.
class Lister {
 public:
  template <class Visit>
  void section(const char* key, const Visit& visit) {
    path_ = std::string(key) + ".";
    visit(*this);
  }
  template <class Element, class Visit>
  void list(const char* key, std::vector<Element>&, const Visit& visit) {
    Lister inside;
    inside.path_ = path_ + key + "[].";
    Element element;
    visit(inside, element);
    keys.insert(keys.end(), inside.keys.begin(), inside.keys.end());
  }
  void text(const char* key, const std::string&, size_t) { add(key); }
  void path(const char* key, const fs::path&) { add(key); }
  void endpoint(const char* key, const std::string&) { add(key); }
  void camera(const char* key, const std::string&) { add(key); }
  void boolean(const char* key, bool) { add(key); }
  template <class Integer>
  void integer(const char* key, Integer, int64_t, int64_t) {
    add(key);
  }
  void optional_integer(const char* key, const std::optional<int>&, int64_t, int64_t) { add(key); }
  void millimetres(const char* key, double, double, double) { add(key); }
  template <class Value>
  void choice(const char* key, const Value&, const Words<Value>&) {
    add(key);
  }
  template <class Value>
  void choices(const char* key, const std::vector<Value>&, const Words<Value>&) {
    add(key);
  }

  std::vector<std::string> keys;

 private:
  void add(const char* key) { keys.push_back(path_ + key); }
  std::string path_;
};

/// What holds between keys.
void check_together(const BoothConfig& config, std::vector<ConfigFault>& faults) {
  if (config.api.control == config.api.events)
    faults.push_back({"api.events", "\"" + config.api.events + "\"", "another endpoint than api.control"});
  if (config.booth.state_directory.is_relative())
    faults.push_back({"booth.state_directory", config.booth.state_directory.string(), "an absolute path"});
}

}  // namespace

std::string ConfigFault::to_string() const {
  return path + ": " + value + (expected.empty() ? "" : ", expected " + expected);
}

ConfigReading parse_config(std::string_view text, const fs::path& folder) {
  ConfigReading reading;
  try {
    const toml::table table = toml::parse(text);
    Reader reader(table, "", folder, reading.faults);
    visit_config(reader, reading.config);
    reader.refuse_unknown();
  } catch (const toml::parse_error& error) {
    const toml::source_position place = error.source().begin;
    reading.faults.push_back({"line " + std::to_string(place.line) + ", column " + std::to_string(place.column),
                              "is not TOML: " + one_line(std::string(error.description())), ""});
    return reading;
  }
  if (reading.faults.empty()) check_together(reading.config, reading.faults);
  return reading;
}

Result<BoothConfig> load_config(const fs::path& file) {
  constexpr size_t largest_bytes = size_t{1} << 20;
  const auto bytes = read_file(file, largest_bytes);
  if (!bytes) return bytes.error();
  const std::string text(bytes->begin(), bytes->end());
  std::error_code code;
  const fs::path folder = fs::absolute(file, code).parent_path();
  ConfigReading reading = parse_config(text, folder);
  if (reading.faults.empty()) return std::move(reading.config);
  std::string message;
  for (const ConfigFault& fault : reading.faults)
    message += (message.empty() ? "" : "\n") + file.string() + ": " + fault.to_string();
  return Error{ErrorCode::invalid_file, message};
}

std::string write_config(const BoothConfig& config) {
  Writer writer;
  BoothConfig copy = config;
  visit_config(writer, copy);
  return writer.text();
}

std::vector<std::string> config_keys() {
  Lister lister;
  BoothConfig config;
  visit_config(lister, config);
  return std::move(lister.keys);
}

}  // namespace booth
