#pragma once

#include <cstdint>
#include <nlohmann/json.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>

#include "pipeline/types/result.h"

namespace booth {

/// A JSON file and the first fault that reading it found. Fields of it refer to it.
class JsonDocument {
 public:
  using Json = nlohmann::json;

  /// @param name  of the file, as messages shall name it
  /// @error invalid_file  not JSON (with line and column), or nested too deeply
  static Result<JsonDocument> parse(std::string name, std::span<const uint8_t> text);

  const Json& root() const { return root_; }
  bool ok() const { return !fault_; }
  /// Keeps the first: `NAME: PATH: WHAT`.
  void report(const std::string& path, const std::string& what);
  /// @pre !ok()
  Error error() const { return {ErrorCode::invalid_file, *fault_}; }

 private:
  std::string name_;
  Json root_;
  std::optional<std::string> fault_;
};

/// A value inside a JSON document. What it is asked for and cannot give is reported to the document, and a harmless
/// value is returned, so that a caller may read on and look for a fault once, at the end.
class JsonField {
 public:
  explicit JsonField(JsonDocument& document) : JsonField(document, &document.root(), "") {}

  /// Reports a fault of this field.
  void refuse(const std::string& what) const { document_->report(path_.empty() ? "the file" : path_, what); }
  /// Reports that this value is not what was expected, and quotes it.
  void refuse_value(const std::string& expected) const;
  bool ok() const { return document_->ok(); }

  /// A member that must be there.
  JsonField member(const char* key) const;
  /// A member that may be absent or null.
  std::optional<JsonField> find(const char* key) const;

  /// How many elements an array has; 0 after the report that it is none, or has more than `most`.
  size_t size(size_t most) const;
  /// Whether it is an array of just `count` elements; otherwise reports that those are expected.
  bool expect_elements(size_t count, const std::string& expected) const;
  JsonField operator[](size_t index) const;

  /// @return a finite number in [lowest, highest]
  double number(double lowest, double highest) const;
  /// Whole numbers only, also when written as 2.0.
  int64_t integer(int64_t lowest, int64_t highest) const;
  uint64_t unsigned_integer() const;
  bool boolean() const;
  /// Without control characters, at most `longest` bytes.
  std::string text(size_t longest) const;
  /// What people wrote, at most `longest` bytes; control characters become spaces.
  std::string free_text(size_t longest) const;
  /// is_safe_id
  std::string id() const;
  /// is_safe_relative_path
  std::string relative_path() const;

 private:
  JsonField(JsonDocument& document, const nlohmann::json* json, std::string path)
      : document_(&document), json_(json), path_(std::move(path)) {}

  JsonDocument* document_;
  const nlohmann::json* json_;
  std::string path_;
};

}  // namespace booth
