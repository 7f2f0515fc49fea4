#include "pipeline/export/metadata.h"

#include <nlohmann/json.hpp>

namespace booth {
namespace {

using Json = nlohmann::ordered_json;

Error invalid(const std::string& what) { return {ErrorCode::invalid_file, "metadata.json: " + what}; }

/// Collects the first fault while the members of an object are read one after another.
class Reader {
 public:
  explicit Reader(const Json& object) : object_(object) {}

  void read(const char* key, std::string& value) {
    if (const Json* found = require(key, &Json::is_string, "a string")) value = *found->get_ptr<const std::string*>();
  }
  void read(const char* key, uint64_t& value) {
    if (const Json* found = require(key, &Json::is_number_unsigned, "a whole number")) value = found->get<uint64_t>();
  }
  void read_optional(const char* key, std::string& value) {
    if (object_.contains(key)) read(key, value);
  }
  void read_optional(const char* key, std::vector<std::string>& values) {
    if (!object_.contains(key)) return;
    const Json* found = require(key, &Json::is_array, "an array of strings");
    if (found == nullptr) return;
    for (const Json& item : *found) {
      if (!item.is_string()) return fail(key, "an array of strings");
      values.push_back(item.get<std::string>());
    }
  }
  void read_optional(const char* key, std::vector<std::pair<std::string, double>>& values) {
    if (!object_.contains(key)) return;
    const Json* found = require(key, &Json::is_object, "an object of numbers");
    if (found == nullptr) return;
    for (const auto& [name, number] : found->items()) {
      if (!number.is_number()) return fail(key, "an object of numbers");
      values.emplace_back(name, number.get<double>());
    }
  }
  void read_optional(const char* key, std::vector<AvatarFile>& files) {
    if (!object_.contains(key)) return;
    const Json* found = require(key, &Json::is_object, "an object of files");
    if (found == nullptr) return;
    for (const auto& [name, entry] : found->items()) {
      if (!entry.is_object()) return fail(key, "an object of files");
      Reader reader(entry);
      AvatarFile& file = files.emplace_back();
      file.name = name;
      reader.read("size", file.size);
      reader.read("sha256", file.sha256);
      if (fault_.empty()) fault_ = reader.fault();
    }
  }
  const std::string& fault() const { return fault_; }

 private:
  const Json* require(const char* key, bool (Json::*is_kind)() const noexcept, const char* kind) {
    const auto found = object_.find(key);
    if (found != object_.end() && ((*found).*is_kind)()) return &*found;
    fail(key, kind);
    return nullptr;
  }
  void fail(const char* key, const char* kind) {
    if (fault_.empty()) fault_ = std::string(key) + " must be " + kind;
  }

  const Json& object_;
  std::string fault_;
};

}  // namespace

std::string write_metadata(const AvatarMetadata& metadata) {
  Json seconds = Json::object();
  for (const auto& [stage, duration] : metadata.stage_seconds) seconds[stage] = duration;
  Json files = Json::object();
  for (const AvatarFile& file : metadata.files) files[file.name] = {{"size", file.size}, {"sha256", file.sha256}};
  const Json object = {{"id", metadata.id},
                       {"created", metadata.created},
                       {"label", metadata.label},
                       {"recording", metadata.recording},
                       {"software_version", metadata.software_version},
                       {"face", metadata.face},
                       {"texture_method", metadata.texture_method},
                       {"cameras", metadata.cameras},
                       {"triangles", metadata.triangles},
                       {"joints", metadata.joints},
                       {"stage_seconds", seconds},
                       {"warnings", metadata.warnings},
                       {"files", files}};
  constexpr int indent = 2;
  return object.dump(indent, ' ', false, Json::error_handler_t::replace) + "\n";
}

Result<AvatarMetadata> read_metadata(std::string_view json) {
  const Json object = Json::parse(json, nullptr, false);
  if (object.is_discarded()) return invalid("is not JSON");
  if (!object.is_object()) return invalid("is not an object");
  AvatarMetadata metadata;
  Reader reader(object);
  reader.read("id", metadata.id);
  reader.read("created", metadata.created);
  reader.read_optional("label", metadata.label);
  reader.read("recording", metadata.recording);
  reader.read("software_version", metadata.software_version);
  reader.read_optional("face", metadata.face);
  reader.read_optional("texture_method", metadata.texture_method);
  reader.read_optional("cameras", metadata.cameras);
  reader.read("triangles", metadata.triangles);
  reader.read("joints", metadata.joints);
  reader.read_optional("stage_seconds", metadata.stage_seconds);
  reader.read_optional("warnings", metadata.warnings);
  reader.read_optional("files", metadata.files);
  if (!reader.fault().empty()) return invalid(reader.fault());
  return metadata;
}

}  // namespace booth
